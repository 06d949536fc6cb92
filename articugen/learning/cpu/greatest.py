"""Where the greatest values are, in one pass on a CPU."""

import numpy as np

from articugen.core.jit import kernel


@kernel
def greatest(x, out):
    """out (B, C): the first place of a greatest value of each channel of x (B, n, C); single
    precision."""
    B, n, C = x.shape
    best, at = np.zeros(C, np.float32), np.zeros(C, np.int32)
    for b in range(B):
        for c in range(C):
            best[c], at[c] = x[b, 0, c], 0
        for i in range(1, n):
            for c in range(C):
                is_more = x[b, i, c] > best[c]
                best[c] = x[b, i, c] if is_more else best[c]
                at[c] = np.int32(i) if is_more else at[c]
        for c in range(C):
            out[b, c] = at[c]
