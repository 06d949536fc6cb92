import numpy as np
from numba import njit

from articugen.core.geometry import invert_rigid, rotation_about, transform
from articugen.meshes.bvh import joined_trees, meets, tree_of
from tests.shapes import Convex, box, labelled, rotated


@njit
def _meet_all(points, directions, to_part, h):
    met = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        p = (points[i, 0], points[i, 1], points[i, 2])
        w = (directions[i, 0], directions[i, 1], directions[i, 2])
        met[i] = meets(
            p, w, np.float32(np.inf), to_part, h.box, h.skip, h.leaf, h.triangles, h.roots
        )
    return met


def test_rays_meet_what_the_exact_solids_say():
    rng = np.random.default_rng(0)
    solids = [
        rotated(box(rng.uniform(0.02, 0.2, 3), rng.uniform(-0.4, 0.4, 3)), rng.uniform(0, 3), axis)
        for axis in rng.normal(size=(40, 3))
    ]
    mesh = labelled(*solids)
    two_parts = (mesh.part_of_face >= 20).astype(np.uint8)
    corners = mesh.vertices[mesh.faces]
    bvh = joined_trees([tree_of(corners[two_parts == part]) for part in (0, 1)])
    T = transform(rotation_about((0, 0.6, 0.8), 0.5), (0.1, 0.05, -0.1))
    motion = np.stack([np.eye(4), T])
    for k in range(20, 40):
        solids[k].apply_transform(T)
    truth = Convex.of(*solids)

    points = rng.uniform(-0.5, 0.5, (4000, 3))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    seen = truth.seen_free(points, direction[None])
    met = _meet_all(
        points.astype(np.float32),
        np.repeat(direction[None], len(points), axis=0).astype(np.float32),
        np.ascontiguousarray(invert_rigid(motion)[:, :3], np.float32),
        bvh,
    )
    assert 0.2 < seen.mean() < 0.8
    assert np.mean(met == ~seen) > 0.9995  # single precision, at the very edges


def test_every_face_is_in_one_leaf():
    mesh = labelled(box((1, 1, 1)), box((0.5, 0.5, 0.5)), box((0.1, 0.1, 0.1)))
    parts = [mesh.part(k) for k in range(4)]  # part 3 has no faces
    h = joined_trees([tree_of(part.vertices[part.faces]) for part in parts])
    assert list(h.roots[-2:]) == [h.roots[-1]] * 2
    held = [f for first, count in h.leaf for f in range(first, first + count)]
    assert sorted(held) == list(range(36))
    assert np.all(h.skip > np.arange(len(h.skip)))
