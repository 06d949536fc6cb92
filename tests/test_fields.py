"""Part fields of known shapes: their surfaces, and how well they fit what is held out."""

import numpy as np
import pytest
import torch
from ppd_data import write_boxes

from articugen.learning import fields
from articugen.learning.data.batch import BatchSpec
from articugen.learning.data.split import load_split
from articugen.learning.fields import (
    fields_near_surfaces,
    fields_on_grid,
    held_out_fit,
    in_blocks,
    meshes_of_greatest,
    reconstruction_of,
)
from articugen.meshes.distances import distance

CENTRES = np.array([[0.0, 0.1, 0.0], [0.2, -0.2, 0.1], [0.0, 0.0, 0.0]])
RADII = 0.2, 0.15, -0.1


class Balls:
    """The fields of two balls, and of a part that is nowhere; notes how many points it is asked."""

    def __init__(self):
        self.asked = []

    def __call__(self, points, parts=slice(None)):
        self.asked.append(len(points))
        p = points.double().numpy()
        far = [r - np.linalg.norm(p - c, axis=1) for c, r in zip(CENTRES, RADII, strict=True)]
        return 20.0 * np.stack(far)[parts]


def test_each_ball_has_its_surface_and_what_is_nowhere_none():
    found = reconstruction_of(Balls(), 3, 32)
    assert set(found.part.tolist()) == {0, 1}
    assert (found.parts, found.T_part, found.joints) == (3, None, None)
    for part in (0, 1):
        corners = found.triangles[found.part == part].reshape(-1, 3)
        away = np.linalg.norm(corners - CENTRES[part], axis=1)
        assert away.max() < RADII[part] + 1e-3
        assert np.abs(away - RADII[part]).min() < 1e-3
    assert distance(CENTRES[:1], found.whole)[0] == pytest.approx(RADII[0], abs=2e-3)
    volume = 4 / 3 * np.pi * (0.2**3 + 0.15**3)  # they hardly overlap
    assert found.occupied.mean() == pytest.approx(volume, rel=0.05)


def test_a_fine_grid_need_only_be_evaluated_near_surfaces(monkeypatch):
    monkeypatch.setattr(fields, "DENSE", 16)
    balls = Balls()
    parts, fine = fields_near_surfaces(balls, 32)
    assert parts.tolist() == [0, 1]
    assert sum(balls.asked) < 0.5 * 32**3
    own, whole = meshes_of_greatest(fine)
    (*both, nowhere), union = meshes_of_greatest(fields_on_grid(balls, 32))
    for a, b in zip([*own, whole], [*both, union], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    assert not len(nowhere)


def test_a_part_that_is_not_where_it_is_looked_for_is_not_evaluated():
    parts, grids = fields_near_surfaces(Balls(), 16, lambda: np.array([[1.0], [-9.0], [-3.0]]))
    assert parts.tolist() == [0, 2]
    np.testing.assert_array_equal(grids, fields_on_grid(Balls(), 16)[[0, 2]])


def test_blocks_are_all_points_in_their_order():
    points = torch.rand(5000, 3)
    blocks = in_blocks(points, 8)
    assert len(blocks) > 1
    assert torch.equal(torch.cat(blocks), points)


def test_the_fit_of_the_truth_and_of_nothing(tmp_path):
    data = write_boxes(tmp_path / "boxes", train=1, test=1, states=1)
    split = load_split(data, "train", BatchSpec(50), {32})
    truth = iter(split.grids[32] > 0)

    def known(cloud, points):
        """The truth, by two parts of which each has what lies on its side of x = 0."""
        assert (cloud.shape, points.shape) == ((1, 50, 3), (1, 32**3, 3))
        logit = torch.where(next(truth), 30.0, -30.0)
        side = points[0, :, 0] > 0
        return torch.stack([logit - 99.0 * side, logit - 99.0 * ~side])

    fit = held_out_fit(known, split.surface[:, :50], split)
    assert fit == pytest.approx({"rec": 0.0, "iou": 1.0, "parts": 2.0}, abs=1e-6)

    def nothing(_cloud, points):
        return torch.full((3, points.shape[1]), -1.0)

    fit = held_out_fit(nothing, split.surface[:, :50], split)
    assert (fit["iou"], fit["parts"]) == (0.0, 0.0)
    inside = float((split.grids[32] > 0).float().mean())
    wanted = inside * np.log1p(np.e) + (1 - inside) * np.log1p(np.exp(-1.0))
    assert fit["rec"] == pytest.approx(wanted, rel=1e-5)
