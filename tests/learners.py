"""What tests of learners share: tiny recipes of PPD, batches of tensors, numbers of parameters."""

from collections.abc import Iterable, Mapping
from typing import Any

import torch

from articugen.learning.data.batch import Batch
from articugen.learning.ppd.settings import PPDRecipe


def tiny(
    points: Mapping[str, int], *stages: tuple[int, int], losses: Any = None, seeds: Any = None,
    **schedule: Any,
) -> PPDRecipe:  # fmt: skip
    """Return a recipe of PPD that is trained in a moment, every iteration of it logged.

    Args:
        points: `data`, of which one object is held out.
        stages: (resolution, iterations); directions have residuals after the first.
        losses, seeds, schedule: other values than the defaults.
    """
    plan = [
        {"resolution": resolution, "iterations": count, "residual_direction": i > 0}
        for i, (resolution, count) in enumerate(stages)
    ]
    return PPDRecipe.model_validate({
        "name": "tiny",
        "data": {"validation_objects": 1, **points},
        "losses": losses or {},
        "schedule": {"stages": plan, "log_every": 1, "save_every": 100, **schedule},
        "seeds": seeds or {},
    })  # fmt: skip


def batch_of(cloud: torch.Tensor, points: torch.Tensor, occupied: torch.Tensor, **more: Any) -> Any:
    """Return a batch of query points that are spread evenly, without parts or chances."""
    none = torch.zeros(len(cloud), 0)
    about = {"rows": torch.arange(len(cloud)), "part": none, "chance": none, **more}
    return Batch(cloud=cloud, points=points, occupied=occupied, spread=points.shape[1], **about)


def parameters(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def assert_alike(
    short: torch.Tensor, plain: torch.Tensor, of: Iterable[torch.Tensor]
) -> tuple[torch.Tensor | None, ...]:
    """Assert that two scalars are the same, and their gradients with respect to tensors, which are
    returned."""
    of = list(of)
    torch.testing.assert_close(short, plain)
    left, right = (
        torch.autograd.grad(value, of, retain_graph=True, allow_unused=True)
        for value in (short, plain)
    )
    torch.testing.assert_close(left, right)
    return right
