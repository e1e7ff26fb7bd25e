"""Relative KKT residual of a plan.

One measure for solvers that stop by tests of their own.

No solver uses it. It is the gradient of the reduced problem, the inputs alone its
unknowns, the states those of the GPs' mean rolled out by torch,

    f(U) = sum_i |x_i - r_i|^2_Q + sum_i |v_i|^2_R,   x_{i+1} = m(x_i, u_i),   lower <=
    U <= upper g = df/dU by the discrete adjoint (Bryson and Ho, 1975, section 2.2)

A plan is a KKT point exactly where the middle one of g_j, h_j (u_j - lower_j) and h_j
(u_j - upper_j) is zero for every j, whatever positive h_j: multipliers of the box are
those of the projection (Facchinei and Pang, 2003, section 1.5.1). With h the diagonal
of the Gauss-Newton Hessian all three are gradients. f is a sum of squares, so |g_j| is
at most sqrt(2 h_j f), and the share of it that is left is the cosine between the
residuals and their change with u_j (More, 1978, eq. (8.2)), from 0 to 1 whatever the
units of the cost. Where f vanishes so does g, and the share need not: f is counted with
what moving u_j by ``SMALL`` of its size adds to it, h_j (SMALL size)^2 / 2, the size
being |u_j| or 1, whichever is more, but at most upper_j - lower_j. The largest share is
the residual of a plan.
"""

from dataclasses import dataclass

import numpy as np
import torch

from gpmpc._dynamics import predict_with_jacobian
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.models import DynamicsModel
from gpmpc.mpc import Problem, Reference

Array = np.ndarray

SMALL = 1e-3  # share of an input's size


@dataclass(frozen=True)
class Instance:
    """The optimal control problem of one step.

    Attributes:
        belief: Of the current state; its mean counts.
        reference: Over the horizon.
        last: The input before this step, u_{-1} (m,).
    """

    belief: Gaussian
    reference: Reference
    last: Array

    @property
    def state(self) -> Array:
        """The belief's mean (n,)."""
        return self.belief.mean.numpy()

    @property
    def targets(self) -> Array:
        """r_1 .. r_H (H, n)."""
        return self.reference.states[1:]


def kkt_residual(
    model: DynamicsModel, problem: Problem, instance: Instance, inputs: Array
) -> float:
    """Computes how far a plan is from a KKT point; see the module's text.

    Args: model: Its mean is the dynamics; float64 in host memory. problem: Weights, and
        bounds of the inputs; increments or the inputs themselves are weighed. instance:
        Where the plan starts and what it follows. inputs: The plan (H, m).

    Raises:
        SettingError: The problem bounds more than inputs, or weighs deviations.
        ShapeError: The plan has another shape.
    """
    if (
        problem.constraints
        or problem.input_rates.finite
        or problem.cost.penalized == "deviations"
    ):
        raise SettingError(
            "problem", "must bound nothing but inputs, and weigh inputs or increments"
        )
    H = len(instance.targets)
    m = problem.input_dim
    if np.shape(inputs) != (H, m):
        raise ShapeError(
            f"a plan of {H} stages and {m} inputs must have shape ({H}, {m}); got "
            f"{np.shape(inputs)}"
        )
    if not np.isfinite(inputs).all():
        return np.inf
    states, A, B = _rollout(model, instance.state, np.asarray(inputs, dtype=float))
    errors = states[1:] - instance.targets
    weights, _ = problem.cost.by_stage(H)
    cost, gradient, curvature = _of_the_inputs(problem, instance.last, inputs)
    cost += np.einsum("ia,iab,ib->", errors, weights, errors)
    adjoint = np.zeros(problem.state_dim)
    for i in reversed(range(H)):
        adjoint = adjoint + 2 * weights[i] @ errors[i]
        gradient[i] += B[i].T @ adjoint
        adjoint = A[i].T @ adjoint
    for k in range(H):
        response = B[k]  # dx_{i+1}/du_k
        for i in range(k, H):
            response = response if i == k else A[i] @ response
            curvature[k] += 2 * np.einsum("aj,ab,bj->j", response, weights[i], response)
    above = curvature * (inputs - problem.inputs.lower)
    below = curvature * (inputs - problem.inputs.upper)
    left = np.abs(np.maximum(below, np.minimum(gradient, above)))
    sizes = np.minimum(
        np.maximum(1.0, np.abs(inputs)), problem.inputs.upper - problem.inputs.lower
    )
    most = np.sqrt(2 * curvature * (cost + 0.5 * curvature * (SMALL * sizes) ** 2))
    return float(
        np.divide(left, most, out=np.where(left > 0, np.inf, 0.0), where=most > 0).max()
    )


def _rollout(
    model: DynamicsModel, state: Array, inputs: Array
) -> tuple[Array, Array, Array]:
    """States (H + 1, n), and the Jacobians (H, n, n) and (H, n, m) of every step."""
    x = torch.tensor(state)
    states = [state]
    A = []
    B = []
    for u in torch.from_numpy(np.array(inputs)):
        belief, by_state, by_input = predict_with_jacobian(model, x, u)
        x = belief.mean
        states.append(x.numpy())
        A.append(by_state.numpy())
        B.append(by_input.numpy())
    return np.array(states), np.array(A), np.array(B)


def _of_the_inputs(
    problem: Problem, last: Array, inputs: Array
) -> tuple[float, Array, Array]:
    """Value, gradient and diagonal of the Hessian (H, m) of sum_i |v_i|^2_R."""
    curvature = np.tile(2 * problem.cost.R.diagonal(), (len(inputs), 1))
    v = (
        inputs
        if problem.cost.penalized == "inputs"
        else np.diff(inputs, axis=0, prepend=last[None])
    )
    slopes = 2 * v @ problem.cost.R
    cost = float(np.sum(slopes * v)) / 2
    if problem.cost.penalized == "increments":
        slopes[:-1] -= slopes[1:].copy()
        curvature[:-1] *= 2
    return cost, slopes, curvature
