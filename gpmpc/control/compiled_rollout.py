"""Problem: along a plan every stage is linearised where the one before has led; in Python the loop costs most of it.

The rollout of ``gpmpc.control.prediction`` for SE-ARD posteriors whose stages need the mean and, for ``zero_order``,
the variance at the mean (``Linearization``): one compiled loop, with the feedback of ``ancillary_feedback``.
"""

from typing import NamedTuple

import numpy as np

from gpmpc.compiled import compiled
from gpmpc.control.ancillary_feedback import lqr_gain
from gpmpc.control.tracking import TrackingProblem
from gpmpc.fused.point import expand_at
from gpmpc.fused.point_rows import aligned_rows
from gpmpc.gp.posterior import GPPosterior

Array = np.ndarray


class Stages(NamedTuple):
    """H stages of s+ = A s + B u + c.

    Attributes:
        A: (H, n, n).
        B: (H, n, m).
        c: (H, n).
        covariances: Of the states (H + 1, n, n).
        inputs: The plan that was followed (H, m).
    """

    A: Array
    B: Array
    c: Array
    covariances: Array
    inputs: Array


def roll_out(
    model: GPPosterior,
    problem: TrackingProblem,
    start: Array,
    covariance: Array,
    plan: Array,
    follow: Array | None,
    feedback: bool,
    uncertain: bool,
    noise: Array,
) -> Stages:
    """The stages along a plan.

    Args:
        model: Predicts next states or differences; float64, in host memory.
        problem: Weights of the feedback, and the inputs' bounds.
        start: x_0 (n,).
        covariance: Of x_0 (n, n).
        plan: (H, m).
        follow: Means (H, n) that the rollout follows under the feedback; None follows none.
        feedback: Whether there is any.
        uncertain: Predicts covariances; they are zero otherwise.
        noise: Added to every predicted covariance (n, n).
    """
    (H, m), n, packed = plan.shape, len(start), model.packed
    found = Stages(
        np.empty((H, n, n)), np.empty((H, n, m)), np.empty((H, n)), np.zeros((H + 1, n, n)), np.array(plan, dtype=float)
    )
    found.covariances[0] = covariance
    _stages(
        uncertain,
        feedback,
        (packed.points, packed.inverse_squares, packed.log_signal, packed.weights),
        packed.inverse_cholesky if uncertain else np.empty((n, 0)),
        (model.offset.numpy(), model.predicts == "difference"),
        (problem.Q, problem.R, problem.terminal),
        (problem.input_lower, problem.input_upper),
        np.array(start, dtype=float),
        np.empty((0, n)) if follow is None else np.ascontiguousarray(follow, dtype=float),
        np.ascontiguousarray(noise),
        found,
    )
    return found


@compiled
def _stages(uncertain, feedback, gp, inverse_cholesky, outer, weights, limits, x, follow, noise, out):
    points = gp[0]
    offset, adds_state = outer
    Q, R, terminal = weights
    lower, upper = limits
    A, B, c, covariances, plan = out
    H, m, n = len(plan), plan.shape[1], len(x)
    memory = aligned_rows(2 * len(points) + 2, points.shape[1])
    M, variance, J, J_u, K = np.empty(n), np.zeros(n), np.empty((n, n)), np.empty((n, m)), np.zeros((m, n))
    for k in range(H):
        u = plan[k]
        if k > 0 and len(follow) > 0:
            change = K @ (x - follow[k])
            for j in range(m):
                u[j] = min(max(u[j] + change[j], lower[j]), upper[j])
        expand_at(uncertain, gp, inverse_cholesky, x, u, memory, M, variance, J, J_u)
        for i in range(n):
            M[i] += offset[i]
            if adds_state:
                M[i] += x[i]
                J[i, i] += 1.0
        if k == 0 and feedback and (uncertain or len(follow) > 0):
            K[:] = lqr_gain(J, J_u, Q, R, terminal, H)
        A[k], B[k], c[k] = J, J_u, M - J @ x - J_u @ u
        if uncertain:
            closed = J + J_u @ K
            S = closed @ covariances[k] @ closed.T + noise
            for i in range(n):
                S[i, i] += variance[i]
            covariances[k + 1] = (S + S.T) / 2.0
        x[:] = M
