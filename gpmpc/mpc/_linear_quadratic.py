"""The linear-quadratic problem at a plan: its parts, its solution's plan, and its cost.

    minimise    sum_{k=0..H-1} |s_{k+1} - r_{k+1}|^2_W + |v_k|^2_R + z_k' Z_k z_k
    subject to  s_{k+1} = A_k s_k + B_k u_k + c_k,
                bounds on u_k, on u_k - u_{k-1} and on E_k s_{k+1} + D_k u_k

s holds what is predicted of the belief N(mu, Sigma); the *covariance* mode says what:

* ``full``: s = [mu; vec S] with the symmetric root S = Sigma^(1/2) (Cao, Lai and Alam,
  2017, section 4.1).
* ``diagonal``: s = [mu; standard deviations]; correlations are dropped at every stage.
* ``zero_order``: s = mu; covariances are predicted beside the optimisation as if the
  inputs did not change them (Hewing, Kabzan and Zeilinger, 2020; Zanelli, Frey,
  Messerer and Diehl, 2021).
* ``none``: s = mu, through the model's mean at a certain state.
"""

from typing import Literal, NamedTuple

import numpy as np

from gpmpc._compiled import compiled, njit_inner, njit_noalloc
from gpmpc._kernels.linalg import copy, dot

Array = np.ndarray

Covariance = Literal["full", "diagonal", "zero_order", "none"]
COVARIANCES = ("full", "diagonal", "zero_order", "none")

INPUTS, DEVIATIONS, INCREMENTS = range(3)


class Plan(NamedTuple):
    """States and inputs over the horizon, which need not obey the dynamics."""

    states: Array  # s_0 .. s_H (H + 1, p); s_0 is the current one
    inputs: Array  # u_0 .. u_{H-1} (H, m)
    # Sigma_0 .. Sigma_H (H + 1, n, n) at which stages are linearised; zero after
    # Sigma_0 in a first guess whose stages do not depend on them
    covariances: Array


class Stages(NamedTuple):
    """Affine stages s_{k+1} = A_k s_k + B_k u_k + c_k.

    There are K = H of them along a plan, or K = 1 that is held over the horizon.
    """

    A: Array  # (K, p, p)
    B: Array  # (K, p, m)
    c: Array  # (K, p); the defects of the plan are part of it
    # next states F(s_k, u_k) at the points of the plan (K, p)
    next: Array = np.empty((0, 0))
    # what a stage adds to A Sigma A' in the mode ``zero_order``, else zero (K, n, n)
    V: Array = np.empty((0, 0, 0))


class QuadraticCost(NamedTuple):
    """Weights of the sum of |s_{k+1} - r_{k+1}|^2_W + |v_k|^2_R + z'Z z.

    z = [x_{k+1}; u_k; 1], where x is the mean in s.
    """

    state: Array  # W of s_1 .. s_{H-1} (H or 1, p / n, n, n)
    terminal: Array  # W of s_H (p / n, n, n)
    input: Array  # R (H or 1, m, m)
    penalized: int  # what R weighs: INPUTS, DEVIATIONS or INCREMENTS
    # Z of linearised outputs (H, n + m + 1, n + m + 1), or none: (0, n + m + 1, ...)
    squares: Array


class References(NamedTuple):
    """The states and inputs to track, and the input before them."""

    states: Array  # r_1 .. r_H of the mean (H, n); the rest of s is to be zero
    inputs: Array  # (H, m), used where R weighs deviations
    previous_input: Array  # u_{-1} (m,)


class InputBounds(NamedTuple):
    """Bounds of u_k and of u_k - u_{k-1}, for programs or for roll-outs."""

    lower: Array  # (H, m)
    upper: Array  # (H, m)
    rate_lower: Array  # (H, m), or (0, m) where rates have no bounds
    rate_upper: Array  # (H, m) or (0, m)


class StageRows(NamedTuple):
    """Bounds lower_k <= E_k s_{k+1} + D_k u_k <= upper_k."""

    E: Array  # (H or 1, r, p)
    D: Array  # (H, r, m), or (0, r, m)
    lower: Array  # (H, r)
    upper: Array  # (H, r)


class CondensedProgram(NamedTuple):
    """min 1/2 v'P v + q'v under lower <= [v; G v] <= upper.

    In input coordinates the stacked constraints are the bounds of inputs, then those of
    increments (where there are such), then the rows of states, stage by stage. In
    feedback coordinates H m unbounded v come before these.
    """

    P: Array  # (H m, H m)
    q: Array  # (H m,)
    G: Array  # (rows, H m)
    lower: Array  # (H m + rows,)
    upper: Array  # (H m + rows,)
    # F_k of u_k = F_k [s_k; u_{k-1}; 1] + v_k (H, m, p + m + 1); (0, m, p + m + 1)
    # where u = v
    feedback: Array


@compiled
def expand(stages, start, feedback, previous_input, unknowns):
    """Returns inputs (H, m) and states s_0 .. s_H (H + 1, p) of unknowns v (H m,)."""
    p, m = stages.B.shape[1:]
    H = len(unknowns) // m
    last = len(stages.A) - 1
    inputs = unknowns.copy().reshape(H, m)
    states = np.empty((H + 1, p))
    copy(start, states[0])
    for k in range(H):
        stage = min(k, last)
        s = states[k]
        u = inputs[k]
        next_s = states[k + 1]
        if len(feedback) > 0:
            last_u = inputs[k - 1] if k > 0 else previous_input
            for i in range(m):
                F = feedback[k, i]
                u[i] += F[p + m] + dot(F, s, p) + dot(F[p:], last_u, m)
        for i in range(p):
            next_s[i] = (
                stages.c[stage, i]
                + dot(stages.A[stage, i], s, p)
                + dot(stages.B[stage, i], u, m)
            )
    return inputs, states


@compiled
def evaluate_cost(cost, states, inputs, references, constant):
    """Returns the cost of states s_0 .. s_H (H + 1, p) and inputs (H, m).

    ``constant`` stands in the place of the 1 of z.
    """
    total = 0.0
    for stage_cost in evaluate_stages(cost, states, inputs, references, constant):
        total += stage_cost
    return total


@compiled
def evaluate_stages(cost, states, inputs, references, constant):
    """Returns the costs (H,) whose sum is ``evaluate_cost``.

    Stage k is that of s_{k+1} and u_k.
    """
    targets = references.states
    H, n = targets.shape
    m = inputs.shape[1]
    error = np.empty(states.shape[1])
    v = np.empty(m)
    z = np.empty(n + m + 1)
    z[n + m] = constant
    costs = np.empty(H)
    for k in range(H):
        copy(states[k + 1], error)
        for i in range(n):
            error[i] -= targets[k, i]
        weight = weight_of_stage(cost, k, H)
        R = cost.input[min(k, len(cost.input) - 1)]
        total = 0.0
        for b in range(len(weight)):
            for i in range(n):
                for j in range(n):
                    total += error[b * n + i] * weight[b, i, j] * error[b * n + j]
        for i in range(m):
            v[i] = inputs[k, i]
            if cost.penalized == DEVIATIONS:
                v[i] -= references.inputs[k, i]
            elif cost.penalized == INCREMENTS:
                v[i] -= inputs[k - 1, i] if k > 0 else references.previous_input[i]
        for i in range(m):
            for j in range(m):
                total += v[i] * R[i, j] * v[j]
        if len(cost.squares) > 0:
            copy(states[k + 1, :n], z[:n])
            copy(inputs[k], z[n : n + m])
            for i in range(n + m + 1):
                total += z[i] * dot(cost.squares[k, i], z, n + m + 1)
        costs[k] = total
    return costs


@njit_inner
def weight_of_stage(cost, k, H):
    """Returns W of s_{k+1} (p / n, n, n)."""
    return cost.terminal if k == H - 1 else cost.state[min(k, len(cost.state) - 1)]


@njit_noalloc
def add_blocks(W, M):
    """Adds the blocks of a weight to the diagonal of M."""
    n = W.shape[1]
    for b in range(len(W)):
        for i in range(n):
            for j in range(n):
                M[b * n + i, b * n + j] += W[b, i, j]
