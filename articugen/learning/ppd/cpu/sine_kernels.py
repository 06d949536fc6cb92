"""The shape decoders on a CPU, forwards and backwards, block of points by block of points.

A block's activations stay in the first caches, nothing of them is kept for the way back (to compute
them again is cheaper than to fetch them), and there only points are examined that a gradient comes
from. Single precision. Parts are independent: threads may take some each.

Arrays: B samples, P parts, n points; a part's layers have c, h, m, h, c channels. Weights come with
the sine's factor, groups P to 2 P - 1 of the heads' are those of F^{s,z}:
points (B, n, 3), moved (B, P, c, 3), shift and template (B, P, c), detail (B, P, m);
W1 (P, h, c), W2 (P, m, h), W3 (2 P, h, m), W4 (2 P, c, h), W5 (2 P, 1, c), b1 to b5 alike.
"""

import numpy as np

from articugen.core.jit import helper, kernel

BLOCK = 128
"""Points at a time."""

_f = np.float32
_PER_HALF_TURN = _f(1.0 / np.pi)
_PI_1, _PI_2, _PI_3 = _f(3.140625), _f(9.67502593994140625e-4), _f(1.509957990978376e-7)
_S0, _S1, _S2 = _f(0.9999999956715666), _f(-0.1666665790378074), _f(0.00833304910095311)
_S3, _S4 = _f(-0.00019808936593974637), _f(2.6049207010643786e-06)
_C0, _C1, _C2 = _f(0.9999999997774724), _f(-0.49999999351356206), _f(0.041666636005551545)
_C3, _C4, _C5 = _f(-0.0013888358287423022), _f(2.476000572997337e-05), _f(-2.604878710231237e-07)
_ONE, _TWO, _ZERO = _f(1.0), _f(2.0), _f(0.0)

_SUMS = {"fastmath": {"contract", "reassoc", "nsz"}, "forceinline": True}
"""Of helpers whose sums may be taken in another order. Inlined, or the process that compiles a
kernel would call the helper's first copy, and one that loads it a copy that adds otherwise."""


@helper(fastmath={"contract"})
def _reduced(z):
    """Return (r, sign): sin(z) = sign sin(r), cos(z) = sign cos(r), r within half a turn of 0."""
    k = np.rint(z * _PER_HALF_TURN)
    r = ((z - k * _PI_1) - k * _PI_2) - k * _PI_3
    return r, _ONE - _TWO * _f(np.int32(k) & 1)


@helper(fastmath={"contract"})
def _sine(z):
    r, sign = _reduced(z)
    u = r * r
    return sign * r * (_S0 + u * (_S1 + u * (_S2 + u * (_S3 + u * _S4))))


@helper(fastmath={"contract"})
def _cosine(z):
    r, sign = _reduced(z)
    u = r * r
    return sign * (_C0 + u * (_C1 + u * (_C2 + u * (_C3 + u * (_C4 + u * _C5)))))


@helper(fastmath={"contract"})
def _affine(W, b, x, z):
    """z = W x + b."""
    n_out, n_in = W.shape
    for o in range(n_out):
        for j in range(BLOCK):
            z[o, j] = b[o]
        i = 0
        while i + 8 <= n_in:
            w0, w1, w2, w3 = W[o, i], W[o, i + 1], W[o, i + 2], W[o, i + 3]
            w4, w5, w6, w7 = W[o, i + 4], W[o, i + 5], W[o, i + 6], W[o, i + 7]
            for j in range(BLOCK):
                low = w0 * x[i, j] + w1 * x[i + 1, j] + w2 * x[i + 2, j] + w3 * x[i + 3, j]
                high = w4 * x[i + 4, j] + w5 * x[i + 5, j] + w6 * x[i + 6, j] + w7 * x[i + 7, j]
                z[o, j] += low + high
            i += 8
        while i + 4 <= n_in:
            w0, w1, w2, w3 = W[o, i], W[o, i + 1], W[o, i + 2], W[o, i + 3]
            for j in range(BLOCK):
                z[o, j] += w0 * x[i, j] + w1 * x[i + 1, j] + w2 * x[i + 2, j] + w3 * x[i + 3, j]
            i += 4
        while i < n_in:
            w0 = W[o, i]
            for j in range(BLOCK):
                z[o, j] += w0 * x[i, j]
            i += 1


@helper(fastmath={"contract"})
def _sines(W, b, x, z, s):
    """z = W x + b, s = sin(z)."""
    _affine(W, b, x, z)
    for o in range(len(W)):
        for j in range(BLOCK):
            s[o, j] = _sine(z[o, j])


@helper(fastmath={"contract"})
def _sines_and_cosines(W, b, x, z, s, c):
    """z = W x + b, s = sin(z), c = cos(z)."""
    _affine(W, b, x, z)
    for o in range(len(W)):
        for j in range(BLOCK):
            s[o, j] = _sine(z[o, j])
            c[o, j] = _cosine(z[o, j])


@helper(**_SUMS)
def _added(d, count, to):
    """Add the sums over the points."""
    for o in range(count):
        total = _ZERO
        for j in range(BLOCK):
            total += d[o, j]
        to[o] += total


@helper(**_SUMS)
def _gathered(d, x, n_out, n_in, gW, gb):
    """Add what a layer's weights get from d, the gradient of W x + b."""
    _added(d, n_out, gb)
    i = 0
    while i + 4 <= n_in:
        for o in range(n_out):
            a0, a1, a2, a3 = _ZERO, _ZERO, _ZERO, _ZERO
            for j in range(BLOCK):
                a0 += d[o, j] * x[i, j]
                a1 += d[o, j] * x[i + 1, j]
                a2 += d[o, j] * x[i + 2, j]
                a3 += d[o, j] * x[i + 3, j]
            gW[o, i] += a0
            gW[o, i + 1] += a1
            gW[o, i + 2] += a2
            gW[o, i + 3] += a3
        i += 4
    while i < n_in:
        for o in range(n_out):
            total = _ZERO
            for j in range(BLOCK):
                total += d[o, j] * x[i, j]
            gW[o, i] += total
        i += 1


@helper
def _transposed(W):
    return np.ascontiguousarray(W.transpose(0, 2, 1))


@kernel
def forward(
    points, moved, shift, template, detail, W1, b1, W2, b2, W3, b3, W4, b4, W5, b5, first, last, out
):
    """Return the logits out (B, 2 P, n) of the parts from `first` to before `last`."""
    B, n, _ = points.shape
    P, c = shift.shape[1:]
    h, m = W1.shape[1], W2.shape[1]
    x, trunk = np.zeros((3, BLOCK), np.float32), np.zeros((m, BLOCK), np.float32)
    most = max(c, h, m)
    z, s = np.zeros((most, BLOCK), np.float32), np.zeros((most, BLOCK), np.float32)
    for p in range(first, last):
        for b in range(B):
            for start in range(0, n, BLOCK):
                count = min(BLOCK, n - start)
                for j in range(count):
                    for k in range(3):
                        x[k, j] = points[b, start + j, k]
                _sines(moved[b, p], shift[b, p], x, z, s)
                for o in range(c):
                    for j in range(BLOCK):
                        s[o, j] += template[b, p, o]
                _sines(W1[p], b1[p], s, z, s)
                _sines(W2[p], b2[p], s, z, trunk)
                for head in range(2):
                    g = p + head * P
                    for o in range(m):
                        for j in range(BLOCK):
                            s[o, j] = trunk[o, j] + (detail[b, p, o] if head else _ZERO)
                    _sines(W3[g], b3[g], s, z, s)
                    _sines(W4[g], b4[g], s, z, s)
                    _affine(W5[g], b5[g], s, z)
                    for j in range(count):
                        out[b, g, start + j] = z[0, j]


@kernel
def backward(  # noqa: PLR0912, PLR0915 - one pass, in the order of the layers
    points, moved, shift, template, detail, W1, b1, W2, b2, W3, b3, W4, b4, W5, b5, first, last,
    inputs, g_moved, g_shift, g_template, g_detail,
    g_W1, g_b1, g_W2, g_b2, g_W3, g_b3, g_W4, g_b4, g_W5, g_b5,
):  # fmt: skip
    """Add to each `g_...` what it gets from `inputs` (B, 2 P, n), the gradient of `forward`'s out,
    in the parts from `first` to before `last`."""
    B, n, _ = points.shape
    P, c = shift.shape[1:]
    h, m = W1.shape[1], W2.shape[1]
    most = max(c, h, m)
    x, z = np.zeros((3, BLOCK), np.float32), np.zeros((most, BLOCK), np.float32)
    s0, c0 = np.zeros((c, BLOCK), np.float32), np.zeros((c, BLOCK), np.float32)
    s1, c1 = np.zeros((h, BLOCK), np.float32), np.zeros((h, BLOCK), np.float32)
    s2, c2 = np.zeros((m, BLOCK), np.float32), np.zeros((m, BLOCK), np.float32)
    s3, c3 = np.zeros((h, BLOCK), np.float32), np.zeros((h, BLOCK), np.float32)
    s4, c4 = np.zeros((c, BLOCK), np.float32), np.zeros((c, BLOCK), np.float32)
    d, e = np.zeros((most, BLOCK), np.float32), np.zeros((most, BLOCK), np.float32)
    g, alone = np.zeros((1, BLOCK), np.float32), np.zeros((m, BLOCK), np.float32)
    none, chosen = np.zeros(most, np.float32), np.zeros(n, np.int64)
    T1, T2, T3, T4 = _transposed(W1), _transposed(W2), _transposed(W3), _transposed(W4)
    for p in range(first, last):
        for b in range(B):
            total = 0
            for j in range(n):
                if inputs[b, p, j] != _ZERO or inputs[b, p + P, j] != _ZERO:
                    chosen[total] = j
                    total += 1
            for start in range(0, total, BLOCK):
                count = min(BLOCK, total - start)
                for j in range(count):
                    for k in range(3):
                        x[k, j] = points[b, chosen[start + j], k]
                _sines_and_cosines(moved[b, p], shift[b, p], x, z, s0, c0)
                for o in range(c):
                    for j in range(BLOCK):
                        s0[o, j] += template[b, p, o]
                _sines_and_cosines(W1[p], b1[p], s0, z, s1, c1)
                _sines_and_cosines(W2[p], b2[p], s1, z, s2, c2)
                for o in range(m):
                    for j in range(BLOCK):
                        alone[o, j] = _ZERO
                for head in range(2):
                    at = p + head * P
                    for j in range(BLOCK):
                        g[0, j] = inputs[b, at, chosen[start + j]] if j < count else _ZERO
                    if head:
                        for o in range(m):
                            for j in range(BLOCK):
                                s2[o, j] += detail[b, p, o]
                    _sines_and_cosines(W3[at], b3[at], s2, z, s3, c3)
                    _sines_and_cosines(W4[at], b4[at], s3, z, s4, c4)
                    _gathered(g, s4, 1, c, g_W5[at], g_b5[at])
                    for o in range(c):
                        for j in range(BLOCK):
                            d[o, j] = W5[at, 0, o] * g[0, j] * c4[o, j]
                    _gathered(d, s3, c, h, g_W4[at], g_b4[at])
                    _affine(T4[at], none, d, e)
                    for o in range(h):
                        for j in range(BLOCK):
                            d[o, j] = e[o, j] * c3[o, j]
                    _gathered(d, s2, h, m, g_W3[at], g_b3[at])
                    _affine(T3[at], none, d, e)
                    for o in range(m):
                        for j in range(BLOCK):
                            alone[o, j] += e[o, j]
                    if head:
                        _added(e, m, g_detail[b, p])
                for o in range(m):
                    for j in range(BLOCK):
                        d[o, j] = alone[o, j] * c2[o, j]
                _gathered(d, s1, m, h, g_W2[p], g_b2[p])
                _affine(T2[p], none, d, e)
                for o in range(h):
                    for j in range(BLOCK):
                        d[o, j] = e[o, j] * c1[o, j]
                _gathered(d, s0, h, c, g_W1[p], g_b1[p])
                _affine(T1[p], none, d, e)
                _added(e, c, g_template[b, p])
                for o in range(c):
                    for j in range(BLOCK):
                        d[o, j] = e[o, j] * c0[o, j]
                _gathered(d, x, c, 3, g_moved[b, p], g_shift[b, p])
