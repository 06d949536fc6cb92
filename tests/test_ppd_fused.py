"""The decoders as one operation against the plain ones in double precision."""

import copy

import numpy as np
import pytest
import torch
from python_process import printed

from articugen.learning.cpu import kernels
from articugen.learning.cpu.batches import takes_kernels
from articugen.learning.ppd import shape
from articugen.learning.ppd.cpu import sine_kernels, warm
from articugen.learning.ppd.network import PPD
from articugen.learning.ppd.settings import ModelSettings


def wavy(**settings):
    """With weights that make waves; in single precision the plain network, too, is only right to
    a ten-thousandth then."""
    torch.manual_seed(0)
    model = PPD(ModelSettings(latent_start="he", **settings))
    with torch.no_grad():
        for parameter in model.shape.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return model


@pytest.fixture(scope="module")
def model():
    return wavy()


def fields(model, count, kind=torch.float32):
    """(logits (B, 2 P, n), model) of 2 samples, with a graph, in single or double precision."""
    torch.manual_seed(1)
    clouds, points = torch.rand(2, 300, 3) - 0.5, torch.rand(2, count, 3) - 0.5
    model = copy.deepcopy(model).to(kind)
    predicted = model(clouds.to(kind))
    found = model.fields(predicted.shape, model.motion(predicted.pose), points.to(kind))
    return torch.cat([found.common, found.instance], 1), model


def gradients(out, weight, model):
    some = torch.autograd.grad(
        (out * weight.to(out)).sum(), list(model.parameters()), allow_unused=True
    )
    names = [name for name, _ in model.named_parameters()]
    return {n: g.double() for n, g in zip(names, some, strict=True) if g is not None}


def weights(out, which):
    """What comes back to the logits: to all points, to a few, to F^{s,z} alone, to none."""
    weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(2))
    if which == "few":
        weight[:, :, torch.arange(out.shape[2]) % 7 > 0] = 0.0
        weight[0, 3] = 0.0
    elif which == "instance":
        weight[:, : out.shape[1] // 2] = 0.0
    return weight if which != "none" else torch.zeros_like(weight)


@pytest.mark.parametrize("which", ["all", "few", "instance", "none"])
@pytest.mark.parametrize("count", [sine_kernels.BLOCK, 2 * sine_kernels.BLOCK + 11])
def test_values_and_gradients_are_those_of_the_plain_network(model, which, count):
    short, single = fields(model, count)
    plain, double = fields(model, count, torch.float64)
    assert plain.std() > 0.05
    torch.testing.assert_close(short.double(), plain, rtol=1e-3, atol=1e-4)
    weight = weights(short, which)
    left, right = gradients(short, weight, single), gradients(plain, weight, double)
    assert left.keys() == right.keys()
    assert len(left) > 40
    for name, wanted in right.items():
        share = 6e-4 if name.startswith("shape") else 1e-2  # what lies before multiplies rounding
        near = share * float(wanted.abs().max())
        torch.testing.assert_close(left[name], wanted, rtol=0.0, atol=near, msg=name)


MANY = {"revolute": ((0, 0, 1),) * 12, "prismatic": ((1, 0, 0),) * 12}


def test_layers_have_other_widths():
    many = wavy(**MANY)
    assert many.shape.trunk_0.weight.shape[1:] == (12, 8)
    short, single = fields(many, 40)
    plain, double = fields(many, 40, torch.float64)
    torch.testing.assert_close(short.double(), plain, rtol=1e-3, atol=1e-4)
    weight = weights(short, "all")
    left, right = gradients(short, weight, single), gradients(plain, weight, double)
    for name in ("shape.head_1.weight", "shape.trunk_0.weight", "shape.coordinate.weight"):
        near = 1e-3 * float(right[name].abs().max())
        torch.testing.assert_close(left[name], right[name], rtol=0.0, atol=near, msg=name)


def test_threads_change_nothing(model):
    found = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        out, own = fields(model, 150)
        found.append((out, gradients(out, weights(out, "all"), own)))
    torch.set_num_threads(1)
    (one, left), (other, right) = found
    torch.testing.assert_close(one, other)  # the encoder's own sums may differ
    for name, gradient in left.items():
        near = 1e-4 * float(gradient.abs().max())
        torch.testing.assert_close(gradient, right[name], rtol=0.0, atol=near)


def test_other_kinds_of_points_go_the_plain_way():
    points = torch.rand(1, 5, 3)
    assert takes_kernels(points)
    assert not takes_kernels(points.double())
    assert not takes_kernels(points.to("meta"))
    assert not takes_kernels(points.requires_grad_())
    assert shape.takes_kernels is takes_kernels


def test_sines_are_right_to_a_few_units_in_the_last_place():
    z = np.linspace(-300.0, 300.0, 20_001).astype(np.float32)
    z = np.concatenate([z, np.float32(np.pi / 2) * np.arange(-200, 200, dtype=np.float32)])
    for ours, theirs in ((sine_kernels._sine, np.sin), (sine_kernels._cosine, np.cos)):
        found = np.array([ours(x) for x in z])
        np.testing.assert_allclose(found, theirs(z.astype(np.float64)), atol=4e-7)


def test_what_is_compiled_ahead_is_what_is_used(model):
    warm.networks()
    out, own = fields(model, 20)
    gradients(out, weights(out, "all"), own)
    for kernel in (sine_kernels.forward, sine_kernels.backward, kernels.greatest):
        assert len(kernel.signatures) == 1


def test_what_is_not_finite_is_not_hidden(model):
    spoilt = copy.deepcopy(model)
    with torch.no_grad():
        spoilt.shape.trunk_0.weight[2, 0, 0] = torch.nan
        spoilt.shape.trunk_0.bias[4, 0] = torch.inf
    out, _ = fields(spoilt, 20)
    parts = out.isfinite().all(2).all(0)[: spoilt.settings.parts]
    assert parts.tolist() == [part not in (2, 4) for part in range(8)]


SUMMED = """
import hashlib
import numpy as np
from articugen.learning.ppd.cpu.sine_kernels import backward

rng = np.random.default_rng(0)
P, c, h, m = 2, 9, 12, 6
shapes = [(2, 300, 3), (2, P, c, 3), (2, P, c), (2, P, c), (2, P, m)]
layers = [(P, h, c), (P, m, h), (2 * P, h, m), (2 * P, c, h), (2 * P, 1, c)]
shapes += [shape for layer in layers for shape in (layer, layer[:2])]
given = [rng.standard_normal(shape).astype(np.float32) for shape in shapes]
gradients = [np.zeros_like(array) for array in given[1:]]
backward(*given, 0, P, rng.standard_normal((2, 2 * P, 300)).astype(np.float32), *gradients)
hits = backward.stats.cache_hits.total()
print(hits, *(hashlib.sha256(g.tobytes()).hexdigest()[:8] for g in gradients))
"""


def test_gradients_are_the_same_compiled_and_loaded(tmp_path):
    """Which process compiled a kernel must not decide the last digits of a curve."""
    runs = [printed("-c", SUMMED, NUMBA_CACHE_DIR=str(tmp_path)).split() for _ in range(2)]
    assert [run[0] for run in runs] == ["0", "1"]
    assert runs[0][1:] == runs[1][1:]
