"""A controller that learns from every step before it decides."""

from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import torch

from gpmpc._arrays import is_measured
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array, to_array
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_kind,
    check_method,
)
from gpmpc.gaussian import Gaussian
from gpmpc.learning._changed_model import ChangedModel
from gpmpc.learning._settings import OnlineLearning
from gpmpc.learning._state import LearningState
from gpmpc.learning._step import learn_from_step
from gpmpc.mpc import Decision, PredictionSettings, Reference
from gpmpc.mpc._controller import check_arguments
from gpmpc.mpc._sqp import LINEAR_ALGEBRA_FAILURES
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.status import Status


def check_no_disturbance_estimate(settings: PredictionSettings) -> None:
    """Raises ``SettingError`` where a controller that learns estimates a disturbance.

    What both explain would be corrected twice.
    """
    gain = settings.disturbance_gain
    if gain:
        rule = "must be 0 beside online learning, which explains the same errors"
        raise SettingError("disturbance_gain", f"{rule}; got {gain}")


@explains_arguments
class LearningController:
    """Controls by the model of a controller and by what the flight says of its change.

    What was learned travels with the decisions (``Decision.learned``): one controller
    flies any number of flights, and a flight begins where there is no decision before.

    Raises:
        SettingError: The controller cannot change its model, or estimates a disturbance
            beside: what both explain would be corrected twice.
        UnsupportedModel: No change of its model can be learned.
    """

    def __init__(self, controller: GPMPC, learning: OnlineLearning | None = None):
        check_method("controller", controller, "with_model", "GPMPC(...)")
        if learning is None:
            learning = OnlineLearning()
        check_kind("learning", learning, OnlineLearning, "OnlineLearning(...)")
        check_no_disturbance_estimate(controller.prediction.settings)
        self.controller = controller
        self.learning = learning
        self.problem = controller.problem
        self.horizon = controller.horizon
        self.initial_input = controller.initial_input
        self.signals = controller.signals
        self._model = ChangedModel(
            controller.prediction.model,
            self.learning,
            further_angles=self.problem.cost.angle_indices,
        )

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
        plan: Any = None,
    ) -> Decision:
        """Learns from the last step, and decides; see ``GPMPC.control``."""
        start = perf_counter()
        check_arguments(belief, reference, previous)
        if belief.names:
            belief = belief.in_order(self.signals.state_names)
        measured = to_array(belief.mean).copy()
        shape = (self.controller.prediction.state_dim,)
        if measured.shape != shape:
            raise ShapeError(f"state must have shape {shape}; got {measured.shape}")
        learned = self._learn(measured, previous)
        controller = self._with_change(learned)
        options: dict[str, Any] = {}
        if parameters is not None:
            options["parameters"] = parameters
        if plan is not None:
            options["plan"] = plan
        learning_time = perf_counter() - start

        planned_belief = _belief(learned, belief)
        decision = controller.control(planned_belief, reference, previous, **options)
        is_as_measured = learned.planning is None and planned_belief is belief
        if _has_failed(decision) and not is_as_measured:
            learning_time += decision.timing.total
            learned = learned.without_change()
            programs = decision.iterations
            decision = self.controller.control(belief, reference, previous, **options)
            decision = replace(decision, iterations=programs + decision.iterations)
        timing = replace(decision.timing, model=decision.timing.model + learning_time)
        return replace(decision, timing=timing, learned=learned)

    def gains(self, decision: Decision, parameters: Any = None) -> Array:
        """Returns those of the controller, by the model that made the decision.

        Sensors in doubt have none until the next decision.
        """
        learned = decision.learned
        gains = self._with_change(learned).gains(decision, parameters)
        if learned is None:
            return gains
        return np.where(learned.sensors_in_doubt, 0.0, gains)

    def _with_change(self, learned: LearningState | None) -> GPMPC:
        """Returns the controller with the model that plans after a measurement."""
        if learned is None or learned.planning is None:
            return self.controller
        return self.controller.with_model(learned.planning)

    def _learn(self, measured: Array, previous: Decision | None) -> LearningState:
        """Returns what the flight has taught up to a measurement (n,)."""
        learned = None if previous is None else previous.learned
        if previous is None or learned is None:
            return LearningState.begin(self._model, measured)
        input = learned.input_of_policy
        was_decided_at_last_measurement = np.array_equal(
            previous.means[0], learned.planned_state
        )
        if was_decided_at_last_measurement:
            input = previous.input
        if input is None:
            return learned.after_gap(measured)
        try:
            if not is_measured(measured).all():
                return learned.later(input)
            return learn_from_step(learned, input, measured)
        except LINEAR_ALGEBRA_FAILURES:  # where the model has a mean and no slope
            return learned.after_gap(measured)
        except (SettingError, DataError):
            # The points contradict each other beyond double precision.
            return LearningState.begin(self._model, measured, learned.version + 1)


def _belief(learned: LearningState, measured: Gaussian) -> Gaussian:
    """Returns what is known of the state: what is expected if the measurement is wrong.

    Args:
        learned: From the measurement as well.
        measured: The measurement. Where it is missing, nothing is known: what was
            expected a step before is not where the plant is now.
    """
    assumed = learned.assumed
    if assumed is None or not is_measured(to_array(measured.mean)).all():
        return measured
    device = measured.mean.device
    # In double precision, by which the next step tells what was planned from.
    return Gaussian(
        torch.as_tensor(assumed.mean, device=device),
        torch.as_tensor(assumed.covariance, device=device),
        measured.names,
    )


def _has_failed(decision: Decision) -> bool:
    """Returns whether a decision on a finite measurement must not be applied."""
    failed = not decision.applicable
    return failed and decision.status is not Status.INVALID_MEASUREMENT
