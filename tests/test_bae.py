"""BAE-Net: its layers and loss against a literal reading in numpy, and that it learns."""

import numpy as np
import pytest
import torch
from learners import batch_of, parameters

from articugen.learning.bae.network import BAENet
from articugen.learning.bae.settings import BAERecipe, ModelSettings
from articugen.learning.blocks import VoxelEncoder, occupied_voxels
from articugen.learning.commands import evaluate
from articugen.learning.loop import Training, train
from articugen.learning.method import find_method, load_recipe

BOXES = {"train": 4, "test": 1, "states": 2}

TINY = BAERecipe.model_validate(
    {
        "name": "tiny",
        "model": {"voxels": 16, "code": 16, "widths": [96, 32], "branches": 4, "from_zero": True},
        "data": {
            "surface_points": 300, "grid_points": 128, "band_points": 128, "validation_objects": 1,
        },
        "schedule": {
            "batch": 4, "learning_rate": 5e-3, "stages": [{"resolution": 16, "iterations": 150}],
            "validate_every": 50,
        },
    }
)  # fmt: skip


@pytest.mark.parametrize(
    ("settings", "count"),
    [
        ({}, 5_251_944),  # the 52.52 x 10^5 of the paper's Table 4
        ({"widths": (3072, 384), "branches": 12}, 6_442_476),
        ({"voxels": 32}, 1_706_336 + 399_624),
    ],
)
def test_parameters_are_those_that_were_published(settings, count):
    with torch.device("meta"):
        assert parameters(BAENet(ModelSettings(**settings))) == count


def test_the_recipe_of_the_paper_is_the_default():
    paper = load_recipe("bae_paper")
    assert (paper.model, paper.losses) == (
        ModelSettings(),
        BAERecipe.model_fields["losses"].default,
    )
    assert (paper.schedule.batch, paper.data.grid_points + paper.data.band_points) == (1, 8192)
    assert load_recipe(method="bae").name == "bae"


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def leaky(x, slope=0.02):
    return np.where(x > 0.0, x, slope * x)


@pytest.mark.parametrize("from_zero", [False, True])
def test_the_decoder_is_three_linear_layers_and_a_maximum(from_zero):
    torch.manual_seed(0)
    settings = ModelSettings(voxels=16, code=5, widths=(7, 6), branches=4, from_zero=from_zero)
    net = BAENet(settings).double()
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter)
    code, points = torch.rand(2, 5).double(), torch.rand(2, 9, 3).double() - 0.5
    W = {name: p.detach().numpy() for name, p in net.named_parameters()}
    x = np.concatenate([points, code[:, None].expand(-1, 9, -1)], 2)
    x = leaky(x @ W["first.weight"].T + W["first.bias"])
    x = leaky(x @ W["second.weight"].T + W["second.bias"])
    h = sigmoid(x @ W["branches.weight"].T + W["branches.bias"])
    h = 2.0 * h - 1.0 if from_zero else h
    with torch.no_grad():
        np.testing.assert_allclose(net.whole(code, points), h.max(2), atol=1e-12)
        fields = net.fields(code, points).numpy()
    assert fields.shape == (2, 4, 9)
    np.testing.assert_array_equal(fields > 0.0, h.transpose(0, 2, 1) > settings.level)
    np.testing.assert_array_equal(fields.argmax(1), h.argmax(2))


def test_outputs_start_where_they_are_said_to():
    torch.manual_seed(0)
    for from_zero, start in ((False, 0.5), (True, 0.0)):
        net = BAENet(ModelSettings(voxels=16, from_zero=from_zero))
        output = net.whole(net.encode(torch.rand(2, 50, 3) - 0.5), torch.rand(2, 20, 3) - 0.5)
        assert output.detach().numpy() == pytest.approx(start, abs=0.02)


def test_the_loss_is_the_mean_square_and_the_last_layer_s_weights():
    learner = find_method("bae").start(TINY, seed=3, device=torch.device("cpu"))
    points, occupied = torch.rand(2, 30, 3) - 0.5, torch.rand(2, 30) < 0.3
    cloud = torch.rand(2, 40, 3) - 0.5
    with torch.no_grad():
        terms = learner.loss(batch_of(cloud, points, occupied))
    assert set(terms) == {"rec", "l1"}
    net = learner.network
    output = net.whole(net.encode(cloud), points).detach().numpy()
    rec = np.mean((output - occupied.numpy()) ** 2)
    assert float(terms["rec"]) == pytest.approx(rec, rel=1e-5)
    weights = net.branches.weight.detach().numpy()
    assert float(terms["l1"]) == pytest.approx(1e-6 * np.abs(weights).sum(), rel=1e-5)
    assert learner.descent.optimiser.betas == (0.5, 0.999)


def test_a_cloud_fills_the_voxels_that_its_points_lie_in():
    cloud = torch.tensor([[[-0.5, 0.0, 0.49], [0.5, 0.5, 0.5], [-0.49, 0.01, 0.3]]])
    grid = occupied_voxels(cloud, 4)
    assert grid.nonzero().tolist() == [[0, 0, 2, 3], [0, 3, 3, 3]]
    assert grid.sum() == 2.0


@pytest.mark.parametrize("normalised", [False, True])
def test_the_voxel_encoder_is_a_pyramid_of_convolutions(normalised):
    torch.manual_seed(1)
    encoder = VoxelEncoder(16, 6, slope=0.02, normalised=normalised).double()
    cloud = torch.rand(2, 500, 3).double() - 0.5
    x = occupied_voxels(cloud, 16).numpy()[:, None]
    convolutions = [layer for layer in encoder.layers if isinstance(layer, torch.nn.Conv3d)]
    for conv in convolutions[:-1]:
        W, b = conv.weight.detach().numpy(), conv.bias.detach().numpy()
        padded = np.pad(x, ((0, 0), (0, 0), *3 * [(1, 1)]))
        blocks = np.lib.stride_tricks.sliding_window_view(padded, (4, 4, 4), (2, 3, 4))
        x = np.einsum("bcxyzijk,ocijk->boxyz", blocks[:, :, ::2, ::2, ::2], W)
        x += b[:, None, None, None]
        if normalised:
            middle, spread = x.mean((2, 3, 4), keepdims=True), x.var((2, 3, 4), keepdims=True)
            x = (x - middle) / np.sqrt(spread + 1e-6)
        x = leaky(x)
    last = convolutions[-1]
    assert x.shape == (2, 64, 4, 4, 4)
    code = sigmoid(np.einsum("bcxyz,ocxyz->bo", x, last.weight.detach().numpy()))  # biases are 0
    np.testing.assert_allclose(encoder(cloud).detach().numpy(), code, atol=1e-10)


def test_it_learns_and_is_judged_as_all_are(boxes, tmp_path):
    cpu = torch.device("cpu")
    learner = find_method("bae").start(TINY, seed=0, device=cpu)
    training, held_out = Training(TINY, "box", boxes, tmp_path).split(learner)
    rng = torch.Generator().manual_seed(0)
    labels = training.batch(range(len(training)), learner.inputs, 16, rng).occupied.float()
    run = train(Training(TINY, "box", boxes, tmp_path))
    rec = [r["terms"]["rec"] for r in run.metrics() if "terms" in r]
    assert np.mean(rec[-5:]) < 0.95 * float(labels.var())  # what the best constant comes to
    last = [r["validation"] for r in run.metrics() if "validation" in r][-1]
    everything = float((held_out.grids[32] > 0).float().mean())
    assert last["iou"] > 1.5 * everything
    assert 1.0 <= last["parts"] <= 4.0
    found = evaluate(run.path, boxes, resolution=16)
    assert (found.run.method, len(found.votes)) == ("bae", 4)
    assert found.means["label_iou"] >= 1 / 9 - 1e-6  # that of one part for everything
    assert not [name for name in found.means if "joint" in name or "_below_" in name]
