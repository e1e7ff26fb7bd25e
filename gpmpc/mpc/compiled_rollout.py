"""Problem: along a plan every stage is linearised where the one before has led; in Python the loop costs most of it.

The rollout of ``gpmpc.mpc.prediction`` for SE-ARD posteriors whose stages need the mean and, for ``zero_order``,
the variance at the mean (``Linearization``): one compiled loop, with the feedback of ``ancillary_feedback``.
"""

import math
from typing import NamedTuple

import numpy as np

from gpmpc.compiled import compiled, njit_noalloc
from gpmpc.gp.posterior import GPPosterior
from gpmpc.kernels.gp_point import _write_kernel, _write_offsets
from gpmpc.kernels.linalg import aligned_rows, copy, copy_matrix
from gpmpc.kernels.rows import project, reduce_variances
from gpmpc.mpc.ancillary_feedback import step_spread
from gpmpc.mpc.linear_quadratic import finite_horizon_lqr
from gpmpc.mpc.tracking import TrackingProblem

Array = np.ndarray

NOTHING = np.empty((0, 0))
NO_MODEL = (  # in the place of what is known of one
    *(False, False, (NOTHING, NOTHING, NOTHING[0:0].ravel(), NOTHING), NOTHING[None], (NOTHING.ravel(), False)),
    *((NOTHING, NOTHING, NOTHING), (NOTHING.ravel(),) * 4, NOTHING),
)


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


class CompiledRollout:
    """Rolls plans out on one model; what stays the same is looked up once.

    Args:
        model: Predicts next states or differences; float64, in host memory.
        problem: Weights of the feedback, and the inputs' bounds.
        feedback: Whether there is any.
        uncertain: Predicts covariances; they are zero otherwise.
        process_noise: Adds the model's noise to every predicted covariance.
    """

    def __init__(
        self, model: GPPosterior, problem: TrackingProblem, feedback: bool, uncertain: bool, process_noise: bool
    ):
        packed, n = model.packed, model.state_dim
        noise = model.noise_covariance.numpy() if process_noise else np.zeros((n, n))
        self.known = (
            uncertain,
            feedback,
            tuple(packed.arrays[:4]),
            packed.columns if uncertain else NOTHING[None],
            (model.offset.numpy(), model.predicts == "difference"),
            (problem.Q, problem.R, problem.terminal),
            (problem.input_lower, problem.input_upper, problem.rate_lower, problem.rate_upper),
            noise,
        )

    def __call__(
        self, start: Array, covariance: Array, disturbance: Array, plan: Array, follow: Array | None
    ) -> Stages:
        """The stages along a plan.

        Args:
            start: x_0 (n,).
            covariance: Of x_0 (n, n).
            disturbance: Added to every mean (n,), or nothing (0,).
            plan: (H, m).
            follow: Means (H, n) that the rollout follows under the feedback; None follows none.
        """
        (H, m), n = plan.shape, len(start)
        found = Stages(np.empty((H, n, n)), np.empty((H, n, m)), np.empty((H, n)), np.zeros((H + 1, n, n)), plan.copy())
        follow = NOTHING if follow is None else follow
        roll_out(self.known, start, covariance, disturbance, follow, tuple(found))
        return found


@njit_noalloc
def expand_at(gp, x, u, memory, kept, place, M, J, J_u):
    """Writes M, J (k, n) and J_u (k, m) at one point; the k_a stay in ``kept[:, place]``."""
    points, inverse_squares, log_signal, beta = gp
    d, n = len(points), len(x)
    offsets, squares, weighted = memory[:d], memory[d : 2 * d], memory[2 * d]
    _write_offsets(points, x, u, offsets, squares)
    for a in range(len(beta)):
        D = inverse_squares[a]
        M[a] = _write_kernel(log_signal[a], D, squares, beta[a], kept[a, place], weighted)
        project(weighted, offsets[:n], J[a])
        project(weighted, offsets[n:], J_u[a])
        for c in range(n):
            J[a, c] *= D[c]
        for c in range(d - n):
            J_u[a, c] *= D[n + c]


@compiled
def roll_out(known, start, covariance, disturbance, follow, out):
    """Writes the stages along the plan in ``out`` (the parts of ``Stages``), following ``follow`` if there is any."""
    uncertain, feedback, gp, columns, outer, weights, limits, noise = known
    points, _, log_signal, _ = gp
    offset, adds_state = outer
    Q, R, terminal = weights
    lower, upper, rate_lower, rate_upper = limits
    A, B, c, covariances, plan = out
    (H, m), n, padded = plan.shape, len(start), points.shape[1]
    memory = aligned_rows(2 * len(points) + 2, padded)
    places = (H + 3) // 4 * 4 if uncertain else 1  # where k(x~_i, x~) of each stage is kept, (n, places, P)
    kept = aligned_rows(n * places, padded).reshape(n, places, padded)
    M, K, x = np.empty(n), np.zeros((m, n)), start.copy()
    for k in range(H):
        u = plan[k]
        if k > 0 and len(follow) > 0:
            for j in range(m):
                for i in range(n):
                    u[j] += K[j, i] * (x[i] - follow[k, i])
                u[j] = min(max(u[j], plan[k - 1, j] + rate_lower[j]), plan[k - 1, j] + rate_upper[j])
                u[j] = min(max(u[j], lower[j]), upper[j])
        expand_at(gp, x, u, memory, kept, k if uncertain else 0, M, A[k], B[k])
        for i in range(n):
            M[i] += offset[i]
            if len(disturbance) > 0:
                M[i] += disturbance[i]
            if adds_state:
                M[i] += x[i]
                A[k, i, i] += 1.0
        if k == 0 and feedback and (uncertain or len(follow) > 0):
            K = -finite_horizon_lqr(A[:1], B[:1], Q, R, terminal, H)[0][0]
        for i in range(n):
            c[k, i] = M[i]
            for j in range(n):
                c[k, i] -= A[k, i, j] * x[j]
            for j in range(m):
                c[k, i] -= B[k, i, j] * u[j]
        copy(M, x)
    if uncertain:
        copy_matrix(covariance, covariances[0])
        kept[:, H:] = 0.0
        explained = np.zeros((n, places))
        for a in range(n):
            reduce_variances(columns[a], kept[a], explained[a])
        V = noise.copy()
        for k in range(H):
            for i in range(n):
                V[i, i] = noise[i, i] + max(math.exp(log_signal[i]) - explained[i, k], 0.0)
            step_spread(A[k] + B[k] @ K, V, covariances[k], M, covariances[k + 1])
