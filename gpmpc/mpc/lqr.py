"""Linear-quadratic tracking on the local models of a learned mean; a baseline.

Along the reference the mean is x_{i+1} = A_i x_i + B_i u_i + c_i, for which one Riccati recursion minimises the cost
(``gpmpc.mpc.linear_quadratic.optimal_feedback``). It knows no bound; what it gives is clipped.
"""

import time
from collections.abc import Sequence

import numpy as np

from gpmpc.dynamics import DynamicsModel, linearize
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.controller import Decision, Reference, Request, Timing, check_controller, check_dynamics
from gpmpc.mpc.linear_quadratic import Stages, TrackingCost, optimal_feedback
from gpmpc.mpc.problem import TrackingProblem
from gpmpc.status import Status


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
        self._cost = TrackingCost.of(problem, problem.Q[None], problem.terminal[None])

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """The clipped linear-quadratic plan; see ``Controller.control``. Covariances are not predicted.

        Raises:
            ShapeError: The belief or the reference does not belong to this controller.
        """
        began = time.perf_counter()
        request = Request.read(self.problem, self.horizon, self.initial_input, belief, reference, previous)
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        (targets, inputs, last), x, p = request.references, request.state, self.problem
        states = np.vstack([x, targets[:-1]])
        inputs = request.constant_guess if reference.inputs is None else inputs
        at = linearize(self.model, states, inputs, covariance=False)
        modelled = time.perf_counter()
        c = at.mean - np.einsum("iab,ib->ia", at.A, states) - np.einsum("iab,ib->ia", at.B, inputs)
        stages = Stages(at.A, at.B, c)
        if not all(np.isfinite(part).all() for part in stages):
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        feedback, _ = optimal_feedback(self._cost, stages, request.references)
        if not np.isfinite(feedback).all():
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        states, inputs = [x], []
        for A, B, offset, F in zip(*stages, feedback, strict=True):
            u = F @ np.concatenate([x, last, [1.0]])
            # The box last: where it and the rates contradict each other, the input must at least exist.
            u = u.clip(last + p.rate_lower, last + p.rate_upper).clip(p.input_lower, p.input_upper)
            x, last = A @ x + B @ u + offset, u
            states.append(x)
            inputs.append(u)
        finite = bool(np.isfinite(states).all() and np.isfinite(inputs).all())
        return Decision(
            input=inputs[0],
            inputs=np.array(inputs),
            means=np.array(states),
            covariances=np.zeros((self.horizon + 1, len(x), len(x))),
            status=Status.SOLVED if finite else Status.NUMERICAL_TROUBLE,
            iterations=self.horizon,
            timing=Timing(modelled - began, 0.0, time.perf_counter() - modelled),
        )
