"""USD: each object with UsdPhysics joints, for Isaac Sim, Omniverse and any USD viewer.

One .usdc a object; z up, metres. Parts are rigid bodies that lie beside each other, as UsdPhysics
wants them, posed canonically; they collide where convex meshes are asked for.
"""

import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from articugen.core.arrays import Floats
from articugen.core.colours import colour_of
from articugen.core.records import Mesh
from articugen.export.assembly import Body, bodies, damping, from_the_root
from articugen.export.formats import Format
from articugen.export.items import Item, of_objects
from articugen.export.parts import unique
from articugen.export.target import Target
from articugen.pictures.shading import linear


def _pxr(*names: str) -> list[Any]:
    """Modules of OpenUSD, of which type checkers know nothing."""
    return [import_module(f"pxr.{name}") for name in names]


def _write(item: Item, target: Target) -> None:
    name = item.key.rpartition("/")[2]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "object.usdc"  # a stage has no other way to bytes
        _fill(path, name, bodies(item, target))
        target.write(f"{item.key}.usdc", path.read_bytes())


def _fill(path: Path, name: str, parts: tuple[Body, ...]) -> None:
    Usd, UsdGeom, UsdPhysics = _pxr("Usd", "UsdGeom", "UsdPhysics")

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, f"/{_identifier(name)}")
    root.GetPrim().SetDisplayName(name)
    stage.SetDefaultPrim(root.GetPrim())
    UsdPhysics.ArticulationRootAPI.Apply(root.GetPrim())
    places: dict[int, Floats] = {}
    for part in from_the_root(parts):
        body = parts[part]
        places[part] = body.origin + (places[body.joint.parent] if body.joint else 0.0)
    for part, body in enumerate(parts):
        _add_body(stage, f"{root.GetPath()}/part_{part}", part, body, places[part])
    fixed = UsdPhysics.FixedJoint.Define(stage, f"{root.GetPath()}/to_world")
    fixed.CreateBody1Rel().SetTargets([f"{root.GetPath()}/part_0"])
    ours = [fixed.GetPrim().GetName(), *(f"part_{part}" for part in range(len(parts)))]
    joints = [_identifier(body.joint.name) for body in parts if body.joint]
    for part, joint in enumerate(unique((*ours, *joints))[len(ours) :], 1):
        _add_joint(stage, f"{root.GetPath()}/{joint}", part, parts)
    stage.GetRootLayer().Save()


def _identifier(name: str) -> str:
    """Return the name as OpenUSD takes it for a prim; led by `_` where it starts with a digit,
    which OpenUSD would put `_` in place of, so that 12692 and 22692 became one."""
    (Tf,) = _pxr("Tf")

    return Tf.MakeValidIdentifier(f"_{name}" if name[:1].isdigit() else name)


def _add_body(stage: Any, path: str, part: int, body: Body, place: Floats) -> None:
    Gf, UsdGeom, UsdPhysics = _pxr("Gf", "UsdGeom", "UsdPhysics")

    xform = UsdGeom.Xform.Define(stage, path)
    xform.AddTranslateOp().Set(Gf.Vec3d(*place.tolist()))
    prim = xform.GetPrim()
    prim.SetDisplayName(body.name)
    UsdPhysics.RigidBodyAPI.Apply(prim)
    mass = UsdPhysics.MassAPI.Apply(prim)
    inertia = body.inertia
    mass.CreateMassAttr(inertia.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*inertia.center.tolist()))
    moments, axes = np.linalg.eigh(inertia.tensor)  # about the principal axes
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    turn = Gf.Matrix3d(*axes.T.ravel().tolist()).ExtractRotation().GetQuat()
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(turn.GetReal(), *turn.GetImaginary()))
    visual = _add_mesh(stage, f"{path}/visual", body.mesh)
    visual.CreateDisplayColorAttr([Gf.Vec3f(*linear(colour_of(part)).tolist())])
    for k, hull in enumerate(body.hulls):
        felt = _add_mesh(stage, f"{path}/convex_{k}", hull)
        felt.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(felt.GetPrim())
        shape = UsdPhysics.MeshCollisionAPI.Apply(felt.GetPrim())
        shape.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)


def _add_mesh(stage: Any, path: str, mesh: Mesh) -> Any:
    UsdGeom, Vt = _pxr("UsdGeom", "Vt")

    prim = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(mesh.vertices.astype(np.float32))
    prim.CreatePointsAttr(points)
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.ravel()))
    prim.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return prim


def _add_joint(stage: Any, path: str, part: int, parts: tuple[Body, ...]) -> None:
    Gf, UsdPhysics = _pxr("Gf", "UsdPhysics")

    body, own, root = parts[part], parts[part].joint, path.rpartition("/")[0]
    assert own is not None
    revolute = own.kind == "revolute"
    kind = UsdPhysics.RevoluteJoint if revolute else UsdPhysics.PrismaticJoint
    joint = kind.Define(stage, path)
    joint.GetPrim().SetDisplayName(own.name)
    joint.CreateBody0Rel().SetTargets([f"{root}/part_{own.parent}"])
    joint.CreateBody1Rel().SetTargets([f"{root}/part_{part}"])
    joint.CreateAxisAttr("X")
    turn = Gf.Quatf(Gf.Rotation(Gf.Vec3d(1, 0, 0), Gf.Vec3d(*own.axis.tolist())).GetQuat())
    joint.CreateLocalPos0Attr(Gf.Vec3f(*np.asarray(body.origin).tolist()))
    joint.CreateLocalPos1Attr(Gf.Vec3f(0.0))
    joint.CreateLocalRot0Attr(turn)
    joint.CreateLocalRot1Attr(turn)
    unit = np.degrees(1.0) if revolute else 1.0
    joint.CreateLowerLimitAttr(own.lower * unit)
    joint.CreateUpperLimitAttr(own.upper * unit)
    drive = UsdPhysics.DriveAPI.Apply(joint.GetPrim(), "angular" if revolute else "linear")
    drive.CreateStiffnessAttr(0.0)
    drive.CreateDampingAttr(damping(parts, part) / unit)


FORMAT = Format(
    "each object as USD with UsdPhysics joints, which collides with --collision",
    of_objects,
    _write,
    takes=("resolution", "from_grids", "collision"),
    needs=(("pxr", "export"),),
)
