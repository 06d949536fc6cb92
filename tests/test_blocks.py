"""Steps that do not wait for a GPU are the same steps; what went wrong is named all the same."""

import pytest
import torch

from articugen.core.errors import TrainingDiverged
from articugen.learning.blocks import Descent

NAN = float("nan")


def network():
    torch.manual_seed(0)
    return torch.nn.Linear(3, 2)


def terms_of(net, spoil=()):
    out = net(torch.ones(4, 3)).square()
    terms = {"near": out.mean(), "far": out.sum()}
    return {name: v * NAN if name in spoil else v for name, v in terms.items()}


def steps(patient, spoils=((),)):
    net = network()
    descent = Descent(net)
    descent.patient = patient
    for iteration, spoil in enumerate(spoils):
        terms = terms_of(net, spoil)
        descent.step(terms, lambda: terms_of(net, spoil), iteration, 0.1)  # noqa: B023
    return net, descent


def test_to_note_is_to_step_as_well():
    (one, _), (two, descent) = steps(False, [()] * 4), steps(True, [()] * 4)
    descent.check()
    assert torch.equal(one.weight, two.weight)
    assert not torch.equal(one.weight, network().weight)


def test_the_first_fault_is_the_one_that_is_named():
    _, descent = steps(True, [(), ("far",), ("near", "far"), ()])
    with pytest.raises(TrainingDiverged, match="iteration 2: the loss far is not a finite"):
        descent.check()
    descent.check()  # told once


def test_a_gradient_alone_is_noted():
    net, descent = steps(True, [])
    term = (net.weight - net.weight.detach()).square().sum().sqrt()  # 0, with a slope of 0 / 0
    assert float(term.detach()) == 0.0
    descent.step({"steep": term}, dict, 6, 0.1)
    with pytest.raises(TrainingDiverged, match="iteration 7: the gradient of some term"):
        descent.check()


def test_what_is_asked_at_once_is_not_stepped():
    net = network()
    before = net.weight.detach().clone()
    spoilt = terms_of(net, ("near",))
    with pytest.raises(TrainingDiverged, match="iteration 1: the loss near is not a finite"):
        Descent(net).step(spoilt, lambda: spoilt, 0, 0.1)
    assert torch.equal(net.weight, before)


@pytest.mark.parametrize("spoil", [(), ("far",)])
def test_terms_may_end_without_what_they_were_being_forgotten(spoil):
    """As those of a warm start do."""
    net, descent = steps(True, [(), spoil])
    term = {"near": net.weight.square().sum()}
    if spoil:
        with pytest.raises(TrainingDiverged, match="iteration 2: the loss far is not a finite"):
            descent.step(term, dict, 2, 0.1)
    else:
        descent.step(term, dict, 2, 0.1)
        descent.step({"near": net.weight.sum() * NAN}, dict, 3, 0.1)
        with pytest.raises(TrainingDiverged, match="iteration 4: the loss near is not a finite"):
            descent.check()
