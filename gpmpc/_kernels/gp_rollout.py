"""Roll-outs of the mean of GPs with an affine part, under a feedback towards plans.

    u_k     = clip(u'_k + K_k (x_k - x'_k))
    x_{k+1} = A x_k + G u_k + c + f0(x_k, u_k) + B f(phi(x_k), u_k)

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
from gpmpc._kernels.tape import SPARE_PLACES, Tape, run_tape

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
    inputs: Indices  #: the inputs that f depends on (some of the m)
    tape: Tape  #: f0; ``NO_TAPE`` for zero


class Feedback(NamedTuple):
    """A feedback u_k = u'_k + K_k (x_k - x'_k) towards T plans of H stages."""

    states: Array  #: x'_0 .. x'_{H-1}, and more that are not read (T, H or more, n)
    inputs: Array  #: u' (T, H, m)
    gains: Array  #: K of each plan, or of all (T or 1, H, m, n)
    lower: Array  #: bounds of the inputs (H, m)
    upper: Array  #: (H, m)
    rate_lower: Array  #: bounds of their changes in a step (H, m)
    rate_upper: Array  #: (H, m)
    previous_input: Array  #: the input before the first (m,)


@njit_noalloc
def _write_means(f, offset, point, work, means):
    """Writes the GPs' means at one point x~ (d,).

    They are offset + sum_j beta_j sf2 exp(-1/2 sum_d D_d (x~_j - x~)_d^2). ``work``
    is lent to work in: eight numbers for each dimension and each GP.
    """
    use_widest_registers()
    dimensions, count = f.points.shape
    outputs = len(offset)
    points = f.points.reshape(-1)
    weights = f.weights.reshape(-1)
    D = f.inverse_squares
    first = 8 * dimensions
    for a in range(outputs):
        store(work, first + 8 * a, zeros())
    for j in range(0, count, 8):
        for d in range(dimensions):
            difference = load(points, d * count + j) - point[d]
            store(work, 8 * d, difference * difference)
        for a in range(outputs):
            exponent = zeros() + f.log_signal[a]
            for d in range(dimensions):
                exponent = exponent - (0.5 * D[a, d]) * load(work, 8 * d)
            place = first + 8 * a
            weighted = exp(exponent) * load(weights, a * count + j)
            store(work, place, load(work, place) + weighted)
    for a in range(outputs):
        means[a] = offset[a] + total(load(work, first + 8 * a))


@njit_noalloc
def _write_input(feedback, t, k, x, last_input, u):
    """Writes the input of plan t at step k and state x, within its bounds."""
    planned_state = feedback.states[t, k]
    gains = feedback.gains[min(t, len(feedback.gains) - 1), k]
    for i in range(len(u)):
        value = feedback.inputs[t, k, i]
        for j in range(len(x)):
            value += gains[i, j] * (x[j] - planned_state[j])
        value = min(
            max(value, last_input[i] + feedback.rate_lower[k, i]),
            last_input[i] + feedback.rate_upper[k, i],
        )
        u[i] = min(max(value, feedback.lower[k, i]), feedback.upper[k, i])


@njit_noalloc
def _write_features(model, x, u, features):
    """Writes x~: the states that f depends on, angles as sine or cosine, and inputs."""
    d = len(model.states)
    for i in range(d):
        z = x[model.states[i]]
        if model.kinds[i] == SINE:
            features[i] = math.sin(z)
        elif model.kinds[i] == COSINE:
            features[i] = math.cos(z)
        else:
            features[i] = z
    for i in range(len(model.inputs)):
        features[d + i] = u[model.inputs[i]]


@compiled
def roll_out_gps(model, feedback, start, disturbance, states, inputs):
    """Writes the states (T, H + 1, n) and inputs (T, H, m) of T roll-outs.

    They are of ``AffineGPs``, from x_0 (T, n) on; a disturbance (n,) is added to every
    next state. Eight roll-outs go side by side, for the tape.
    """
    use_widest_registers()
    T, H, m = inputs.shape
    n = start.shape[1]
    outputs = len(model.offset)
    features_dim = len(model.states) + len(model.inputs)
    features = aligned_rows(1, features_dim)[0]
    means = aligned_rows(1, outputs)[0]
    work_of_means = aligned_rows(features_dim + outputs, 8).reshape(-1)
    points = aligned_rows(n + m, 8)  # x and u of eight roll-outs
    f0 = aligned_rows(n, 8)
    work_of_tape = aligned_rows(model.tape.places + SPARE_PLACES, 8)
    points[:] = 0.0
    f0[:] = 0.0
    for t in range(T):
        copy(start[t], states[t, 0])
    for first in range(0, T, 8):
        together = range(first, min(first + 8, T))
        for k in range(H):
            for t in together:
                x = states[t, k]
                u = inputs[t, k]
                last_input = inputs[t, k - 1] if k > 0 else feedback.previous_input
                _write_input(feedback, t, k, x, last_input, u)
                for i in range(n):
                    points[i, t - first] = x[i]
                for i in range(m):
                    points[n + i, t - first] = u[i]
            if model.tape.size > 0:
                run_tape(
                    tape=model.tape,
                    z=points,
                    work=work_of_tape,
                    value=f0,
                    tangents=None,
                )
            for t in together:
                x = states[t, k]
                u = inputs[t, k]
                after = states[t, k + 1]
                _write_features(model, x, u, features)
                if outputs > 0:
                    _write_means(
                        f=model.f,
                        offset=model.offset,
                        point=features,
                        work=work_of_means,
                        means=means,
                    )
                for i in range(n):
                    added = f0[i, t - first] + model.c[i] + disturbance[i]
                    after[i] = (
                        added
                        + dot(model.A[i], x, n)
                        + dot(model.G[i], u, m)
                        + dot(model.B[i], means, outputs)
                    )
