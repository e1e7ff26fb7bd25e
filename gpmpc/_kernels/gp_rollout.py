"""Roll-outs of the mean of GPs with an affine part, under a feedback towards plans.

    u_k = clip(u'_k + K_k (x_k - x'_k)),   x_{k+1} = A x_k + G u_k + c + f0(x_k, u_k) + B f(phi(x_k), u_k)

f0 is a tape; phi selects states, and takes angles as sine and cosine.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc._compiled import compiled, njit_noalloc
from gpmpc._kernels._packed import Array, GPArrays
from gpmpc._kernels._simd import exp, load, store, total, use_widest_registers, zeros
from gpmpc._kernels.linalg import aligned_rows, copy, dot
from gpmpc._kernels.tape import Tape, run_tape

Indices = NDArray[np.intp]

PLAIN, SINE, COSINE = range(3)


class AffineGPs(NamedTuple):
    """GPs f inside an affine model, for compiled code."""

    f: GPArrays  #: the GPs
    offset: Array  #: their prior means (k,)
    A: Array  #: (n, n)
    G: Array  #: (n, m)
    c: Array  #: (n,)
    B: Array  #: (n, k)
    states: Indices  #: the state that each feature of f is a function of (d,)
    kinds: Indices  #: which function: ``PLAIN``, ``SINE`` or ``COSINE`` (d,)
    inputs: Indices  #: the inputs that f depends on (m_s,)
    tape: Tape  #: f0; ``NO_TAPE`` for zero


class Feedback(NamedTuple):
    """A feedback u_k = u'_k + K_k (x_k - x'_k) towards T plans of H stages, within bounds."""

    states: Array  #: x'_0 .. x'_{H-1}, and more that are not read (T, H or more, n)
    inputs: Array  #: u' (T, H, m)
    gains: Array  #: K of each plan, or of all (T or 1, H, m, n)
    lower: Array  #: bounds of the inputs (H, m)
    upper: Array  #: (H, m)
    rate_lower: Array  #: bounds of their changes in a step (H, m)
    rate_upper: Array  #: (H, m)
    previous_input: Array  #: the input before the first (m,)


@njit_noalloc
def _write_means(f, offset, at, memory, means):
    """Writes the means offset + sum_j beta_j sf2 exp(-1/2 sum_d D_d (x~_j - x~)_d^2) of GPs at one point.

    ``memory`` is lent to work in: eight numbers for each dimension and each GP.
    """
    use_widest_registers()
    (dimensions, count), outputs = f.points.shape, len(offset)
    points = f.points.reshape(-1)
    weights = f.weights.reshape(-1)
    D = f.inverse_squares
    first = 8 * dimensions
    for a in range(outputs):
        store(memory, first + 8 * a, zeros())
    for j in range(0, count, 8):
        for d in range(dimensions):
            difference = load(points, d * count + j) - at[d]
            store(memory, 8 * d, difference * difference)
        for a in range(outputs):
            exponent = zeros() + f.log_signal[a]
            for d in range(dimensions):
                exponent = exponent - (0.5 * D[a, d]) * load(memory, 8 * d)
            place = first + 8 * a
            store(
                memory,
                place,
                load(memory, place) + exp(exponent) * load(weights, a * count + j),
            )
    for a in range(outputs):
        means[a] = offset[a] + total(load(memory, first + 8 * a))


@compiled
def roll_out_gps(model, feedback, start, disturbance, states, inputs):
    """Writes the states (T, H + 1, n) and the inputs (T, H, m) of T roll-outs of ``AffineGPs`` from x_0 (T, n) on.

    A disturbance (n,) is added to every next state.
    """
    use_widest_registers()
    f, offset, A, G, c, B, columns, kinds, chosen, tape = model
    (T, H, m), n, d, k_dim = inputs.shape, start.shape[1], len(columns), len(offset)
    work = aligned_rows(2, 8 + d + len(chosen) + k_dim)
    at = work[0]
    value = work[1]
    sums = aligned_rows(d + len(chosen) + k_dim, 8).reshape(-1)
    memory = aligned_rows(
        2 * n + m + tape.work + 5, 8
    )  # eight roll-outs side by side, for the tape
    point = memory[: n + m]
    known = memory[n + m : 2 * n + m]
    places = memory[2 * n + m :]
    memory[: 2 * n + m] = 0.0
    for t in range(T):
        copy(start[t], states[t, 0])
    for first in range(0, T, 8):
        together = range(first, min(first + 8, T))
        for k in range(H):
            for t in together:
                x = states[t, k]
                u = inputs[t, k]
                planned = feedback.states[t, k]
                gains = feedback.gains[min(t, len(feedback.gains) - 1), k]
                for i in range(m):
                    wanted = feedback.inputs[t, k, i]
                    for j in range(n):
                        wanted += gains[i, j] * (x[j] - planned[j])
                    last = inputs[t, k - 1, i] if k > 0 else feedback.previous_input[i]
                    wanted = min(
                        max(wanted, last + feedback.rate_lower[k, i]),
                        last + feedback.rate_upper[k, i],
                    )
                    u[i] = min(max(wanted, feedback.lower[k, i]), feedback.upper[k, i])
                    point[n + i, t - first] = u[i]
                for i in range(n):
                    point[i, t - first] = x[i]
            if tape.size > 0:
                run_tape(tape, point, places, known, None)
            for t in together:
                x = states[t, k]
                u = inputs[t, k]
                after = states[t, k + 1]
                for i in range(d):
                    z = x[columns[i]]
                    at[i] = (
                        math.sin(z)
                        if kinds[i] == SINE
                        else math.cos(z)
                        if kinds[i] == COSINE
                        else z
                    )
                for i in range(len(chosen)):
                    at[d + i] = u[chosen[i]]
                if k_dim > 0:
                    _write_means(f, offset, at, sums, value)
                for i in range(n):
                    added = known[i, t - first] + c[i] + disturbance[i]
                    after[i] = (
                        added
                        + dot(A[i], x, n)
                        + dot(G[i], u, m)
                        + dot(B[i], value, k_dim)
                    )
