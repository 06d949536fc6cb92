"""An iteration on a device that is not the host: nothing is mixed, nothing is waited for.

Torch's meta device computes shapes alone, on any machine. It takes the branches that a GPU takes,
and to read a number from it, as `float` or a boolean index would, raises.
"""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from articugen.learning.data.split import load_split
from articugen.learning.method import load_recipe
from articugen.learning.ppd.learner import PPDLearner
from articugen.learning.recipe import DataSettings

BOXES = {"train": 2, "test": 0, "states": 1}

META = torch.device("meta")
SENDS = {"aten::lift_fresh", "aten::_to_copy", "aten::copy_"}
"""What may take numbers from the host to a device; the first is torch.tensor."""


class OneDevice(TorchDispatchMode):
    """Refuses operations on tensors of the host, but for single numbers, which travel freely."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.name().partition(".")[0] not in SENDS:
            for x in tree_leaves((args, kwargs or {})):
                if isinstance(x, torch.Tensor) and x.device != META and x.dim():
                    raise AssertionError(f"{func}: a tensor {tuple(x.shape)} lies on {x.device}")
        return func(*args, **(kwargs or {}))


def test_the_guard_sees_mixtures_and_waiting():
    x = torch.zeros(3, 3, device=META)
    with OneDevice():
        for mixed in (lambda: x @ torch.ones(3, 3), lambda: x[torch.ones(2).long()]):
            with pytest.raises(AssertionError, match="lies on cpu"):
                mixed()
        for waits in (lambda: float(x.sum()), lambda: bool((x > 0).any()), lambda: x[x > 0]):
            with pytest.raises((RuntimeError, NotImplementedError)):
                waits()


@pytest.mark.parametrize("name", ["ppd_paper", "ppd_release", "ppd_plain"])
@pytest.mark.parametrize("residual", [False, True])
def test_an_iteration_stays_on_its_device(boxes, name, residual):
    recipe = load_recipe(name)
    some = {"surface_points": 500, "grid_points": 200, "uniform_points": 100, "near_points": 100}
    some |= {"band_points": 60, "varying_points": 50}
    stages = recipe.schedule.stages[1:] if residual else recipe.schedule.stages[:1]
    recipe = recipe.model_copy(
        update={
            "data": DataSettings(**some, validation_objects=0),
            "schedule": recipe.schedule.model_copy(update={"stages": stages}),
        }
    )
    learner = PPDLearner(recipe, 0, META)
    split = load_split(boxes, "train", learner.inputs, [8]).to(META)
    assert learner.descent.patient
    with OneDevice():
        for iteration in range(2):
            batch = split.batch([0, 3, 1], learner.inputs, 8, None)
            terms = learner.learn(batch, None, iteration=iteration)
            loss = torch.stack([value.detach() for value in terms.values()])
    assert learner.residual_direction == residual
    assert loss.device == META
    assert ("adv_d" in terms) == (name != "ppd_plain")
