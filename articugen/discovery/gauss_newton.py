"""The kernel of a fit: rounds of Gauss and Newton's method for a joint and its states, as in
generalised ICP (Segal et al. 2009). Everything is in the cube, with `Cells` as `kernels` says.

With the axis a through c and a point of the part at p = c + o in pose 0, a pose moves it to
c + R o. Turned back into the frame of pose 0, a tilt of the axis about w moves it by
(R^T w - w) x o, a shift of the pivot along w by R^T w - w, a change of the state by a x o.
"""

import numpy as np

from articugen.core.jit import helper, kernel
from articugen.discovery.kernels import is_void, moved, nearest

SHARED = 4
"""Unknowns that all poses share: two tilts of the axis (of a slide: towards both vectors across
it), two shifts of the pivot along them. Then each pose's state follows."""

LONGEST = 0.2  # no unknown changes by more in a round

LEVEL = 0.005  # the damping of an unknown of which points tell nothing, by that of the surest

SMALL = 1e-5  # a round in which nothing changes by more is the last

WANDERS = 0.7  # pivots farther out than this are no better than slides


@helper
def _across(axis, out):
    """Two unit vectors into `out` (2, 3) that span the plane across an axis."""
    least = 0
    for r in range(1, 3):
        if abs(axis[r]) < abs(axis[least]):
            least = r
    b, c = (least + 1) % 3, (least + 2) % 3
    length = np.sqrt(axis[b] * axis[b] + axis[c] * axis[c])
    out[0, least], out[0, b], out[0, c] = 0.0, axis[c] / length, -axis[b] / length
    for r in range(3):
        s, t = (r + 1) % 3, (r + 2) % 3
        out[1, r] = axis[s] * out[0, t] - axis[t] * out[0, s]


@helper
def _motion(turns, a, c, q, M):
    """Into M (3, 4) what the joint does to its part at state q."""
    if not turns:
        for r in range(3):
            for s in range(3):
                M[r, s] = 1.0 if r == s else 0.0
            M[r, 3] = q * a[r]
        return
    sin, versed = np.sin(q), 1.0 - np.cos(q)
    for r in range(3):
        for s in range(3):
            M[r, s] = versed * (a[r] * a[s] - (1.0 if r == s else 0.0))
        M[r, r] += 1.0
        s, t = (r + 1) % 3, (r + 2) % 3
        M[r, s] -= sin * a[t]
        M[r, t] += sin * a[s]
    for r in range(3):
        M[r, 3] = c[r] - (M[r, 0] * c[0] + M[r, 1] * c[1] + M[r, 2] * c[2])


@helper
def _cross_into(out, a, b):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@helper
def _add(B, W, weight, rest, fixed, H, g, k):
    """Add a point's share of the equations: its gradients B (5, 3) and its distance `rest` (3,),
    both in the frame of pose 0, by its stiffness W (3, 3); not of the first `fixed` unknowns."""
    for u in range(fixed, SHARED + 1):
        s0 = weight * (W[0, 0] * B[u, 0] + W[0, 1] * B[u, 1] + W[0, 2] * B[u, 2])
        s1 = weight * (W[1, 0] * B[u, 0] + W[1, 1] * B[u, 1] + W[1, 2] * B[u, 2])
        s2 = weight * (W[2, 0] * B[u, 0] + W[2, 1] * B[u, 1] + W[2, 2] * B[u, 2])
        row = u if u < SHARED else SHARED + k
        g[row] += s0 * rest[0] + s1 * rest[1] + s2 * rest[2]
        for v in range(fixed, u + 1):
            H[row, v if v < SHARED else SHARED] += s0 * B[v, 0] + s1 * B[v, 1] + s2 * B[v, 2]


@helper
def _equations(
    queries, query_normals, stiffness, turns, a, c, across, states, fixed,
    points, normals, signed, starts, within, reach, width, guess, H, g,
):  # fmt: skip
    """Gauss and Newton's system: each moved point against what is nearest to it in the pose. What
    is farther than `reach` counts for nothing, what is near it for little (Tukey's weights).
    `guess` (K, n) is what was nearest the round before, or -1, and becomes what is."""
    M, B, V = np.zeros((3, 4)), np.zeros((SHARED + 1, 3)), np.zeros((2, 3))
    o, rest = np.zeros(3), np.zeros(3)
    H[:] = 0.0
    g[:] = 0.0
    for k in range(len(states)):
        _motion(turns, a, c, states[k], M)
        for e in range(2):
            w = across[e]
            for r in range(3):
                back = M[0, r] * w[0] + M[1, r] * w[1] + M[2, r] * w[2]
                V[e, r] = back - w[r]
                B[2 + e, r] = back - w[r] if turns else 0.0
                if not turns:
                    B[e, r] = states[k] * w[r]
        for r in range(3):
            B[SHARED, r] = a[r]
        for i in range(len(queries)):
            p = queries[i]
            x, y, z, nx, ny, nz = moved(M, p, query_normals[i])
            if is_void(within, k, x, y, z):
                continue
            guess[k, i], d = nearest(
                points, normals, signed, starts, k, x, y, z, nx, ny, nz, reach, width, guess[k, i]
            )
            at = guess[k, i]
            if at < 0:
                continue
            dx, dy, dz = x - points[at, 0], y - points[at, 1], z - points[at, 2]
            for r in range(3):
                rest[r] = M[0, r] * dx + M[1, r] * dy + M[2, r] * dz
                o[r] = p[r] - c[r]
            if turns:
                if fixed == 0:
                    _cross_into(B[0], V[0], o)
                    _cross_into(B[1], V[1], o)
                _cross_into(B[SHARED], a, o)
            _add(B, stiffness[i], (1.0 - d / (reach * reach)) ** 2, rest, fixed, H, g, k)


@helper
def _damp(H, g, fixed, damped):
    """Hold the first `fixed` unknowns, of which all is 0, and all others back a little."""
    most = 1e-9
    for u in range(fixed, len(g)):
        most = max(most, H[u, min(u, SHARED)])
    for u in range(len(g)):
        H[u, min(u, SHARED)] += damped * (H[u, min(u, SHARED)] + LEVEL * most)


@helper
def _solve(H, g, step):
    """Into `step` what solves the system, but for what is too long of it.

    States have nothing to do with one another, so they are taken out of the system first: 4
    equations are left (Schur's complement).
    """
    K = len(g) - SHARED
    S, b = np.zeros((SHARED, SHARED)), np.zeros(SHARED)
    for u in range(SHARED):
        b[u] = -g[u]
        for v in range(u + 1):
            S[u, v] = H[u, v]
    for k in range(K):
        row = SHARED + k
        for u in range(SHARED):
            ratio = H[row, u] / H[row, SHARED]
            b[u] += ratio * g[row]
            for v in range(u + 1):
                S[u, v] -= ratio * H[row, v]
    _cholesky(S, b)
    for k in range(K):
        row = SHARED + k
        value = -g[row]
        for u in range(SHARED):
            value -= H[row, u] * b[u]
        step[row] = value / H[row, SHARED]
    for u in range(len(step)):
        step[u] = min(max(b[u] if u < SHARED else step[u], -LONGEST), LONGEST)


@helper
def _cholesky(S, b):
    """Into b what solves S x = b, of which the lower triangle is given."""
    for u in range(SHARED):
        for v in range(u + 1):
            value = S[u, v]
            for w in range(v):
                value -= S[u, w] * S[v, w]
            S[u, v] = np.sqrt(max(value, 1e-30)) if u == v else value / S[v, v]
        for v in range(u):
            b[u] -= S[u, v] * b[v]
        b[u] /= S[u, u]
    for r in range(SHARED):
        u = SHARED - 1 - r
        for v in range(u + 1, SHARED):
            b[u] -= S[v, u] * b[v]
        b[u] /= S[u, u]


@helper
def _take(turns, a, c, across, step, states):
    """Take the step, in place."""
    length = 0.0
    w, turned = np.zeros(3), np.zeros(3)
    for r in range(3):
        w[r] = step[0] * across[0, r] + step[1] * across[1, r]
    if turns:
        _cross_into(turned, w, a)
    for r in range(3):
        a[r] += turned[r] if turns else w[r]
        length += a[r] * a[r]
        if turns:
            c[r] += step[2] * across[0, r] + step[3] * across[1, r]
            c[r] = min(max(c[r], -WANDERS), WANDERS)
    for r in range(3):
        a[r] /= np.sqrt(length)
    for k in range(len(states)):
        states[k] += step[SHARED + k]


@kernel
def fit(
    queries, query_normals, stiffness, turns, axis, pivot, states, fixed, rounds, damped,
    points, normals, signed, starts, within, reach, width,
):  # fmt: skip
    """Fit the joint in place, in a limited number of rounds.

    Args:
        queries, query_normals, stiffness: (m, 3), (m, 3), (m, 3, 3) of pose 0.
        turns: whether it is a revolute joint.
        axis, pivot, states: (3,), (3,), (K,); changed.
        fixed: number of the shared unknowns that are kept.
        damped: by this share of itself each unknown is held back.
        within: as in `kernels.is_void`, for `reach`; `width` is `across` of `kernels`.
    """
    K = len(states)
    H, g, step = np.zeros((SHARED + K, SHARED + 1)), np.zeros(SHARED + K), np.zeros(SHARED + K)
    across, guess = np.zeros((2, 3)), np.full((K, len(queries)), -1)
    for _ in range(rounds):
        _across(axis, across)
        _equations(
            queries, query_normals, stiffness, turns, axis, pivot, across, states, fixed,
            points, normals, signed, starts, within, reach, width, guess, H, g,
        )  # fmt: skip
        _damp(H, g, fixed, damped)
        _solve(H, g, step)
        _take(turns, axis, pivot, across, step, states)
        most = 0.0
        for u in range(len(step)):
            most = max(most, abs(step[u]))
        if most < SMALL:
            break
