"""One model checked: its parts, its joints, and what is amiss, the worst first."""

import json
import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from articugen import fusion
from articugen.core.arrays import Floats
from articugen.core.backends import backend_named
from articugen.core.content import VERSION
from articugen.core.errors import RejectedInstance
from articugen.core.geometry import apply, bounds, box_corners, points_on_triangles, voxel_centres
from articugen.core.portable import norm
from articugen.core.recipe import Recipe, ViewSettings
from articugen.core.records import (
    ENCLOSED,
    ArticulatedObject,
    Joint,
    JointKind,
    JointState,
    LabelledMesh,
    Normalization,
)
from articugen.core.seeding import generator
from articugen.inspection.check.faces import BENEATH, Faces, Soup
from articugen.instance import articulation
from articugen.instance.preparing import MOST_PARTS, canonical_mesh, names_of, own_solid, solid_part
from articugen.meshes.bvh import joined_trees
from articugen.rendering.views import fusion_views

RECIPE = Recipe(name="check", views=ViewSettings(count=60, resolution=192))
"""Fewer and smaller views than data are made with: of 80 real models one other finding, sheets."""
TOO_DEEP = RECIPE.articulation.collision_depth
"""Unit frame: parts that are deeper in one another than at rest by that collide."""
STATES = 8  # of each joint alone, from end to end of its range; of all of them, at random
LATTICE = 32  # points along an edge of a box where it is asked what is solid
THIN = 0.05  # share of the surface behind which a wall is no thicker than `thickness`

FINDINGS = {
    "open": "edges of a single face: no closed surface, inside and outside are one",
    "two-sided": "faces on faces of opposite winding: winding numbers are 0 everywhere",
    "flipped": "closed pieces inside out, or neighbours that disagree about the outside",
    "sheets": "surfaces without thickness, seen from both sides: they have no inside",
    "unlike": "closed, but faces wind around another solid than is seen from outside",
    "crossing": "faces that go through one another inside a part",
    "not manifold": "edges of three faces and more",
    "rest": "the default state, 0, lies outside the joint's limits",
    "limits": "a joint without limits, or with no range between them",
    "pivot": "a hinge farther from its part than half of that part's length",
    "axis": "an axis that is not of unit length: readers disagree about the motion",
    "collides": "parts run into one another inside the joint's range",
    "together": "parts run into one another where several joints move, though not where one does",
    "overlap": "parts deep in one another at rest",
}
"""What each kind of finding means, the worst first."""
VERDICTS = ("sound", "findings", "unreadable")


@dataclass(frozen=True)
class Finding:
    """Something amiss: a `kind`, one of `FINDINGS`, and where, how much."""

    kind: str
    text: str


@dataclass(frozen=True)
class PartChecked(Faces):
    """A part alone at rest. Lengths are in the unit of its file.

    Attributes:
        name, semantic: of its first link.
        area: of its surface, coincident faces counting once.
        sheets: share of the area that is seen from both sides, without thickness.
        thickness: behind 5 % of the other faces, another one lies no deeper; None if none does.
        volume: of its material: what our fusion takes for solid.
        enclosed: of that, what its faces do not wind around, as cavities; None of an open or
            two-sided part.
        iou: of its material and what its faces wind around; None of an open part.
    """

    name: str
    semantic: str
    area: float
    sheets: float
    thickness: float | None
    volume: float
    enclosed: float | None
    iou: float | None


@dataclass(frozen=True)
class JointChecked:
    """A joint, moved alone. Lengths are in the unit of its file, angles in radians.

    Attributes:
        name, kind: of the joint.
        lower, upper: its limits; None where it has none.
        at_rest: the value of the default state.
        axis_length: of the axis in the file.
        pivot_distance: of the axis of a hinge from the nearest point of its part, whose longest
            edge is `part_length`; 0 where it slides.
        colliding: share of the states along its range in which parts collide.
        depth: how much deeper than at rest, in the worst of them, one of `between` is in the other.
    """

    name: str
    kind: str
    lower: float | None
    upper: float | None
    at_rest: float
    axis_length: float
    pivot_distance: float
    part_length: float
    colliding: float
    depth: float
    between: tuple[str, ...]


@dataclass(frozen=True)
class Checked:
    """A model, checked. Volumes and lengths are in the unit of its file.

    Attributes:
        name, path: of the model.
        problem: why it cannot be read or checked; None where it was.
        findings: what is amiss, the worst first.
        parts, joints: the first part stands still, joint j moves part j + 1.
        volume: of all material.
        enclosed: of space that is shut in between parts.
        overlap: how deep parts are in one another at rest, at most.
        together: how much deeper than at rest at most, at random states of all joints, those are
            that do not collide where joints move alone.
        seconds: it took.
        picture: an address that holds one; "" where none was wanted.
    """

    name: str
    path: str
    problem: str | None = None
    findings: tuple[Finding, ...] = ()
    parts: tuple[PartChecked, ...] = ()
    joints: tuple[JointChecked, ...] = ()
    volume: float = 0.0
    enclosed: float = 0.0
    overlap: float = 0.0
    together: float = 0.0
    seconds: float = 0.0
    picture: str = ""

    @property
    def verdict(self) -> str:
        return "unreadable" if self.problem else "findings" if self.findings else "sound"


@dataclass(frozen=True)
class Checks:
    """Models, checked."""

    models: tuple[Checked, ...]

    @property
    def ok(self) -> bool:
        """True where all can be read and nothing is amiss."""
        return all(model.verdict == "sound" for model in self.models)

    def counts(self) -> Counter[str]:
        """Count the models of each verdict, and those with each kind of finding."""
        kinds = (finding.kind for model in self.models for finding in model.findings)
        return Counter([*(model.verdict for model in self.models), *kinds])

    def json(self) -> str:
        """Return all numbers; the fields are those of `Checked`, `PartChecked`, `JointChecked`."""
        rows = [{"verdict": model.verdict} | asdict(model) for model in self.models]
        for row in rows:
            del row["picture"]
        return json.dumps({"articugen": VERSION, "models": rows}, indent=1, allow_nan=False)


def check_model(obj: ArticulatedObject, name: str, path: str) -> Checked:
    """Check a model as its file has it, whatever a recipe would make of its joints.

    Raises:
        RejectedInstance: it has no faces, no extent, or too many parts.
    """
    start = time.monotonic()
    if obj.part_count > MOST_PARTS:
        raise RejectedInstance(f"{obj.part_count} parts; at most {MOST_PARTS} can be checked")
    model = _Model(obj)
    rest = model.depths(model.rest)
    parts = tuple(map(model.part, range(obj.part_count)))
    joints = tuple(model.joint(j, rest) for j in range(obj.part_count - 1))
    checked = Checked(
        name,
        path,
        parts=parts,
        joints=joints,
        volume=sum(part.volume for part in parts),
        enclosed=model.enclosed(),
        overlap=float(rest.max()) * model.unit.scale,
        together=model.together(rest) * model.unit.scale,
        seconds=time.monotonic() - start,
    )
    return replace(checked, findings=tuple(_findings(checked, model.unit.scale)))


class _Model:
    """A model at rest, in a unit frame that it fills."""

    def __init__(self, obj: ArticulatedObject) -> None:
        self.obj, self.names = obj, names_of(obj)[1]
        self.rest = articulation.canonical_state(obj)
        self.posed = articulation.forward_kinematics(obj, self.rest)
        world = canonical_mesh(obj, self.posed)
        box = bounds(world.vertices[world.faces].reshape(-1, 3))
        extent = float(np.ptp(box, axis=0).max())
        if not extent > 0.0:
            raise RejectedInstance("it has no extent: all its vertices coincide")
        self.unit = Normalization(box.mean(axis=0), extent / (1.0 - RECIPE.padding))
        mesh = LabelledMesh(self.unit.to_unit(world.vertices), world.faces, world.part_of_face)
        soups = [mesh.part(k) for k in range(obj.part_count)]
        self.soups = [Soup(soup) for soup in soups]
        self.solids = [solid_part(soup, RECIPE) for soup in soups]
        self.materials = tuple(own_solid(solid, RECIPE) for solid in self.solids)
        self.mesh = LabelledMesh.joined([solid.mesh for solid in self.solids])
        if not len(self.mesh.faces):
            raise RejectedInstance("it has no faces: those of its links have no area")
        self.bvh = joined_trees([solid.tree for solid in self.solids])
        self.colliding = fusion.Colliding.of(self.mesh, self.bvh, rng=generator(0, "check"))
        self.alone = np.zeros((obj.part_count,) * 2)  # how much deeper joints that move alone bring

    def part(self, k: int) -> PartChecked:
        soup, solid, scale = self.soups[k], self.solids[k], self.unit.scale
        single, faces = soup.single, soup.counted()
        sheets = (len(solid.mesh.vertices) - len(np.unique(single.faces))) // 6  # a slab has six
        kept = solid.mesh.faces[: len(single.faces) - sheets]
        area = float(fusion.face_areas(single.vertices, single.faces).sum())
        deep = float(fusion.face_areas(solid.mesh.vertices, kept).sum())
        points = _lattice(solid.box)
        material, wound = self.materials[k].holds(points), soup.winds_around(points)
        one = float(np.prod(np.ptp(solid.box, axis=0) * scale)) / len(points)
        either = (material | wound).sum()
        winds = faces.is_closed and faces.two_sided < 0.5
        return PartChecked(
            **vars(faces),
            name=self.names[k],
            semantic=names_of(self.obj)[2][k],
            area=area * scale**2,
            sheets=1.0 - deep / area if sheets else 0.0,
            thickness=_thickness(solid, kept[solid.seen[: len(kept)]], scale),
            volume=one * float(material.sum()),
            enclosed=one * float((material & ~wound).sum()) if winds else None,
            iou=float((material & wound).sum() / either) if faces.is_closed and either else None,
        )

    def joint(self, j: int, rest: Floats) -> JointChecked:
        """Check joint j; `rest` are the `depths` at rest."""
        joint, part = self.obj.moving_joints[j], self.colliding.points[j + 1]
        states = [articulation.driven_state(self.obj, {joint.name: q}) for q in _values(joint)]
        deeper = np.stack([0.0 * rest, *(self.depths(state) - rest for state in states)])
        self.alone = np.maximum(self.alone, deeper.max(axis=0))
        bad = deeper.max(axis=(1, 2)) > TOO_DEEP
        worst = np.unravel_index(np.argmax(deeper), deeper.shape)
        away, axis = part - self.unit.to_unit(self.posed.pivots[j]), self.posed.axes[j]
        off = norm(away - (away @ axis)[:, None] * axis).min(initial=np.inf)
        hinge = joint.kind != JointKind.PRISMATIC and len(part)
        return JointChecked(
            name=joint.name,
            kind=str(joint.kind),
            lower=joint.lower if math.isfinite(joint.lower) else None,
            upper=joint.upper if math.isfinite(joint.upper) else None,
            at_rest=float(self.rest.q[j]),
            axis_length=joint.axis_length,
            pivot_distance=float(off) * self.unit.scale if hinge else 0.0,
            part_length=float(np.ptp(self.solids[j + 1].box, axis=0).max()) * self.unit.scale,
            colliding=float(bad.sum() / max(len(states), 1)),
            depth=float(deeper[worst]) * self.unit.scale if bad.any() else 0.0,
            between=tuple(self.names[k] for k in worst[1:]) if bad.any() else (),
        )

    def together(self, rest: Floats) -> float:
        """Compute `Checked.together`, in the unit frame, once each joint was checked alone."""
        ranges = {joint.name: _values(joint) for joint in self.obj.moving_joints}
        drawn = {name: values for name, values in ranges.items() if len(values)}
        rng, deeper = generator(0, "check", "together"), np.zeros_like(rest)
        for _ in range(STATES if len(drawn) > 1 else 0):
            state = {name: rng.uniform(values[0], values[-1]) for name, values in drawn.items()}
            depths = self.depths(articulation.driven_state(self.obj, state))
            deeper = np.maximum(deeper, depths - rest)
        return float(deeper[self.alone <= TOO_DEEP].max())

    def depths(self, state: JointState) -> Floats:
        """Return (P, P) how deep parts are in one another; 0 where they have not moved apart."""
        motion = articulation.motions_of(self.obj, [state], self.posed)[0]
        motion = self.unit.rigid_to_unit(motion)
        corners = [apply(T, box_corners(s.box)) for T, s in zip(motion, self.solids, strict=True)]
        low, high = np.min(corners, axis=1), np.max(corners, axis=1)
        near = (low[:, None] <= high[None]).all(axis=2)
        moved = np.abs(motion[:, None] - motion[None]).max(axis=(2, 3)) > 1e-9
        pairs = near & near.T & (moved if state is not self.rest else np.eye(len(motion)) == 0.0)
        return self.colliding.depths(
            fusion.PosedSolids(self.materials, motion, RECIPE.fusion), pairs=pairs
        )

    def enclosed(self) -> float:
        """Return the space that no view sees and no part holds."""
        still, box = np.tile(np.eye(4), (self.obj.part_count, 1, 1)), bounds(self.mesh.vertices)
        views = fusion_views(RECIPE.views, box)
        maps = backend_named(RECIPE.views.backend).render(self.mesh, views, keep_depth=False)
        whole = fusion.fuse(maps, self.mesh, RECIPE.fusion, bvh=self.bvh, part_motion=still)
        material = fusion.PosedSolids(self.materials, still, RECIPE.fusion)
        label = fusion.PosedFields(whole, material).labels(_lattice(box))
        return float(np.prod(np.ptp(box, axis=0) * self.unit.scale) * (label == ENCLOSED).mean())


def _lattice(box: Floats) -> Floats:
    """Return the centres of `LATTICE`^3 cells that fill a box (2, 3)."""
    return box.mean(axis=0) + voxel_centres(LATTICE) * np.ptp(box, axis=0)


def _values(joint: Joint) -> Floats:
    """Return the values through which a joint is moved: a turn where a hinge has no end; none of a
    joint that follows another, or has no range."""
    most = 0.0 if joint.kind == JointKind.PRISMATIC else math.pi
    lower = joint.lower if math.isfinite(joint.lower) else min(-most, joint.upper)
    upper = joint.upper if math.isfinite(joint.upper) else max(most, lower)
    moves = joint.mimic is None and lower < upper
    return np.linspace(lower, upper, STATES if moves else 0)


def _thickness(solid: fusion.SolidPart, faces: NDArray[np.int32], scale: float) -> float | None:
    """Compute `PartChecked.thickness` of `faces` that can be seen and are no sheets, by halving."""
    if not len(faces):
        return None
    vertices = solid.mesh.vertices
    points, face = points_on_triangles(vertices[faces], 1024, rng=generator(0, "check"))
    inwards = -fusion.face_normals(vertices, faces)[face]
    points, inwards = (points + BENEATH * inwards).astype(np.float32), inwards.astype(np.float32)

    def is_met(reach: float) -> bool:
        met = fusion.way_meets(points, inwards, np.float32(reach), solid.tree)
        return bool(met.mean() >= THIN)

    low, high = 0.0, 2.0
    if not is_met(high):
        return None
    while high - low > BENEATH:
        middle = (low + high) / 2.0
        low, high = (low, middle) if is_met(middle) else (middle, high)
    return (high + BENEATH) * scale


def _findings(checked: Checked, scale: float) -> Iterator[Finding]:
    """Yield what is amiss in the order of `FINDINGS`."""
    amiss = [(kind, f"{part.name} {text}") for part in checked.parts for kind, text in _of(part)]
    amiss += [(k, f"{joint.name} {text}") for joint in checked.joints for k, text in _moved(joint)]
    if checked.together > TOO_DEEP * scale:
        amiss.append(("together", f"{checked.together:.2g} deeper than alone"))
    if checked.overlap > 2.0 * TOO_DEEP * scale:
        amiss.append(("overlap", f"{checked.overlap:.2g} deep"))
    for kind in FINDINGS:
        texts = [text for its_kind, text in amiss if its_kind == kind]
        if texts:
            more = f" and {len(texts) - 3} more" if len(texts) > 3 else ""
            yield Finding(kind, ", ".join(texts[:3]) + more)


def _of(part: PartChecked) -> Iterator[tuple[str, str]]:
    """Yield the kinds of findings of a part, each with how much."""
    unlike = part.iou is not None and part.iou < 0.9 and part.two_sided < 0.5
    kinds = (
        ("open", part.open_edges, f"{part.open_edges:,} edges"),
        ("two-sided", part.two_sided > 0.01, f"{part.two_sided:.0%}"),
        ("flipped", part.flipped_pieces, f"{part.flipped_pieces:,} pieces"),
        ("flipped", part.turned_edges, f"{part.turned_edges:,} edges"),
        ("sheets", part.sheets > 0.01, f"{part.sheets:.0%}"),
        ("unlike", unlike, f"IoU {part.iou or 0.0:.2f}"),
        ("crossing", part.crossings, f"{part.crossings:,} pairs"),
        ("not manifold", part.crowded_edges, f"{part.crowded_edges:,} edges"),
    )
    yield from ((kind, much) for kind, there, much in kinds if there)


def _moved(joint: JointChecked) -> Iterator[tuple[str, str]]:
    """Yield the same of a joint."""
    lower = -math.inf if joint.lower is None else joint.lower
    upper = math.inf if joint.upper is None else joint.upper
    if not lower - 1e-6 <= joint.at_rest <= upper + 1e-6:
        yield "rest", f"at {joint.at_rest:.3g}, not in {lower:.3g} to {upper:.3g}"
    if lower == upper or (joint.kind != "continuous" and math.inf in (-lower, upper)):
        yield "limits", f"{lower:.3g} to {upper:.3g}"
    if joint.pivot_distance > 0.5 * joint.part_length:
        yield "pivot", f"{joint.pivot_distance:.3g} away"
    if abs(joint.axis_length - 1.0) > 1e-3:
        yield "axis", f"of length {joint.axis_length:.3g}"
    if joint.colliding:
        between = " in ".join(joint.between)
        yield "collides", f"in {joint.colliding:.0%} of its range ({between}, {joint.depth:.2g})"
