"""Linear-quadratic tracking.

Along the reference the learned mean is x_{i+1} = A_i x_i + B_i u_i + c_i, for which one
Riccati recursion minimises the cost. It knows no bound; what it gives is clipped.
"""

from collections.abc import Sequence
from time import perf_counter

import numpy as np

from gpmpc._angles import angles_of
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel, check_next_states
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.models._past import weighed_dim, weighed_signals
from gpmpc.mpc._controller import (
    Decision,
    Reference,
    Request,
    Timing,
    check_controller,
)
from gpmpc.mpc._linear_quadratic import Stages
from gpmpc.mpc._linearization import StageCosts, StageLinearizer
from gpmpc.mpc._riccati import optimal_feedback
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Linearization
from gpmpc.status import Status

Array = np.ndarray


@explains_arguments
class LQR:
    """Linear-quadratic tracking on the local models of a learned mean.

    The first local model is taken at the state itself, the others at the reference;
    their inputs are the reference's where it has them, else the last input. Every input
    of the plan is clipped to the input box and to the rate bounds, each seen from the
    one before; it takes no constraints of states.

    Args:
        model: What was learned; its mean is used.
        problem: Weights, and bounds of the inputs.
        horizon: H, the number of predicted states.
        initial_input: The input before the first step (m,).

    Raises:
        SettingError: As for ``GPMPC``; or constraints of states.
    """

    def __init__(
        self,
        model: DynamicsModel,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
    ):
        self.signals = weighed_signals(model, problem)
        _, inputs = check_next_states(model)
        self.initial_input = check_controller(
            problem,
            states=weighed_dim(model, problem),
            inputs=inputs,
            horizon=horizon,
            initial_input=initial_input,
            input_names=self.signals.input_names,
        )
        problem.check_plain("LQR")
        if problem.constraints:
            raise SettingError(
                "constraints",
                "LQR knows the bounds of inputs only; leave those of states out",
            )
        self.model = model
        self.problem = problem.with_angles(angles_of(model))
        self._whole_problem = self.problem.over(model.state_dim)
        self.horizon = horizon
        self._linearize = StageLinearizer(model, Linearization(), "none")
        self._cost = StageCosts(self._whole_problem, horizon, self._linearize).quadratic

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Returns the clipped linear-quadratic plan; see ``Controller.control``.

        Covariances are not predicted: kappas of a reference raise ``SettingError``.
        """
        start = perf_counter()
        request = Request.read(
            self._whole_problem,
            self.horizon,
            self.initial_input,
            belief,
            reference,
            previous,
            signals=self.signals,
        )
        request.refuse_kappas("LQR")
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        references = request.references
        states = np.vstack([request.state, references.states[:-1]])
        inputs = request.constant_guess
        if reference.inputs is not None:
            inputs = references.inputs
        no_covariances = np.empty((0, *request.covariance.shape))
        try:
            stages = self._linearize(states, inputs, no_covariances)
        except FAILURES:  # where the model has no numbers
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        linearized = perf_counter()
        feedback, _ = optimal_feedback(self._cost, stages, references)
        if not np.isfinite(feedback).all():
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        means, inputs = self._clipped_plan(
            stages, feedback, request.state, references.previous_input
        )
        finite = np.isfinite(means).all() and np.isfinite(inputs).all()
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=np.zeros((*means.shape, means.shape[1])),
            status=Status.SOLVED if finite else Status.NUMERICAL_TROUBLE,
            iterations=self.horizon,
            timing=Timing(model=linearized - start, solve=perf_counter() - linearized),
        )

    def _clipped_plan(
        self, stages: Stages, feedback: Array, state: Array, last_input: Array
    ) -> tuple[Array, Array]:
        """Returns states (H + 1, n) and inputs (H, m) under a feedback, clipped.

        The feedback of a stage (m, n + m + 1) is on the state, the input before and 1.
        """
        low, high = self.problem.inputs.by_stage(self.horizon)
        down, up = self.problem.input_rates.by_stage(self.horizon)
        states = [state]
        inputs: list[Array] = []
        for k in range(self.horizon):
            input = feedback[k] @ np.concatenate([state, last_input, [1.0]])
            # The box last: where it and the rates contradict each other, the input must
            # at least exist.
            input = input.clip(last_input + down[k], last_input + up[k])
            input = input.clip(low[k], high[k])
            state = stages.A[k] @ state + stages.B[k] @ input + stages.c[k]
            last_input = input
            states.append(state)
            inputs.append(input)
        return np.array(states), np.array(inputs)
