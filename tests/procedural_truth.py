"""Procedural objects in tests: where their links stand, how they are closed, whether they meet."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from articugen.core.geometry import apply
from articugen.core.records import ArticulatedObject, Floats, JointState, Mesh
from articugen.instance.articulation import forward_kinematics
from articugen.procedural import build_model
from articugen.procedural.kit.model import Model
from articugen.procedural.kit.solids import PLANE, Solid
from articugen.procedural.kit.writer import TRUTH_NAME, URDF_NAME, write_model
from articugen.procedural.truth import Truth, read_truth
from articugen.sources.urdf import load_urdf

CONTACT = 1e-9
"""Metres: how deep rounding alone may have one part in another."""

L_SHAPE = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], dtype=float)


def object_id(category: str, index: int) -> str:
    """The id of a category's object number `index`, for instance "laptop_0003"."""
    return f"{category}_{index:04d}"


model_of = lru_cache(96)(build_model)  # all laptops


def written(
    category: str, object_id: str, folder: Path, *, messy: int = 0, varied: bool = False
) -> tuple[ArticulatedObject, Truth]:
    """An object written to `folder`, read back, and its truth."""
    about = {"object_id": object_id, "category": category}
    write_model(model_of(category, object_id, varied=varied), folder, messy=messy, **about)
    truth = read_truth((folder / TRUTH_NAME).read_bytes())
    return load_urdf(folder / URDF_NAME, **about), truth


def link_frames(obj: ArticulatedObject, q: Floats) -> dict[str, Floats]:
    """T_world_link (4, 4) of each link by its name."""
    posed = forward_kinematics(obj, JointState(q))
    return {link.name: T for link, T in zip(obj.links, posed.T_world_link, strict=True)}


def random_state(obj: ArticulatedObject, rng: np.random.Generator) -> Floats:
    return np.array([rng.uniform(j.lower, j.upper) for j in obj.moving_joints])


def is_closed(faces: NDArray[np.int32]) -> bool:
    """Every directed edge once, and its opposite once: a closed, consistently wound surface."""
    a, b = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    count = faces.max() + 1
    ways = np.sort(a * count + b)
    return bool(np.all(np.diff(ways) > 0) and np.array_equal(ways, np.sort(b * count + a)))


def mesh_volume(solid: Solid) -> float:
    """The volume that the boundary encloses, by the divergence theorem; positive if outward."""
    a, b, c = np.moveaxis(solid.vertices[solid.faces], 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def warped(solid: Solid) -> float:
    """The volume between faces of more than three corners and their planes, at most: cells end at
    the planes, the boundary at the corners, which lie off them by `PLANE` at most."""
    most = 0.0
    for face in {face for cell in solid.cells for face in cell if len(face) > 3}:
        corners = solid.vertices[list(face)] - solid.vertices[list(face)].mean(axis=0)
        normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0) / 2.0  # by area
        off = np.abs(corners @ normal).max()
        assert off <= PLANE * np.linalg.norm(normal)
        most += off
    return float(most)


def assert_sound(model: Model) -> None:
    """Every solid is closed, wound outward, of convex cells, and as large as its cells together,
    but for what lies between sides that are nearly plane and their planes."""
    for link in model.links:
        for k, solid in enumerate(link.solids):
            name = f"{link.name}, solid {k}"
            assert is_closed(solid.faces), name
            assert len(solid.half_spaces) == len(solid.cells), name
            volume = solid.volume
            assert volume > 0.0, name
            off, bound = abs(mesh_volume(solid) - volume), 1e-9 * volume + 1e-15
            assert off < bound or off < bound + warped(solid), name


def crossings(
    obj: ArticulatedObject, truth: Truth, q: Floats, *, clearance: float = 0.0
) -> dict[tuple[str, str], float]:
    """Pairs of links (a, b) of which an edge of a's mesh runs through the inside of b, and how deep
    at least, metres. Of two closed meshes that cross, one has such an edge: nothing is sampled.

    Args:
        clearance: by how much b's faces are moved outwards first.
    """
    T = link_frames(obj, q)
    planes, first, boxes = truth._posed(T)
    boxes = boxes + np.array([[-clearance], [clearance]])
    edges = {link: _edges(obj, link, T[link]) for link in truth.links}
    depths = {}
    for k, link in enumerate(truth.links):
        cells = np.flatnonzero(truth.link_of_cell == k)
        around = np.stack([boxes[cells, 0].min(axis=0), boxes[cells, 1].max(axis=0)])
        for other, ends in edges.items():
            near = _within(ends, _spans(ends), around) if other != link else ends[:, :0]
            if not near.shape[1]:
                continue
            low, high = near.min(axis=(0, 1)), near.max(axis=(0, 1))
            spans = _spans(near)
            for c in cells[np.all((boxes[cells, 0] < high) & (boxes[cells, 1] > low), axis=1)]:
                some = _within(near, spans, boxes[c])
                if some.shape[1]:
                    deep = _depth_along(some, planes[first[c] : first[c + 1]], clearance)
                    depths[other, link] = max(depths.get((other, link), 0.0), deep)
    return {pair: deep for pair, deep in depths.items() if deep > CONTACT}


def _spans(ends: Floats) -> Floats:
    """(2, E, 3) the boxes of segments (2, E, 3)."""
    return np.stack([np.minimum(*ends), np.maximum(*ends)])


def _within(ends: Floats, spans: Floats, box: Floats) -> Floats:
    """Of segments (2, E, 3) those whose boxes `spans` meet `box` (2, 3)."""
    meets = (spans[0] < box[1]) & (spans[1] > box[0])
    return ends[:, meets[:, 0] & meets[:, 1] & meets[:, 2]]


def _edges(obj: ArticulatedObject, link: str, T_world_link: Floats) -> Floats:
    """(2, E, 3) both ends of each edge of a link's mesh, in the world."""
    mesh = obj.links[obj.link_index[link]].mesh
    return apply(T_world_link, mesh.vertices)[_ends(mesh)]


@lru_cache(64)
def _ends(mesh: Mesh) -> NDArray[np.int64]:
    """(2, E) the vertices at both ends of each edge."""
    a, b = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, axis=1).ravel()
    once = np.unique(np.minimum(a, b) * len(mesh.vertices) + np.maximum(a, b))
    return np.stack(np.divmod(once, len(mesh.vertices)))


def _depth_along(ends: Floats, planes: Floats, clearance: float) -> float:
    """The most that the middle of what a cell holds of a segment lies behind all of its planes
    (Cyrus and Beck 1978); 0 where it holds nothing of any."""
    room = planes[:, 3] + clearance - ends[0] @ planes[:, :3].T
    speed = (ends[1] - ends[0]) @ planes[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = room / speed
    enters = np.where(speed < 0.0, at, 0.0).max(axis=1)
    leaves = np.where(speed > 0.0, at, 1.0).min(axis=1)
    middle = (np.clip(enters, 0.0, 1.0) + np.clip(leaves, 0.0, 1.0)) / 2
    return max(0.0, float((room - middle[:, None] * speed).min(axis=1).max()))


def heights(
    obj: ArticulatedObject, truth: Truth, points: Floats, T_world_link: dict[str, Floats]
) -> Floats:
    """(n, P) how high each world point stands over the solids of each part, or less; negative
    inside, where it is how deep it lies in the one cell that it lies deepest in, or less."""
    planes, first, _ = truth._posed(T_world_link)
    over = np.concatenate([
        np.maximum.reduceat(some @ planes[:, :3].T - planes[:, 3], first[:-1], axis=1)
        for some in np.array_split(points, len(points) // 1000 + 1)
    ])  # fmt: skip
    part = np.array([obj.part_of_link[obj.link_index[name]] for name in truth.links])
    part = part[truth.link_of_cell]
    return np.stack([over[:, part == k].min(axis=1) for k in range(obj.part_count)], axis=1)


def truth_of(*solids: Solid) -> Truth:
    """A truth whose link k is solid k."""
    planes = [p for s in solids for p in s.half_spaces]
    return Truth(
        links=tuple(f"link{k}" for k in range(len(solids))),
        link_of_cell=np.repeat(np.arange(len(solids)), [len(s.cells) for s in solids]),
        first_plane=np.cumsum([0, *map(len, planes)]),
        planes=np.concatenate(planes),
        boxes=np.concatenate([s.cell_bounds for s in solids]),
    )
