"""The field of the whole object, from the points around each place, beside naive readings of it."""

import numpy as np
import pytest
import torch
from digests import digest, resumed_exactly
from few import FEW
from hypothesis import given
from hypothesis import strategies as st
from learners import tiny

from articugen.evaluation.metrics import nearest_part_of
from articugen.learning.data.batch import Batch
from articugen.learning.fields import divided, grid_centres, meshes_of_greatest, reconstruction_of
from articugen.learning.loop import Training, train
from articugen.learning.ppd import local
from articugen.learning.ppd.local import Around, LocalField, Outline, nearest_points
from articugen.learning.ppd.settings import PPDRecipe
from articugen.learning.run_folder import BEST, LATEST, read_checkpoint
from articugen.meshes.marching_cubes import zero_level

TINY = tiny(
    {"surface_points": 400, "uniform_points": 60, "near_points": 60, "grid_points": 0}, (4, 20),
    batch=4, learning_rate=2e-3,
)  # fmt: skip
LOCAL = TINY.model_copy(update={"model": TINY.model.model_copy(update={"local_points": 40})})


@FEW
@given(st.integers(16, 300), st.integers(1, 4), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_neighbours_are_the_nearest_of_the_first_points(points, places, digits, seed):
    """Many are equally far, where coordinates have one digit."""
    rng = np.random.default_rng(seed)
    cloud, places = (
        rng.uniform(-0.5, 0.5, (2, n, 3)).round(digits).astype(np.float32) for n in (points, places)
    )
    n = cloud.shape[1]
    near = nearest_points(torch.tensor(cloud), torch.tensor(places)).numpy()
    firsts = min(32, n), max(n // 8, min(32, n)), n
    for b, m, scale in np.ndindex(*near.shape[:3]):
        far = np.linalg.norm(cloud[b].astype(float) - places[b, m], axis=1)
        mine = near[b, m, scale]
        assert len(set(mine.tolist())) == local.NEIGHBOURS
        assert mine.max() < firsts[scale]
        nearest = np.sort(far[: firsts[scale]])[: local.NEIGHBOURS]
        np.testing.assert_allclose(far[mine], nearest, atol=1e-6)


def test_without_a_kernel_neighbours_are_the_same():
    cloud, places = torch.rand(2, 500, 3), torch.rand(2, 40, 3)
    plain = nearest_points(cloud.double(), places.double())  # no kernel takes doubles
    assert torch.equal(nearest_points(cloud, places), plain)


def layers(x, parts):
    """What a few linear layers with max(x, 0) between them make of (n, c)."""
    linear = [(p.weight.numpy(), p.bias.numpy()) for p in parts if isinstance(p, torch.nn.Linear)]
    for i, (W, b) in enumerate(linear):
        x = x @ W.T + b
        x = np.maximum(x, 0.0) if i < len(linear) - 1 else x
    return x


@torch.no_grad()
@pytest.mark.parametrize("inputs", [0, 2])
def test_what_is_around_a_place_read_literally(inputs):
    torch.manual_seed(2)
    around_it = Around(8, 16, inputs=inputs, outputs=3).double()
    cloud, places = torch.rand(2, 80, 3 + inputs).double(), torch.rand(2, 5, 3).double()
    actual = around_it(cloud, places).numpy()
    near = nearest_points(cloud[..., :3], places).numpy()
    for b, m in np.ndindex(2, 5):
        x = places[b, m].numpy()
        features = [2.0 * x]
        for i, scale in enumerate((0.25, 0.1, 0.04)):
            points = cloud[b].numpy()[near[b, m, i]]
            offset = (points[:, :3] - x) / scale
            far, at = np.linalg.norm(offset, axis=1)[:, None], np.tile(2.0 * x, (12, 1))
            around = layers(np.hstack([offset, far, at, points[:, 3:]]), around_it.near[i])
            weight = np.exp(layers(around, [around_it.weight[i]]))
            features += [around.max(0), (around * weight / weight.sum()).sum(0)]
        expected = layers(np.concatenate(features)[None], around_it.head)[0]
        assert actual[b, m] == pytest.approx(expected, abs=1e-9)


@torch.no_grad()
def test_each_point_of_a_cloud_has_the_normal_that_is_predicted_there():
    torch.manual_seed(4)
    field, clouds = LocalField(), torch.rand(2, 700, 3) - 0.5
    sided = field.sided(clouds)
    assert torch.equal(sided[..., :3], clouds)
    torch.testing.assert_close(sided[..., 3:], field.normals(clouds, clouds))


def test_the_sides_of_a_shell_are_learned_and_the_matter_between_them():
    """A ball in a ball: points of both surfaces alike, which normals tell apart."""
    rng = np.random.default_rng(0)
    learning = local.LocalLearning(64, torch.device("cpu"))
    learning.begin_stage()
    for iteration in range(150):
        learning.learn(shells(rng), iteration, 3e-3)
    batch = shells(rng)
    sided = learning.field.sided(batch.cloud)
    assert (sided[..., 3:] * batch.normals).sum(2).gt(0.0).float().mean() > 0.95
    inside = learning.field(sided, batch.points) > 0.0
    assert (inside == batch.occupied).float().mean() > 0.9


def shells(rng, samples=4):
    """Clouds, normals and query points of shells about the origin, 0.1 thick."""
    around = rng.normal(size=(samples, 512, 3))
    around /= np.linalg.norm(around, axis=2, keepdims=True)
    inner = np.arange(512)[:, None] % 2
    radius = rng.uniform(0.25, 0.4, (samples, 1, 1))
    points = rng.uniform(-0.5, 0.5, (samples, 256, 3))
    away = np.linalg.norm(points, axis=2) - radius[..., 0]
    tensors = [(radius - 0.1 * inner) * around, points, np.where(inner, -around, around)]
    cloud, points, normals = (torch.tensor(array, dtype=torch.float32) for array in tensors)
    nothing = torch.zeros(samples, 0)
    occupied = torch.tensor((away < 0.0) & (away > -0.1))
    return Batch(
        torch.arange(samples), cloud, nothing, points, occupied, 256, nothing, normals=normals
    )


@torch.no_grad()
def test_a_fine_grid_is_evaluated_near_points_and_beside_the_surface():
    torch.manual_seed(3)
    field, cloud = LocalField(), 0.2 * torch.rand(60, 3)
    sided = field.sided(cloud[None])

    def everywhere(resolution):
        return field(sided, grid_centres(resolution)[None])[0].double().numpy()

    field.matter.head[-1].bias -= np.median(everywhere(8))  # half of it inside
    outline = Outline(field, cloud)
    np.testing.assert_allclose(outline.on_grid(8).reshape(-1), everywhere(8), atol=1e-5)
    for R in (16, 32):
        grid = outline.on_grid(R).reshape(-1)
        coarser = np.kron(outline.on_grid(R // 2), np.ones((2, 2, 2))).reshape(-1)
        fine = np.isclose(grid, everywhere(R), atol=1e-5)
        assert (fine | (grid == coarser)).all()
        away = (grid_centres(R)[:, None] - cloud).abs().amax(2).amin(1).numpy()
        assert fine[away < 1 / R].all()
        assert 0.05 < fine.mean() < 0.95


class Sides:
    """The fields of two half-spaces, and of a part that is below both."""

    def __call__(self, points, parts=slice(None)):
        x = points.double().numpy()[:, 0]
        return 5.0 * np.stack([x - 0.1, 0.1 - x, -abs(x - 0.1) - 1.0])[parts]


def test_parts_share_what_lies_in_the_whole():
    """A ball, of which two half-spaces take their sides, and the third part none."""

    def ball(resolution):
        away = grid_centres(resolution).norm(dim=1).double().numpy()
        return 30.0 * (0.3 - away).reshape(3 * [resolution])

    found = reconstruction_of(Sides(), 3, 16, whole=ball)
    np.testing.assert_array_equal(found.occupied, ball(16) > 0)
    np.testing.assert_array_equal(found.whole, zero_level(ball(16)).triangles)
    assert set(found.part.tolist()) == {0, 1}
    sides = Sides()(grid_centres(16)).reshape(3, 16, 16, 16)
    grids = divided(ball(16), sides, meshes_of_greatest(sides)[0])
    np.testing.assert_allclose(grids.max(0), ball(16))
    assert (grids[0] == ball(16))[ball(16) < -3.0].all()  # nobody asks whose nothing is
    for part, sign in ((0, 1.0), (1, -1.0)):
        corners = found.triangles[found.part == part].reshape(-1, 3)
        assert (sign * (corners[:, 0] - 0.1)).min() > -1e-3
        assert np.linalg.norm(corners, axis=1).max() < 0.3 + 1e-3  # of a grid of 64^3


def test_points_are_labelled_by_parts_that_the_whole_lacks():
    def balls(points, parts=slice(None)):
        away = [(points.double() - torch.tensor([x, 0.0, 0.0])).norm(dim=1) for x in (-0.2, 0.2)]
        return 5.0 * (0.1 - np.stack(away))[parts]

    def left(resolution):
        return balls(grid_centres(resolution))[0].reshape(3 * [resolution])

    found = reconstruction_of(balls, 2, 16, whole=left)
    assert set(found.part.tolist()) == {0}
    assert nearest_part_of(found, np.array([[-0.3, 0, 0], [0.2, 0.1, 0]])).tolist() == [0, 1]


@pytest.mark.parametrize("steepness", [1.0, 50.0])
def test_outside_of_all_parts_the_nearest_decides_however_steep_fields_are(steepness):
    x = grid_centres(32).double().numpy()
    away = [np.linalg.norm(x - c, axis=1) - r for c, r in (((-0.2, 0, 0), 0.2), ((0.2, 0, 0), 0.1))]
    grids = np.stack([-away[0], -steepness * away[1], np.full(len(x), -0.01)])
    grids = grids.reshape(3, 32, 32, 32)
    surfaces, _ = meshes_of_greatest(grids)
    grids = divided(np.ones((32, 32, 32)), grids, surfaces).reshape(3, -1)
    clear = abs(away[0] - away[1]) > 1 / 32
    np.testing.assert_array_equal(grids.argmax(0)[clear], np.argmin(away, axis=0)[clear])
    nobody = divided(np.ones((4, 4, 4)), np.full((2, 4, 4, 4), -1.0), [np.zeros((0, 3, 3))] * 2)
    assert (nobody == 1.0).all()  # where no part is anywhere, none is the nearest


def test_it_learns_beside_all_else_which_stays_the_same_and_goes_on_where_it_was(boxes, tmp_path):
    plain = train(Training(TINY, "box", boxes, tmp_path / "plain"))
    run = resumed_exactly(Training(LOCAL, "box", boxes, tmp_path / "local"), 3)
    terms = [r["terms"] for r in run.metrics() if r.get("terms")]
    losses = {name: [some.pop(name) for some in terms] for name in ("local", "local_normals")}
    assert terms == [r["terms"] for r in plain.metrics() if r.get("terms")]
    assert np.mean(losses["local"][-5:]) < 0.8 * np.mean(losses["local"][:3])
    assert np.mean(losses["local_normals"][-5:]) < np.mean(losses["local_normals"][:3])


def test_the_best_checkpoint_has_the_last_local_field_which_no_validation_measures(boxes, tmp_path):
    often = {**LOCAL.schedule.model_dump(), "validate_every": 1, "learning_rate": 0.2}
    often["stages"] = [{**often["stages"][0], "iterations": 6}]  # the second is best by far
    recipe = PPDRecipe.model_validate({**LOCAL.model_dump(), "schedule": often})
    run = train(Training(recipe, "box", boxes, tmp_path))
    best, last = (read_checkpoint(run.path / name) for name in (BEST, LATEST))
    measured = [line["validation"]["rec"] for line in run.metrics() if line.get("validation")]
    assert best.iteration == 1 + int(np.argmin(measured)) < last.iteration
    assert digest(best.state["local"]) == digest(last.state["local"])
    assert digest(best.state["model"]) != digest(last.state["model"])


def test_where_nothing_is_inside_no_part_has_a_surface():
    found = reconstruction_of(Sides(), 3, 16, whole=lambda R: np.full(3 * [R], -1.0))
    assert (len(found.triangles), len(found.whole), found.occupied.any()) == (0, 0, False)
