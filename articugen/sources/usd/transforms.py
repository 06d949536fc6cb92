"""Where prims stand, by our arithmetic: OpenUSD's last bits depend on the processor's sine."""

from typing import Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.errors import InvalidSource
from articugen.core.geometry import cross, rotation_about, rotation_from_quaternion
from articugen.core.portable import dot, norm, product, turned
from articugen.meshes import openusd as pxr
from articugen.meshes.model_files import quoted

MAX_NUMBER = 1e9  # largest length in stage units, angle in degrees or scale

_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
_SHEAR = 1e-4


class Places:
    """`T_stage_prim` of the prims of a stage, at its default time."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._known: dict[Any, Floats] = {}

    def of(self, prim: Any) -> Floats:
        """Return (4, 4), stage units; with scale and all."""
        if prim.IsPseudoRoot():
            return np.eye(4)
        path = prim.GetPath()
        if path not in self._known:
            above = self.of(prim.GetParent())
            xformable = pxr.UsdGeom.Xformable(prim)
            if xformable:
                local = self._own(xformable)
                above = local if xformable.GetResetXformStack() else product(above, local)
            self._known[path] = above
        return self._known[path]

    def _own(self, xformable: Any) -> Floats:
        T = np.eye(4)
        by = f"{self._where}: {xformable.GetPath()}"
        for op in _steps(xformable, by):
            name = str(op.GetOpName())
            kind = name.removeprefix("!invert!").split(":")[1]
            step = _step(kind, value_of(op.GetAttr(), by), by)
            T = product(T, inverse(step, by) if op.IsInverseOp() else step)
        return T


def _steps(xformable: Any, by: str) -> list[Any]:
    """Return the steps by which a prim is placed; OpenUSD passes over those that it cannot find."""
    names = value_of(xformable.GetXformOpOrderAttr(), by) or ()
    wanted = [str(name) for name in names]
    if "!resetXformStack!" in wanted:  # what stands before it counts for nothing
        wanted = wanted[len(wanted) - wanted[::-1].index("!resetXformStack!") :]
    try:
        steps = list(xformable.GetOrderedXformOps())
    except pxr.Tf.ErrorException:
        steps = []
    if [str(op.GetOpName()) for op in steps] != wanted:
        raise InvalidSource(
            f"{by}: its xformOpOrder names steps that are not there or not known: "
            f"{quoted(', '.join(wanted))}; flatten its transform"
        )
    return steps


def value_of(attribute: Any, by: str) -> Any:
    """Return the value of an attribute at the default time; InvalidSource if it changes with
    time."""
    if attribute.GetNumTimeSamples() > 0:
        raise InvalidSource(
            f"{by}: {attribute.GetName()} changes with time; export the model without animation"
        )
    return attribute.Get()


def numbers(value: Any, shape: tuple[int, ...], by: str, what: str) -> Floats:
    """Return a value as an array of that shape; InvalidSource if it is none, or of a number that is
    not finite or too large."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        array = np.full(0, np.nan)
    if array.shape != shape or not (np.abs(array) <= MAX_NUMBER).all():
        raise InvalidSource(
            f"{by}: {what} is missing, not finite or beyond {MAX_NUMBER:g}; correct it"
        )
    return array


def rotation_of(quaternion: Any, by: str, what: str) -> Floats:
    """Return (3, 3) of a quaternion of OpenUSD, of any length; InvalidSource if it is none."""
    parts = None if quaternion is None else (quaternion.GetReal(), *quaternion.GetImaginary())
    q = numbers(parts, (4,), by, what)
    length = norm(q)
    if length < 1e-6:
        raise InvalidSource(f"{by}: {what} is no rotation; correct it")
    return rotation_from_quaternion(q / length)


def inverse(T: Floats, by: str) -> Floats:
    """Return (4, 4) of an affine transform, by cofactors; InvalidSource if it has none."""
    x, y, z = T[:3, 0], T[:3, 1], T[:3, 2]
    volume = dot(x, cross(y, z))
    if volume == 0.0:
        raise InvalidSource(f"{by}: is scaled to nothing; correct its scale")
    back = np.eye(4)
    back[:3, :3] = np.stack([cross(y, z), cross(z, x), cross(x, y)]) / volume
    back[:3, 3] = -turned(back[:3, :3], T[:3, 3])
    return back


def turn_of(T: Floats, by: str) -> Floats:
    """Return (3, 3) the rotation in a transform that turns, scales and perhaps mirrors;
    InvalidSource if it shears, or scales to nothing. Of a mirrored one all three scales count as
    negative, as OpenUSD has it."""
    columns = T[:3, :3]
    lengths = norm(columns.T)
    if not (lengths > 0.0).all():
        raise InvalidSource(f"{by}: is scaled to nothing; correct its scale")
    R = columns / lengths
    x, y, z = R.T
    if max(abs(dot(x, y)), abs(dot(y, z)), abs(dot(z, x))) > _SHEAR:
        raise InvalidSource(
            f"{by}: is sheared, for it is turned inside of a scale that is not the same along all "
            "axes; apply the scale to its meshes"
        )
    return R if dot(x, cross(y, z)) > 0.0 else -R


def axis_of(token: Any, by: str) -> tuple[float, float, float]:
    """Return the unit vector that X, Y or Z stands for; InvalidSource for anything else."""
    if str(token) not in _AXES:
        raise InvalidSource(f"{by}: its axis is {quoted(str(token))}; make it X, Y or Z")
    return _AXES[str(token)]


def _step(kind: str, value: Any, by: str) -> Floats:
    """Return (4, 4) of one xformOp. OpenUSD's matrices multiply rows, and are transposed here."""
    T = np.eye(4)
    if kind == "transform":
        T = numbers(value, (4, 4), by, "a transform").T
        if not np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0)):
            raise InvalidSource(f"{by}: its transform is a projection; make it affine")
    elif kind == "orient":
        T[:3, :3] = rotation_of(value, by, "its orientation")
    elif kind.startswith("rotate"):
        letters = kind.removeprefix("rotate")
        angles = numbers(value, (3,) if len(letters) == 3 else (), by, "a rotation")
        for letter in letters:  # the first one acts first
            angle = angles["XYZ".index(letter)] if len(letters) == 3 else angles
            if abs(angle) > 1e6:
                raise InvalidSource(f"{by}: is turned by {angle:g} degrees; correct it")
            turn = rotation_about(_AXES[letter], float(angle) * (np.pi / 180.0))
            T[:3, :3] = product(turn, T[:3, :3])
    elif kind.startswith(("translate", "scale")):
        name = kind.removeprefix("translate").removeprefix("scale")
        rows = np.array("XYZ".index(name) if name else (0, 1, 2))
        columns = 3 if kind.startswith("translate") else rows
        T[rows, columns] = numbers(value, rows.shape, by, f"its {kind}")
    else:
        raise InvalidSource(f"{by}: is placed by {quoted(kind)}, which is not known; flatten it")
    return T
