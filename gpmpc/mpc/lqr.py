"""Problem: the feedback that is left when everything is taken as linear, quadratic and unbounded; a baseline.

Along the horizon the model's mean is x_{i+1} = A_i x_i + B_i u_i + c_i, and the tracking cost

    sum_{i=1..H} |x_i - r_i|^2_Q + sum_{i=0..H-1} |v_i|^2_R

is quadratic, so dynamic programming solves it exactly. With xi = [x; u_{i-1}; 1], reference, affine term and all three
input penalties v = u + V xi are part of one linear system xi+ = F xi + G u, and there is one Riccati recursion
(Anderson and Moore, 1990, sections 2.4 and 4.2; Pi is the cost to go):

    K = (R + G'Pi G)^-1 (R V + G'Pi F),   Pi <- (F - G K)'Pi (F - G K) + (V - K)'R (V - K) + E'Q E,   u = -K xi

where E xi = x - r. It knows no bound; what it gives is clipped.
"""

import time
from collections.abc import Sequence

import numpy as np
import torch
from scipy.linalg import solve_discrete_are

from gpmpc.dynamics import DynamicsModel
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.controller import Decision, Reference, Timing
from gpmpc.mpc.request import Request, check_controller, check_dynamics
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.status import Status

RECURSIONS = 10_000  # of the Riccati equation, before there is taken to be no limit
SETTLED = 1e-12  # relative change of the cost to go at which the recursion has converged


class LQR:
    """Linear-quadratic tracking on the local models of a learned mean.

    The first local model is taken at the state itself, the others at the reference; their inputs are the reference's
    where it has them, else the last input. Every input of the plan is clipped to the input box and to the rate bounds,
    each seen from the one before; state bounds are ignored.

    Args:
        model: What was learned; its variance is not used.
        problem: Weights and bounds.
        horizon: H, the number of predicted states.
        initial_input: Taken for the last input where there is no previous decision (m,).

    Raises:
        SettingError: A horizon below 1, weights of another dimension than the model's, or an initial input of the wrong
            length.
    """

    def __init__(self, model: DynamicsModel, problem: TrackingProblem, horizon: int, initial_input: Sequence[float]):
        self.initial_input = check_controller(problem, *check_dynamics(model), horizon, initial_input)
        self.model, self.problem, self.horizon = model, problem, horizon

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """The clipped linear-quadratic plan; see ``Controller.control``. Covariances are not predicted.

        Raises:
            ShapeError: The belief or the reference does not belong to this controller.
        """
        began = time.perf_counter()
        request = Request.read(self.problem, self.horizon, self.initial_input, belief, reference, previous)
        if not request.finite:
            return request.unanswered(Status.INVALID_MEASUREMENT)
        A, B, c = self._local_models(request, reference.inputs is not None)
        modelled = time.perf_counter()
        if not all(np.isfinite(part).all() for part in (A, B, c)):
            return request.unanswered(Status.NUMERICAL_TROUBLE)
        with np.errstate(over="ignore", invalid="ignore"):
            gains = _tracking_gains(A, B, c, self.problem, request)
        if not gains:
            return request.unanswered(Status.NUMERICAL_TROUBLE)
        n, p, x, last = self.problem.state_dim, self.problem, request.state, request.last
        states, inputs = [x], []
        for i, K in enumerate(gains):
            u = -K @ np.concatenate([x, last, [1.0]])
            # The box last: where it and the rates contradict each other, the input must at least exist.
            u = u.clip(last + p.rate_lower, last + p.rate_upper).clip(p.input_lower, p.input_upper)
            x, last = A[i] @ x + B[i] @ u + c[i], u
            states.append(x)
            inputs.append(u)
        finite = bool(np.isfinite(states).all() and np.isfinite(inputs).all())
        return Decision(
            input=inputs[0],
            inputs=np.array(inputs),
            means=np.array(states),
            covariances=np.zeros((self.horizon + 1, n, n)),
            status=Status.SOLVED if finite else Status.NUMERICAL_TROUBLE,
            iterations=self.horizon,
            timing=Timing(modelled - began, 0.0, time.perf_counter() - modelled),
        )

    def _local_models(self, request: Request, known_inputs: bool) -> tuple[np.ndarray, ...]:
        """A (H, n, n), B (H, n, m) and c (H, n) of the mean."""
        states = np.vstack([request.state, request.targets[:-1]])
        inputs = request.wanted if known_inputs else request.held
        to_model = {"dtype": self.model.dtype, "device": self.model.device}
        x, u = torch.tensor(states, **to_model), torch.tensor(inputs, **to_model)
        moved, A, B = self.model.predict_with_jacobian(x, u)
        A, B, mean = (part.detach().cpu().numpy().astype(float) for part in (A, B, moved.mean))
        return A, B, mean - np.einsum("iab,ib->ia", A, states) - np.einsum("iab,ib->ia", B, inputs)


def _tracking_gains(
    A: np.ndarray, B: np.ndarray, c: np.ndarray, problem: TrackingProblem, request: Request
) -> list[np.ndarray]:
    """K_0 .. K_{H-1} (m, n + m + 1), none where the cost to go grows beyond all numbers; see the module's text."""
    H, n, m = B.shape
    R, gains = problem.R, []
    E = np.hstack([np.eye(n), np.zeros((n, m + 1))])
    E[:, -1] = -request.targets[-1]
    cost_to_go = E.T @ problem.terminal @ E
    for i in reversed(range(H)):
        F, G, V = np.zeros((n + m + 1, n + m + 1)), np.zeros((n + m + 1, m)), np.zeros((m, n + m + 1))
        F[:n, :n], F[:n, -1], F[-1, -1] = A[i], c[i], 1.0
        G[:n], G[n : n + m] = B[i], np.eye(m)
        if problem.penalized == "increments":
            V[:, n : n + m] = -np.eye(m)
        elif problem.penalized == "deviations":
            V[:, -1] = -request.wanted[i]
        weight, pull = R + G.T @ cost_to_go @ G, R @ V + G.T @ cost_to_go @ F
        if not (np.isfinite(weight).all() and np.isfinite(pull).all()):
            return []
        # Least squares: an input without weight or effect is left at zero.
        K = np.linalg.lstsq(weight, pull, rcond=1e-14)[0]
        gains.append(K)
        moved, paid = F - G @ K, V - K
        cost_to_go = moved.T @ cost_to_go @ moved + paid.T @ R @ paid
        if i:
            E[:, -1] = -request.targets[i - 1]
            cost_to_go = cost_to_go + E.T @ problem.Q @ E
        cost_to_go = (cost_to_go + cost_to_go.T) / 2
    return gains[::-1]


def lqr_gain(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """The gain K (m, n) of u = -K x that minimises sum_i |x_i|^2_Q + |u_i|^2_R under x_{i+1} = A x_i + B u_i for ever.

    From the discrete algebraic Riccati equation; where its solver fails (modes on the unit circle that Q does not see),
    from the finite-horizon recursion run to its limit.

    Args:
        A: (n, n).
        B: (n, m).
        Q: (n, n), positive semidefinite.
        R: (m, m), positive definite.

    Raises:
        SettingError: The recursion has no limit: inputs do not reach a mode that grows and that Q weighs.
    """
    A, B, Q, R = (np.asarray(matrix, dtype=float) for matrix in (A, B, Q, R))
    try:
        K = _gain(A, B, R, solve_discrete_are(A, B, Q, R))
        if np.isfinite(K).all() and np.abs(np.linalg.eigvals(A - B @ K)).max() < 1:
            return K
    except (np.linalg.LinAlgError, ValueError):
        pass
    P = Q
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(RECURSIONS):
            K = _gain(A, B, R, P)
            moved = A - B @ K
            following = moved.T @ P @ moved + K.T @ R @ K + Q
            if not np.isfinite(following).all():
                break
            if np.abs(following - P).max() <= SETTLED * np.abs(following).max():
                return _gain(A, B, R, following)
            P = following
    raise SettingError("A, B, Q", "there is no stationary gain: the inputs do not reach a growing mode that Q weighs")


def _gain(A: np.ndarray, B: np.ndarray, R: np.ndarray, P: np.ndarray) -> np.ndarray:
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
