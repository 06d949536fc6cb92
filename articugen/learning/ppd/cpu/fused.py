"""The shape decoders as one operation, where `sine_kernels` can do it: on a CPU, in single
precision."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from articugen.learning.ppd.cpu import sine_kernels


def sine_parts(points: Tensor, *rest: Tensor) -> Tensor:
    """Return (B, 2 P, n): F^{s,c} of all parts, then F^{s,z}, from all that `sine_kernels` names,
    where `takes_kernels` says so of the points."""
    return _SineParts.apply(points, *rest)  # pyright: ignore[reportReturnType]


class _SineParts(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, *rest: Tensor) -> Tensor:
        inputs = [tensor.contiguous() for tensor in (points, *rest)]
        ctx.save_for_backward(*inputs)
        B, P, _ = inputs[2].shape
        out = inputs[0].new_empty(B, 2 * P, points.shape[1])
        _by_parts(sine_kernels.forward, P, _arrays(inputs), [out.numpy()])
        return out

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *inputs: Tensor
    ) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        gradients = [torch.zeros_like(tensor) for tensor in saved[1:]]
        to = [inputs[0].contiguous().numpy(), *_arrays(gradients)]
        _by_parts(sine_kernels.backward, saved[2].shape[1], _arrays(saved), to)
        return None, *gradients


Arrays = list[NDArray[Any]]


def _arrays(tensors: Any) -> Arrays:
    return [tensor.detach().numpy() for tensor in tensors]


def _by_parts(kernel: Callable[..., None], parts: int, inputs: Arrays, to: Arrays) -> None:
    """Run a kernel, each of torch's threads for some of the parts; outcomes are the same."""
    threads = min(torch.get_num_threads(), parts)
    bounds = [parts * i // threads for i in range(threads + 1)]
    calls = [partial(kernel, *inputs, first, last, *to) for first, last in pairwise(bounds)]
    if threads == 1:
        calls[0]()
    else:
        with ThreadPoolExecutor(threads) as pool:
            for done in [pool.submit(call) for call in calls]:
                done.result()
