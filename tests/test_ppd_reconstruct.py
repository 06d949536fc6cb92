"""What PPD's model says of a cloud: surfaces where its field is zero, and what is between two."""

from functools import partial

import numpy as np
import pytest
import torch
from instances import hinged_box

from articugen.core.geometry import apply
from articugen.core.records import dequantize
from articugen.learning import fields
from articugen.learning.fields import fields_on_grid, meshes_of_greatest
from articugen.learning.ppd import reconstruct as reconstruction
from articugen.learning.ppd.learner import Predictor
from articugen.learning.ppd.network import PPD
from articugen.learning.ppd.reconstruct import logits_at, reconstruction_of
from articugen.learning.ppd.settings import ModelSettings
from articugen.meshes.distances import distance


def part_logits(model, predicted, resolution):
    return fields_on_grid(partial(logits_at, model, predicted), resolution)


@pytest.mark.parametrize("part_frame", ["world", "joint"])
def test_a_model_s_surfaces_lie_where_its_field_is_zero(part_frame, monkeypatch):
    monkeypatch.setattr(ModelSettings, "part_frame", part_frame)
    torch.manual_seed(1)
    model = PPD(ModelSettings(form="release")).eval()
    (instance,) = hinged_box([(0.3, 0.1)])
    cloud = dequantize(instance.surface_points)

    def predict():
        with torch.no_grad():
            return model(torch.as_tensor(cloud, dtype=torch.float32)[None])

    middling = np.median(part_logits(model, predict(), 16).max(0))
    with torch.no_grad():  # F^{s,z} is halved by the common field, so half of the cube gets free
        model.shape.head_2.bias[8:] -= 2.0 * middling
    found = reconstruction_of(model, predict(), 16)
    assert len(found.whole)
    assert len(set(found.part.tolist())) > 1
    # A surface of the whole is the surface of some part, to within the grid's error.
    middle = found.whole.mean(1)[::20]
    assert distance(middle, found.triangles).max() < 1 / 16
    # A voxel is occupied where the field of any part is above 0 at its centre.
    logits = part_logits(model, predict(), 16)
    assert 0.1 < found.occupied.mean() < 0.9
    np.testing.assert_array_equal(found.occupied, (logits > 0).any(0))
    # T_part is what `fields` undoes.
    pose = model(torch.as_tensor(cloud, dtype=torch.float32)[None]).pose
    local = model.motion(pose).apply(torch.tensor([[[0.1, 0.2, 0.3]]]))[0, :, 0].detach().numpy()
    for i in range(8):
        np.testing.assert_allclose(apply(found.T_part[i], local[i]), [0.1, 0.2, 0.3], atol=1e-5)


def test_states_of_parts_with_boxes_count_from_where_they_are_at_rest():
    torch.manual_seed(2)
    settings = ModelSettings(form="release", part_boxes=True)
    model = PPD(settings).eval()
    with torch.no_grad():
        predicted = model(torch.rand(1, 300, 3) - 0.5)
        settled = predicted.pose.state + 0.01
    for states, more in ((None, 0.0), (settled, 0.01)):
        found = reconstruction_of(model, predicted, 8, states=states)
        rest = np.r_[0.0, [0.3] * 3, [0.05] * 4]
        expected = np.r_[0.0, predicted.pose.state[0].numpy() + more] - rest
        np.testing.assert_allclose(found.joints.state, expected, atol=1e-6)
        for i in (4, 5, 6, 7):
            slid = found.joints.state[i] * found.joints.direction[i]
            np.testing.assert_allclose(found.T_part[i, :3, 3], slid, atol=1e-6)


def test_a_part_is_not_far_outside_of_its_box():
    """Within `ROOM` times the box its field is what the model says, beyond it below 0."""
    torch.manual_seed(1)
    settings = ModelSettings(form="release", part_boxes=True)
    model = PPD(settings).eval()
    (instance,) = hinged_box([(0.3, 0.1)])
    cloud = torch.as_tensor(dequantize(instance.surface_points), dtype=torch.float32)
    points = torch.rand(500, 3) - 0.5
    with torch.no_grad():
        model.shape.box_in[-1].bias.view(-1, 6)[:, 3:] -= 0.5
        model.shape.head_2.bias += 5.0  # all of the cube would be each part's
        predicted = model(cloud[None])
        field = model.shape(predicted.shape, model.motion(predicted.pose), points[None]).product[0]
        local = model.motion(predicted.pose).apply(points[None])[0]
    box = predicted.shape.box
    off = (local - box.middle[0, :, None]).abs() / box.size[0, :, None]
    beyond = (off > reconstruction.ROOM).any(-1).numpy()
    assert 0.05 < beyond.mean() < 0.95
    found = reconstruction.logits_at(model, predicted, points)
    np.testing.assert_allclose(found[~beyond], field.numpy()[~beyond], atol=1e-5)
    assert (found[beyond] <= reconstruction._AT_MOST).all()
    assert (field.numpy()[beyond] > 0.0).any()
    far = ((off - reconstruction.ROOM) * box.size[0, :, None] > reconstruction._MARGIN).any(-1)
    assert (found[far.numpy()] == reconstruction._NOWHERE).all()
    assert (found[beyond & ~far.numpy()] > reconstruction._NOWHERE).any()


def test_interpolation_holds_what_it_holds():
    torch.manual_seed(0)
    learner = Predictor.__new__(Predictor)
    learner.model, learner.points = PPD(ModelSettings()).eval(), None
    learner.residual_direction = True
    one, other = (dequantize(i.surface_points) for i in hinged_box()[::3])
    shapes, states = learner.between(one, other, 3, resolution=16)
    first, last = learner.predict(one), learner.predict(other)
    low, high = (p.pose.state[0].double().numpy() for p in (first, last))
    assert not np.allclose(low, high)
    for found in shapes:
        np.testing.assert_array_equal(found.joints.state[1:], low)
    for found, share in zip(states, (0.0, 0.5, 1.0), strict=True):
        np.testing.assert_allclose(found.joints.state[1:], (1 - share) * low + share * high, 1e-5)
    codes = [first.shape.towards(last.shape, share) for share in (0.0, 0.5, 1.0)]
    torch.testing.assert_close(codes[0].detail, first.shape.detail)
    torch.testing.assert_close(codes[1].detail, (first.shape.detail + last.shape.detail) / 2)
    torch.testing.assert_close(codes[2].detail, last.shape.detail)
    assert not torch.equal(codes[0].detail, codes[2].detail)


def test_some_parts_alone_have_the_fields_that_they_have_among_all():
    torch.manual_seed(3)
    model = PPD(ModelSettings()).eval()
    with torch.no_grad():
        predicted = model(torch.rand(1, 64, 3) - 0.5)
    points, some = torch.rand(5000, 3) - 0.5, np.array([1, 4, 7])  # in more than one block
    every = reconstruction.logits_at(model, predicted, points)
    alone = reconstruction.logits_at(model, predicted, points, some)
    np.testing.assert_allclose(alone, every[some], atol=1e-5)
    assert np.abs(every).max() > 0.01


def test_a_part_that_is_nowhere_is_not_looked_for_on_a_finer_grid(monkeypatch):
    torch.manual_seed(1)
    model = PPD(ModelSettings(form="release")).eval()
    with torch.no_grad():
        predicted = model(torch.rand(1, 64, 3) - 0.5)
        middling = np.median(part_logits(model, predicted, 16).max(0))
        model.shape.head_2.bias[8:] -= 2.0 * middling
        model.shape.head_2.bias[8 + 3] -= 100.0
    asked, every = [], reconstruction.logits_at

    def counted(*given, **how):
        asked.append((len(given[2]), given[3:]))
        return every(*given, **how)

    monkeypatch.setattr(reconstruction, "logits_at", counted)
    found = reconstruction_of(model, predicted, 64)
    assert asked[0] == (32**3, ())
    points, (parts,) = asked[1]
    assert points == 64**3
    assert 3 not in parts
    each, whole = meshes_of_greatest(part_logits(model, predicted, 64))
    assert len(whole)
    np.testing.assert_allclose(found.whole, whole, atol=1e-6)
    np.testing.assert_allclose(found.triangles, np.concatenate(each), atol=1e-6)
    np.testing.assert_array_equal(found.part, np.repeat(np.arange(8), [len(e) for e in each]))


def test_places_all_over_a_box_are_where_the_part_s_pose_has_brought_them():
    torch.manual_seed(2)
    settings = ModelSettings(form="release", part_boxes=True)
    model = PPD(settings).eval()
    with torch.no_grad():
        model.shape.box_in[-1].bias += 0.3 * torch.rand(8 * 6) - 0.3
        predicted = model(torch.rand(1, 64, 3) - 0.5)
        motion, box = model.motion(predicted.pose), predicted.shape.box
    found = reconstruction._in_boxes(model, predicted.shape, box)
    along = (np.arange(12) + 0.5) / 6.0 - 1.0
    share = np.stack(np.meshgrid(along, along, along, indexing="ij"), -1).reshape(-1, 3)
    for part, field in enumerate(found):
        size, middle = box.size[0, part], box.middle[0, part]
        rest = torch.as_tensor(reconstruction.ROOM * share, dtype=torch.float32) * size + middle
        posed = (rest - motion.offset[0, part]) @ motion.rotation[0, part]
        with torch.no_grad():
            there = model.fields(predicted.shape, motion, posed[None]).product[0, part].numpy()
        np.testing.assert_allclose(field, there, atol=1e-4)
        assert np.ptp(field) > 1e-3


def test_parts_with_boxes_are_looked_for_there(monkeypatch):
    """One that is too thin for the grid as well; one that is nowhere is not looked at again."""
    torch.manual_seed(1)
    settings = ModelSettings(form="release", part_boxes=True)
    model = PPD(settings).eval()
    with torch.no_grad():
        model.shape.box_in[-1].bias.view(-1, 6)[:, 3:] -= 0.5
        model.shape.box_in[-1].bias.view(-1, 6)[1, 3] = -3.0
        model.shape.head_2.bias += 5.0
        model.shape.head_2.bias[8 + 3] -= 100.0
        predicted = model(torch.rand(1, 64, 3) - 0.5)
    thin = predicted.shape.box.size[0, 1, 0]
    assert 2.0 * reconstruction.ROOM * thin < 1 / 16
    whole = part_logits(model, predicted, 16)
    asked, every = [], reconstruction.logits_at

    def noted(*given, **how):
        asked.append(given[3].tolist())
        return every(*given, **how)

    monkeypatch.setattr(reconstruction, "logits_at", noted)
    found = reconstruction_of(model, predicted, 16)
    assert asked == [[0, 1, 2, 4, 5, 6, 7]]
    each, union = meshes_of_greatest(np.delete(whole, 3, 0))
    np.testing.assert_allclose(found.whole, union, atol=1e-6)
    np.testing.assert_allclose(found.triangles, np.concatenate(each), atol=1e-6)
    assert len(union)


def test_nothing_anywhere_has_no_surface_at_any_resolution(monkeypatch):
    monkeypatch.setattr(fields, "DENSE", 8)
    torch.manual_seed(0)
    model = PPD(ModelSettings()).eval()
    with torch.no_grad():
        model.shape.head_2.bias[8:] -= 100.0
        found = reconstruction_of(model, model(torch.rand(1, 64, 3) - 0.5), 16)
    assert not len(found.whole)
    assert not len(found.triangles)
    assert found.occupied.shape == (16, 16, 16)
