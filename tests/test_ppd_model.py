"""PPD's model: the layer table, and every shortcut against the plain network it stands for."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from learners import assert_alike, parameters

from articugen.core.geometry import rotation_about
from articugen.learning.blocks import GridEncoder, PointNet, _merged, filled
from articugen.learning.cpu.batches import argmax_of_points, distinct, takes_kernels
from articugen.learning.cpu.kernels import patches
from articugen.learning.method import load_recipe
from articugen.learning.ppd.discriminator import Discriminator
from articugen.learning.ppd.kinematics import inverse_motion, joint_frames, rotation_from_z
from articugen.learning.ppd.network import PPD, rest_states
from articugen.learning.ppd.settings import ModelSettings
from articugen.learning.ppd.shape import PLAIN_SIZE, Quantizer

PAPER = ModelSettings()


@pytest.fixture
def model():
    torch.manual_seed(0)
    return PPD(PAPER).double()


def cloud(batch: int, count: int):
    return torch.rand(batch, count, 3, dtype=torch.float64) - 0.5


def test_parameter_counts_are_those_of_the_paper_and_the_release():
    model = PPD(PAPER)
    assert parameters(model.encoder) == 165_760
    assert parameters(model.shape) == 49_168
    assert parameters(model.encoder) + parameters(model.shape) == 214_928
    pose, common = model.pose, model.pose.common_pivot
    assert parameters(common) == 27_920
    # The release's backbone and heads, its second stage's head, and an Euler vector a part.
    assert parameters(pose) - parameters(common) == 118_111 + 4_944 + 24
    assert parameters(Discriminator()) == 140_481


def test_logits_start_as_small_as_the_release_s():
    torch.manual_seed(0)
    model = PPD(ModelSettings(form="release"))
    points = torch.rand(4, 512, 3) - 0.5
    predicted = model(points)
    fields = model.fields(predicted.shape, model.motion(predicted.pose), points)
    assert 0.05 < fields.common.std() < 0.2
    assert 0.02 < fields.product.std() < 0.1


def test_initial_directions_and_states(model):
    pose = model(cloud(3, 600)).pose
    wanted = torch.tensor([*PAPER.revolute, *PAPER.prismatic], dtype=torch.float64)
    torch.testing.assert_close(pose.direction, wanted.expand(3, 7, 3), atol=1e-7, rtol=0)
    assert ((pose.state > 0) & (pose.state < torch.tensor([math.pi] * 3 + [1.0] * 4))).all()
    assert pose.pivot.abs().max() < 0.5


def plain_encoder(encoder, points):
    """The network as the table has it, every point with a graph."""
    x = encoder.first(encoder.position(points).relu())
    for block in (encoder.second, encoder.third):
        x = block(torch.cat([x, x.amax(1, keepdim=True).expand_as(x)], 2).relu())
    return encoder.latent(x.amax(1).relu())


@pytest.mark.parametrize("count", [130, 1000])
def test_the_encoder_s_shortcut_changes_neither_value_nor_gradient(count):
    torch.manual_seed(1)
    encoder, points = PointNet(512).double(), cloud(3, count)
    points[:, count // 2 :] = points[:, : count // 2]  # ties: a cloud may hold a point twice
    weight = torch.randn(3, 512, dtype=torch.float64)
    short, plain = encoder(points), plain_encoder(encoder, points)
    torch.testing.assert_close(short, plain)
    both = ((latent * weight).sum() for latent in (short, plain))
    assert all(g.abs().max() > 0 for g in assert_alike(*both, encoder.parameters()))


@settings(deadline=None, max_examples=40)
@given(
    count=st.integers(1, 300),
    levels=st.integers(1, 1000),
    kind=st.sampled_from([torch.float32, torch.float64]),
)
def test_the_argmax_by_blocks_is_an_argmax(count, levels, kind):
    x = torch.randint(levels, (2, count, 5)).to(kind) - levels
    found = argmax_of_points(x)
    assert torch.equal(x.gather(1, found[:, None])[:, 0], x.amax(1))


@settings(deadline=None, max_examples=40)
@given(count=st.integers(1, 30), levels=st.integers(1, 40))
def test_each_number_once_a_row(count, levels):
    index = torch.randint(levels, (3, count))
    once = distinct(index)
    each = [set(row) for row in index.tolist()]
    assert [set(row) for row in once.tolist()] == each
    assert once.shape[1] == max(map(len, each))


def test_a_grid_is_filled_as_it_says():
    points = cloud(2, 30)
    points[0, 0] = torch.tensor([0.5, -0.5, 0.0])  # on the cube's rim
    cells = 6
    counted = torch.zeros(2, cells, cells, cells, dtype=torch.float64)
    centres = (torch.arange(cells) + 0.5) / cells - 0.5
    for b in range(2):
        for point in points[b].clamp(centres[0], centres[-1]):
            near = [(1.0 - cells * (centres - x).abs()).clamp(min=0.0) for x in point]
            counted[b] += torch.einsum("i,j,k->ijk", *near)
    found = filled(points, cells).view(counted.shape)
    torch.testing.assert_close(found, counted * 2048 / 30, atol=3.0, rtol=0)
    assert found.sum((1, 2, 3)).tolist() == pytest.approx([2048.0] * 2)


def test_a_grid_s_patches_are_its_blocks():
    x = torch.arange(4**3).view(1, -1, 1)
    blocks = _merged(x, 4, 2)
    grid = x.view(4, 4, 4)
    assert blocks.shape == (1, 8, 8)
    assert torch.equal(blocks[0, 0].view(2, 2, 2), grid[:2, :2, :2])
    assert torch.equal(blocks[0, 6].view(2, 2, 2), grid[2:, 2:, :2])


def test_the_grid_s_encoder_sees_where_points_are_and_not_in_which_order():
    torch.manual_seed(0)
    encoder, points = GridEncoder(512).double(), cloud(2, 700)
    latent = encoder(points)
    assert latent.shape == (2, 512)
    torch.testing.assert_close(encoder(points[:, torch.randperm(700)]), latent)
    torch.testing.assert_close(encoder(points.repeat(1, 2, 1)), latent)
    assert (encoder(points.flip(2)) - latent).abs().max() > 1e-3


def test_patches_hold_what_the_grid_is_filled_with():
    points = cloud(3, 200).float()
    points[0, 0] = torch.tensor([0.5, -0.5, 0.0])  # on the cube's rim
    index, held = patches(points.numpy(), 8, 4)
    of_all = torch.zeros(3 * 8, 4**3)
    of_all[torch.from_numpy(index)] = torch.from_numpy(held)
    wanted = _merged(filled(points, 8)[..., None], 8, 4).view(of_all.shape) * 200 / 2048
    torch.testing.assert_close(of_all, wanted)
    assert len(set(index.tolist())) == len(index) == int((wanted > 0).any(1).sum())


@pytest.mark.parametrize("points", [1, 60, 3000])
def test_patches_that_hold_nothing_need_not_be_looked_at(points):
    torch.manual_seed(0)
    encoder, clouds = GridEncoder(512), cloud(2, points).float()
    clouds[1] *= 0.2
    for parameter in encoder.parameters():
        torch.nn.init.normal_(parameter, std=0.1)

    def told(way):
        encoder.zero_grad()
        out = encoder.latent(encoder.whole(way(clouds)).relu())
        out.square().sum().backward()
        return [out.detach(), *(parameter.grad.clone() for parameter in encoder.parameters())]

    assert takes_kernels(clouds)
    for few, all_ in zip(told(encoder._few), told(encoder._all), strict=True):
        torch.testing.assert_close(few, all_, atol=float(all_.abs().max()) * 1e-5, rtol=1e-4)


def test_the_order_of_points_does_not_matter(model):
    points = cloud(2, 700)
    shuffled = points[:, torch.randperm(700)]
    torch.testing.assert_close(model.encoder(points), model.encoder(shuffled))


def part_by_part(model, predicted, points):
    """The decoders as a loop over samples, parts and layers in numpy: the table read aloud."""
    decoder, motion = model.shape, model.motion(predicted.pose)

    def layer(grouped, group, x, sine=True):
        W, b = grouped.weight[group].detach().numpy(), grouped.bias[group].detach().numpy()
        x = x @ W.T + b
        return np.sin(30 * x) if sine else x

    common, instance = np.zeros((2, len(points), PAPER.parts, points.shape[1]))
    local = motion.apply(points).detach().numpy()
    template = predicted.shape.template.detach().numpy()
    detail = predicted.shape.detail.detach().numpy()
    for b in range(len(points)):
        for i in range(PAPER.parts):
            x = layer(decoder.coordinate, i, local[b, i]) + template[b, i]
            x = layer(decoder.trunk_1, i, layer(decoder.trunk_0, i, x))
            for out, head, y in ((common, i, x), (instance, 8 + i, x + detail[b, i])):
                z = layer(decoder.head_1, head, layer(decoder.head_0, head, y))
                out[b, i] = layer(decoder.head_2, head, z, sine=False)[:, 0]
    return common, instance


def test_grouped_evaluation_equals_a_loop_over_parts(model):
    points = cloud(2, 50)
    predicted = model(cloud(2, 600))
    fields = model.fields(predicted.shape, model.motion(predicted.pose), points)
    common, instance = part_by_part(model, predicted, points)
    np.testing.assert_allclose(fields.common.detach().numpy(), common, atol=1e-12)
    np.testing.assert_allclose(fields.instance.detach().numpy(), instance, atol=1e-12)
    np.testing.assert_allclose(
        fields.product.detach().numpy(), instance / (1 + np.exp(-common)), atol=1e-12
    )


@pytest.fixture(scope="module")
def boxed():
    """The model of the recipe whose parts have boxes, other ones in each sample."""
    torch.manual_seed(4)
    model = PPD(load_recipe("ppd_quick").model).double()
    with torch.no_grad():
        model.shape.box_in[-1].weight.normal_(std=0.1)
    return model


def test_a_part_in_a_box_is_seen_as_if_the_box_were_the_plain_one(boxed):
    predicted, points = boxed(cloud(2, 600)), cloud(2, 50)
    box, motion = predicted.shape.box, boxed.motion(predicted.pose)
    assert box.size.std(0).max() > 0.01
    fields = boxed.fields(predicted.shape, motion, points)
    plain = dataclasses.replace(predicted.shape, box=None)
    for i in range(PAPER.parts):
        local = (motion.apply(points)[:, i] - box.middle[:, None, i]) / box.size[:, None, i]
        still = boxed.still(plain, PLAIN_SIZE * local)
        torch.testing.assert_close(fields.instance[:, i], still.instance[:, i])
        torch.testing.assert_close(fields.common[:, i], still.common[:, i])


def test_parts_in_boxes_lie_along_the_axes_when_their_joints_are_closed(boxed):
    predicted = boxed(cloud(3, 600))
    closed = rest_states(predicted.pose.state, 3).expand_as(predicted.pose.state)
    motion = boxed.motion(predicted.pose, closed)
    torch.testing.assert_close(motion.rotation, torch.eye(3).double().expand(3, 8, 3, 3))
    at_pivot = predicted.pose.pivot[:, 1:4]
    torch.testing.assert_close(motion.offset[:, 1:4], -at_pivot)
    torch.testing.assert_close(motion.offset[:, 4:], torch.zeros(3, 4, 3).double())


def test_boxes_lie_along_the_axes_of_the_unit_frame_whatever_the_form():
    frames = {ModelSettings(form=f, part_boxes=True).part_frame for f in ("paper", "release")}
    assert frames == {"world"}
    assert ModelSettings(form="release").part_frame == "joint"


def test_the_code_of_some_parts(boxed):
    code, parts = boxed(cloud(2, 600)).shape, torch.tensor([0, 5])
    some = code.of(parts)
    assert torch.equal(some.detail, code.detail[:, [0, 5]])
    assert torch.equal(some.template, code.template[:, [0, 5]])
    assert torch.equal(some.box.middle, code.box.middle[:, [0, 5]])
    assert torch.equal(some.box.size, code.box.size[:, [0, 5]])


def test_each_part_has_its_own_weights(model):
    """The gradient of one part's field reaches that part's group alone."""
    points = cloud(1, 20)
    predicted = model(cloud(1, 600))
    fields = model.fields(predicted.shape, model.motion(predicted.pose), points)
    (gradient,) = torch.autograd.grad(fields.common[:, 3].sum(), [model.shape.trunk_0.weight])
    reached = gradient.abs().sum((1, 2)) > 0
    assert reached.tolist() == [False] * 3 + [True] + [False] * 4


def test_the_template_is_common_and_the_detail_is_not(model):
    code = model(cloud(2, 600)).shape
    torch.testing.assert_close(code.template[0], code.template[1], atol=1e-12, rtol=0)
    assert (code.detail[0] - code.detail[1]).abs().max() > 1e-6


def test_ablations_leave_only_the_instance_decoders():
    torch.manual_seed(0)
    model = PPD(ModelSettings(common_shape=False, common_pose=False)).double()
    predicted = model(cloud(2, 600))
    fields = model.fields(predicted.shape, model.motion(predicted.pose), cloud(2, 9))
    assert torch.equal(fields.product, fields.instance)
    wanted = 0.5 * torch.tanh(predicted.pose.pivot_residual)
    torch.testing.assert_close(predicted.pose.pivot, wanted)


def test_the_first_stage_has_no_residual_direction(model):
    with torch.no_grad():
        model.pose.direction.bias.fill_(0.3)
        model.pose.common_euler.fill_(0.1)
    first = model(cloud(1, 600), residual_direction=False).pose
    second = model(cloud(1, 600), residual_direction=True).pose
    assert first.euler_residual is None
    torch.testing.assert_close(first.euler, torch.full_like(first.euler, 0.1))
    torch.testing.assert_close(second.euler, torch.full_like(second.euler, 0.4))


def test_the_quantizer_takes_the_nearest_code_and_passes_gradients_on():
    quantizer = Quantizer(4, 3, learn=True).double()
    with torch.no_grad():
        quantizer.codes.copy_(torch.eye(4, 3))
    x = torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.1, 0.8]], dtype=torch.float64, requires_grad=True)
    quantized, code = quantizer(x)
    assert torch.equal(code, torch.eye(4, 3, dtype=torch.float64)[[0, 2]])
    assert torch.equal(quantized, code)
    weight = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], dtype=torch.float64)
    to_x, to_codes = torch.autograd.grad((quantized * weight).sum(), [x, quantizer.codes])
    assert torch.equal(to_x, weight)
    assert torch.equal(to_codes[[0, 2]], weight)
    assert torch.equal(to_codes[[1, 3]], torch.zeros(2, 3, dtype=torch.float64))
    quantizer.learn = False
    (to_x, to_codes) = torch.autograd.grad(
        (quantizer(x)[0] * weight).sum(), [x, quantizer.codes], allow_unused=True
    )
    assert torch.equal(to_x, weight)
    assert to_codes is None


unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 0.1)
angle = st.floats(-3, 3)


@settings(deadline=None, max_examples=50)
@given(direction=unit, euler=st.tuples(angle, angle, angle))
def test_joint_frames_are_the_rotations_they_are_said_to_be(direction, euler):
    e = np.array(direction) / math.hypot(*direction)
    M = rotation_from_z(torch.tensor(e))
    np.testing.assert_allclose(M.numpy() @ [0, 0, 1], e, atol=1e-9)
    np.testing.assert_allclose(M.numpy() @ M.numpy().T, np.eye(3), atol=1e-9)
    rx, ry, rz = (rotation_about(np.eye(3)[k], euler[k]) for k in range(3))
    C = joint_frames(M[None], torch.tensor(euler, dtype=torch.float64)[None])[0]
    np.testing.assert_allclose(C.numpy(), M.numpy() @ rx @ rz @ ry, atol=1e-9)


def test_opposite_directions_have_a_frame_as_well():
    M = rotation_from_z(torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], dtype=torch.float64))
    np.testing.assert_array_equal(M[0].numpy(), np.diag([1.0, -1.0, -1.0]))
    assert torch.linalg.det(M).tolist() == [1.0, 1.0]
    np.testing.assert_array_equal(M[1].numpy(), np.eye(3))


@pytest.mark.parametrize("part_frame", ["world", "joint"])
def test_inverse_motion_undoes_the_paper_s_motion(part_frame):
    torch.manual_seed(2)
    initial = rotation_from_z(torch.tensor([*PAPER.revolute, *PAPER.prismatic]).double())
    frames = joint_frames(initial, torch.randn(5, 7, 3).double())
    state, pivot = torch.rand(5, 7).double(), torch.rand(5, 3, 3).double()
    motion = inverse_motion(frames, state, pivot, 3, part_frame)
    rest = torch.rand(5, 8, 4, 3).double()
    for b in range(5):
        for i in range(8):
            x = rest[b, i].numpy()
            if i in (1, 2, 3):
                u, s = frames[b, i - 1, :, 2].numpy(), float(state[b, i - 1])
                turned = x if part_frame == "world" else x @ frames[b, i - 1].numpy().T
                posed = turned @ rotation_about(u, s).T + pivot[b, i - 1].numpy()
            elif i >= 4:
                posed = x + float(state[b, i - 1]) * frames[b, i - 1, :, 2].numpy()
            else:
                posed = x
            back = motion.apply(torch.from_numpy(posed)[None].expand(5, -1, -1))[b, i]
            np.testing.assert_allclose(back.numpy(), x, atol=1e-12)


def plain_scores(weights, clouds):
    x = clouds
    for weight, bias in weights[:3]:
        x = torch.nn.functional.selu(x @ weight.T + bias)
    x = x.amax(1)
    for weight, bias in weights[3:]:
        x = x @ weight.T + bias
    return x[:, 0]


def test_the_discriminator_s_shortcut_is_exact_even_for_the_gradient_penalty():
    torch.manual_seed(3)
    discriminator = Discriminator().double().eval()
    with torch.no_grad():
        for layer in discriminator.layers:
            layer.weight.mul_(10)
    clouds = torch.rand(3, 600, 4, dtype=torch.float64, requires_grad=True)

    def penalty(scores):
        (slope,) = torch.autograd.grad(scores.sum(), clouds, create_graph=True)
        return scores.sum() + (slope.flatten(1).norm(dim=1) - 1.0).square().mean()

    short, plain = (
        penalty(discriminator(clouds)),
        penalty(plain_scores(discriminator.weights(), clouds)),
    )
    assert_alike(short, plain, discriminator.parameters())


def test_discriminator_weights_come_to_have_unit_norm():
    torch.manual_seed(4)
    discriminator = Discriminator().double()
    for _ in range(200):
        weights = discriminator.weights()
    for weight, _ in weights:
        assert float(torch.linalg.matrix_norm(weight.detach(), 2)) == pytest.approx(1.0, abs=2e-2)
    before = [layer.u.clone() for layer in discriminator.layers]
    discriminator.eval().weights()
    assert all(
        torch.equal(a, layer.u) for a, layer in zip(before, discriminator.layers, strict=True)
    )


def test_he_s_start_tells_shapes_apart_and_adds_nothing():
    spread, count = {}, {}
    for start in ("release", "he"):
        torch.manual_seed(0)
        model = PPD(ModelSettings(latent_start=start))
        boxes = torch.rand(8, 200, 3) - 0.5
        boxes[:, :, 0] *= torch.linspace(0.2, 1.0, 8)[:, None]
        spread[start] = float(model(boxes).shape.detail.detach().std(0).mean())
        count[start] = parameters(model)
    assert spread["he"] > 100 * spread["release"]
    assert count["he"] == count["release"]
