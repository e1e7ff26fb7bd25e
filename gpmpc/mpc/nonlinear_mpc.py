"""Problem: the stochastic control problem itself, as it stands, with the learned model: no convex stand-in for it.

    minimise over u_0 .. u_{H-1}   sum_i |mu_i - r_i|^2_Q + tr(Q Sigma_i) + |v_i|^2_R
    subject to                     (mu_{i+1}, Sigma_{i+1}) = F(mu_i, Sigma_i, u_i), input and rate bounds,
                                   mu_ij -+ kappa sqrt(Sigma_ij,jj) within the state bounds

(Cao, Lai and Alam, 2017, eq. (22), their "nonlinear GPMPC"; F is any propagator.) The problem is not convex: what is
found is a local optimum, certified by its KKT conditions. ``shooting`` has its functions and their adjoint derivatives,
``descent`` the methods.
"""

import time
from collections.abc import Sequence
from typing import Literal

import numpy as np

from gpmpc.dynamics import DynamicsModel
from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.controller import Decision, Reference, Timing
from gpmpc.mpc.convergence import FEASIBLE
from gpmpc.mpc.descent import FAILURES, Program, slsqp, sqp
from gpmpc.mpc.request import Request, check_controller, check_dynamics, check_method
from gpmpc.mpc.shooting import Shooting, Shot
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.propagation import Propagator
from gpmpc.status import Status

METHODS = {"sqp": sqp, "slsqp": slsqp}


class NonlinearGPMPC:
    """Nonlinear MPC on a learned model.

    Each step starts from the last plan, shifted, from the last input held, or from the reference's own inputs where R
    weighs deviations from them, whichever is best; the Gauss-Newton
    ``"sqp"`` needs the fewest evaluations of the model, ``"slsqp"`` is SciPy's, for comparison.

    Args:
        model: What was learned.
        propagator: How the belief moves.
        problem: Weights and bounds.
        horizon: H, the number of predicted states.
        initial_input: Taken for the last input where there is no previous decision (m,): the first guess, and where
            rates and increments start.
        optimizer: ``"sqp"`` or ``"slsqp"``.
        tolerance: A plan counts as solved when the next projected Newton step would be smaller, as a share of the plan
            and its cost (``descent``).
        max_iterations: Of a step.

    Raises:
        SettingError: A horizon below 1, weights of another dimension than the model's, an initial input of the wrong
            length, or an unknown optimizer.
    """

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: TrackingProblem,
        horizon: int,
        initial_input: Sequence[float],
        optimizer: Literal["sqp", "slsqp"] = "sqp",
        tolerance: float = 1e-5,
        max_iterations: int = 100,
    ):
        check_method("propagator", propagator, "propagate", "Linearization()")
        self.initial_input = check_controller(problem, *check_dynamics(model), horizon, initial_input)
        if optimizer not in METHODS:
            raise SettingError("optimizer", f"must be one of {', '.join(map(repr, METHODS))}; got {optimizer!r}")
        check_number("tolerance", tolerance, above=0)
        check_number("max_iterations", max_iterations, least=1, whole=True)
        self.model, self.propagator, self.problem, self.horizon = model, propagator, problem, horizon
        self.optimizer, self.tolerance, self.max_iterations = optimizer, tolerance, max_iterations
        self._shooting = Shooting(model, propagator, problem, horizon)

    def objective(
        self, inputs: np.ndarray, belief: Gaussian, reference: Reference, last_input: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """The expected cost of any plan, with the price of violated soft bounds, and its gradient.

        Args:
            inputs: The plan (H, m); its bounds are not looked at.
            belief: Of the current state.
            reference: Over the horizon.
            last_input: u_{-1} (m,), where increments start.

        Returns:
            The value, and its derivatives (H, m).

        Raises:
            ShapeError: Something does not belong to this controller.
        """
        m, inputs, last_input = len(self.initial_input), np.asarray(inputs, dtype=float), np.asarray(last_input, float)
        if inputs.shape != (self.horizon, m) or last_input.shape != (m,):
            raise ShapeError(
                f"inputs and last_input must have shapes ({self.horizon}, {m}) and ({m},); "
                f"got {inputs.shape} and {last_input.shape}"
            )
        request = Request.read(self.problem, self.horizon, last_input, belief, reference, None)
        program = Program(self._shooting, request)
        shot = program(inputs.ravel())
        return program.objective(shot), program.gradient(shot).reshape(inputs.shape)

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """Solves the problem from a belief along a reference; see ``Controller.control``.

        Where there is no usable state, or no plan that the model could follow, the decision holds the shifted last plan
        with a status that says so. Where the method stopped early, its last iterate is ``suboptimal`` if it keeps the
        bounds.

        Raises:
            ShapeError: The belief or the reference does not belong to this controller.
        """
        began = time.perf_counter()
        request = Request.read(self.problem, self.horizon, self.initial_input, belief, reference, previous)
        if not request.finite:
            return request.unanswered(Status.INVALID_MEASUREMENT)
        program = Program(self._shooting, request)
        built = time.perf_counter() - began
        try:
            start = self._start(program, request)
            shot, status, iterations = METHODS[self.optimizer](program, start, self.tolerance, self.max_iterations)
        except FAILURES:
            return request.unanswered(Status.NUMERICAL_TROUBLE)
        suboptimal = False
        if iterations and status not in (Status.SOLVED, Status.INFEASIBLE):
            shot = min((shot, start), key=lambda shot: _rank(program, shot))  # SLSQP may stop at a worse one
            suboptimal = program.violation(shot) <= FEASIBLE
        inputs = shot.plan.reshape(self.horizon, -1)
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=shot.means,
            covariances=shot.covariances,
            status=status,
            iterations=iterations,
            timing=Timing(program.model_seconds, built, time.perf_counter() - began - built - program.model_seconds),
            suboptimal=suboptimal,
        )

    @staticmethod
    def _start(program: Program, request: Request) -> Shot:
        """The best of the plans at hand: the one that breaks fewer bounds, then the cheapest.

        They are the last input held, the last plan shifted, and the reference's own inputs where R weighs deviations
        from them: from elsewhere a model that is nearly flat in some direction takes hundreds of iterations to get
        there.
        """
        plans = []
        known = [request.wanted] if program.shooting.problem.penalized == "deviations" else []
        for candidate in (request.held, request.shifted, *known):
            plan = candidate.ravel().clip(program.lower, program.upper)
            if not any(np.array_equal(plan, other) for other in plans):
                plans.append(plan)
        if len(plans) == 1:
            return program(plans[0])
        return min((program(plan) for plan in plans), key=lambda shot: _rank(program, shot))


def _rank(program: Program, shot: Shot) -> tuple[bool, float]:
    """Smaller for the better of two plans. Violations that one step mends are not worth a far worse plan."""
    return program.violation(shot) > FEASIBLE, program.objective(shot)
