"""Procedural objects in tests: where their links stand, how they are closed, whether they meet."""

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from articugen.articulation import forward_kinematics
from articugen.geometry import apply, points_on_triangles
from articugen.records import ArticulatedObject, Floats, JointState
from articugen.sources.procedural import write_object
from articugen.sources.procedural.kit.model import Model
from articugen.sources.procedural.kit.solids import Solid
from articugen.sources.procedural.truth import Truth, load_truth
from articugen.sources.urdf import load_urdf

L_SHAPE = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], dtype=float)


def object_id(category: str, index: int) -> str:
    """The id of a category's object number `index`, for instance "laptop_0003"."""
    return f"{category}_{index:04d}"


def written(
    category: str, object_id: str, folder: Path, *, messy: bool = False, varied: bool = False
) -> tuple[ArticulatedObject, Truth]:
    """An object written to `folder`, read back, and its truth."""
    path = write_object(category, object_id, folder, messy=messy, varied=varied)
    return load_urdf(path, object_id=object_id, category=category), load_truth(folder)


def link_frames(obj: ArticulatedObject, q: Floats) -> dict[str, Floats]:
    """T_world_link (4, 4) of each link by its name."""
    posed = forward_kinematics(obj, JointState(q))
    return {link.name: T for link, T in zip(obj.links, posed.T_world_link, strict=True)}


def random_state(obj: ArticulatedObject, rng: np.random.Generator) -> Floats:
    return np.array([rng.uniform(j.lower, j.upper) for j in obj.moving_joints])


def is_closed(faces: NDArray[np.int32]) -> bool:
    """Every directed edge once, and its opposite once: a closed, consistently wound surface."""
    edges = Counter((int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3))
    return all(n == 1 and edges[b, a] == 1 for (a, b), n in edges.items())


def mesh_volume(solid: Solid) -> float:
    """The volume that the boundary encloses, by the divergence theorem; positive if outward."""
    a, b, c = np.moveaxis(solid.vertices[solid.faces], 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def assert_sound(model: Model) -> None:
    """Every solid is closed, wound outward, of convex cells, and as large as its cells together."""
    for link in model.links:
        for k, solid in enumerate(link.solids):
            name = f"{link.name}, solid {k}"
            assert is_closed(solid.faces), name
            assert len(solid.half_spaces) == len(solid.cells), name
            assert solid.volume > 0.0, name
            assert abs(mesh_volume(solid) - solid.volume) < 1e-9 * solid.volume + 1e-15, name


def surface_points(
    obj: ArticulatedObject, link: str, count: int, rng: np.random.Generator
) -> Floats:
    """Points on a link's mesh, uniform by area, and all its vertices; in the link's frame."""
    mesh = obj.links[obj.link_index[link]].mesh
    on_faces, _ = points_on_triangles(mesh.vertices[mesh.faces], count, rng=rng)
    return np.concatenate([on_faces, mesh.vertices])


def crossings(
    obj: ArticulatedObject, truth: Truth, q: Floats, rng: np.random.Generator, count: int = 3000
) -> set[tuple[str, str]]:
    """Pairs of links (a, b) of which a's surface is somewhere inside b."""
    T = link_frames(obj, q)
    pairs = set()
    for link in truth.links:
        holds = truth.holds(apply(T[link], surface_points(obj, link, count, rng)), T)
        pairs |= {(link, o) for k, o in enumerate(truth.links) if o != link and holds[:, k].any()}
    return pairs


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
