"""The kernels of this room, called once on next to nothing: see core/compiling.py."""

import numpy as np

from articugen.learning.cpu.kernels import greatest, nearest_of_firsts, patches
from articugen.learning.ppd.cpu import sine_kernels


def networks() -> None:
    greatest(np.zeros((1, 1, 1), np.float32), np.zeros((1, 1), np.int64))
    patches(np.zeros((1, 1, 3), np.float32), 4, 4)
    cloud, out = np.zeros((1, 1, 3), np.float32), np.zeros((1, 1, 1, 1), np.int64)
    nearest_of_firsts(cloud, cloud, np.array([1]), out)
    P, c = 1, 4
    layers = [(P, 12, c), (P, 6, 12), (2 * P, 12, 6), (2 * P, c, 12), (2 * P, 1, c)]
    shapes = [(1, 1, 3), (1, P, c, 3), (1, P, c), (1, P, c), (1, P, 6)]
    shapes += [shape for layer in layers for shape in (layer, layer[:2])]
    inputs = [np.zeros(shape, np.float32) for shape in shapes]
    out = np.zeros((1, 2 * P, 1), np.float32)
    sine_kernels.forward(*inputs, 0, P, out)
    sine_kernels.backward(*inputs, 0, P, out, *inputs[1:])
