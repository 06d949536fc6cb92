"""The box of all poses, against moving every point to every pose."""

import numpy as np
import pytest

from articugen.core.geometry import apply, rotation_about, transform
from articugen.core.records import LabelledMesh
from articugen.instance.swept import swept_box


def naive(mesh: LabelledMesh, motions: np.ndarray) -> np.ndarray:
    points = [
        apply(T, mesh.vertices[mesh.faces[mesh.part_of_face == part]].reshape(-1, 3))
        for part in np.unique(mesh.part_of_face)
        for T in motions[:, part]
    ]
    every = np.concatenate(points)
    return np.stack([every.min(axis=0), every.max(axis=0)])


@pytest.mark.parametrize("shape", ["cloud", "shell", "plate", "point", "far"])
def test_swept_box_is_that_of_all_points_in_all_poses(shape):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(3000, 3))
    if shape == "shell":
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    if shape == "plate":
        points[:, 1] = 0.25
    if shape == "point":
        points[:] = 0.0
    if shape == "far":
        points += 1e6
    faces = rng.permutation(2400).reshape(-1, 3).astype(np.int32)  # the last ones are of no face
    mesh = LabelledMesh(points, faces, np.repeat([0, 2], 400).astype(np.uint8))
    turns = [rotation_about((0.6, 0.0, 0.8), angle) for angle in rng.uniform(-2, 2, 20)]
    moved = [transform(turn, rng.normal(size=3)) for turn in turns]
    motions = np.stack([np.stack([np.eye(4), np.eye(4), T]) for T in moved])
    assert np.array_equal(swept_box(mesh, motions), naive(mesh, motions))
