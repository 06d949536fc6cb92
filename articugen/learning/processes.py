"""Several processes that train one model, as torchrun starts them; alone, nothing here acts.

Each process takes an equal share of every batch. What a loss takes over the whole batch is gathered
first, so that it is that of one process; gradients are averaged. All make the same weights from the
same seed and the same steps, so that weights never travel.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor

from articugen.core.errors import ArticugenError, InvalidRecipe


@contextmanager
def joined(device: str) -> Iterator[str]:
    """Join the other processes, where torchrun says that there are any; gives one's own device.

    Raises:
        ArticugenError: this torch cannot.
    """
    if started() == 1:
        yield device
        return
    if not dist.is_available():
        raise ArticugenError("this torch cannot train in several processes; leave out torchrun")
    if device == "cuda":
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield device
    finally:
        dist.destroy_process_group()


def started() -> int:
    """How many torchrun has started; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def count() -> int:
    """How many have joined."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def is_first() -> bool:
    """Whether this one speaks and writes for all."""
    return started() == 1 or int(os.environ.get("RANK", "0")) == 0


def check_batch(size: int) -> None:
    """Raise InvalidRecipe where a batch cannot be shared out equally."""
    if size % count() or size // count() < 1:
        raise InvalidRecipe(
            f"schedule.batch {size} cannot be shared equally by {count()} processes; start another "
            "number of them, or change the recipe"
        )


def share(batch: Tensor) -> Tensor:
    """This process's rows of something of the whole batch."""
    return batch if count() == 1 else batch.chunk(count())[dist.get_rank()]


def gathered(own: Tensor) -> Tensor:
    """The rows of all processes, in order; a gradient goes through one's own.

    It is multiplied by the number of processes, since all gradients are averaged in the end.
    """
    if count() == 1:
        return own
    parts = [torch.empty_like(own) for _ in range(count())]
    dist.all_gather(parts, own.detach().contiguous())
    parts[dist.get_rank()] = own.detach() + count() * (own - own.detach())
    return torch.cat(parts)


def mean(own: Tensor) -> Tensor:
    """The mean of a number over the processes, with a gradient as `gathered`'s."""
    return own if count() == 1 else gathered(own[None]).mean()


def average(tensors: Iterable[Tensor]) -> None:
    """Put the mean over the processes in the place of each tensor, in one message."""
    tensors = list(tensors)
    if count() == 1 or not tensors:
        return
    flat = torch.cat([tensor.detach().flatten() for tensor in tensors])
    dist.all_reduce(flat)
    flat /= count()
    for tensor, values in zip(tensors, flat.split([t.numel() for t in tensors]), strict=True):
        tensor.detach().copy_(values.view_as(tensor))


def wait() -> None:
    """Until all have come so far, so that what the first one wrote is there for the others."""
    if count() > 1:
        dist.barrier()


def of_first(make: Callable[[], str]) -> str:
    """What the first process makes, handed to all."""
    if count() == 1:
        return make()
    made = [make() if is_first() else ""]
    dist.broadcast_object_list(made)
    return made[0]
