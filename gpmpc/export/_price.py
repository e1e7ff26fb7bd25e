"""What fewer points cost: the one-step error and the closed loop, beside all points.

A controller is flown as its user flies it, and what it was asked is noted on the way:
the states it decided for, which test the models' predictions, and the references.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gpmpc._angles import angles_of, state_difference
from gpmpc._dynamics import DynamicsModel, linearize, to_array
from gpmpc.exceptions import Diverged, SettingError, SolverFailure
from gpmpc.export._replay import Question
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import GPMPC, Decision, Reference
from gpmpc.signals import Signals
from gpmpc.simulation import Rollout

Array = np.ndarray
# of a state, below which an error is round-off
_EXACT = 1e-12
#: flies a controller
Fly = Callable[[Any], Rollout]


class Flight(NamedTuple):
    """A flight, and what its controller was asked at each of its K steps."""

    questions: list[Question]
    inputs: Array  #: that were applied (K, m)
    cost: float  #: of all steps

    @property
    def states(self) -> Array:
        """What was decided for (K, n)."""
        return np.array([question.measured for question in self.questions])


class _Witness:
    """A controller that notes what it is asked."""

    def __init__(self, controller: GPMPC):
        self.horizon = controller.horizon
        self.problem = controller.problem
        self.initial_input = controller.initial_input
        self.questions: list[Question] = []
        self._controller = controller

    @property
    def signals(self) -> Signals:
        """Those of the controller."""
        return self._controller.signals

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
    ) -> Decision:
        """Decides as the controller does."""
        measured = to_array(belief.mean).copy()
        self.questions.append(Question(measured, reference, parameters))
        return self._controller.control(belief, reference, previous, parameters)


def flight_of(fly: Fly, controller: GPMPC) -> Flight:
    """Flies a controller.

    Raises:
        SettingError: ``fly`` returns no ``Rollout``, or one of another controller.
    """
    witness = _Witness(controller)
    rollout = fly(witness)
    if not isinstance(rollout, Rollout):
        rule = "must return the Rollout of a closed loop"
        raise SettingError("fly", f"{rule}; got {type(rollout).__name__}")
    steps = len(rollout.inputs)
    if not 0 < steps <= len(witness.questions):
        rule = "must fly the controller that it is handed"
        count = len(witness.questions)
        raise SettingError(
            "fly", f"{rule}; it was asked {count} times in {steps} steps"
        )
    # a rehearsal asks before the first step
    questions = witness.questions[-steps:]
    return Flight(questions, rollout.inputs, _cost(rollout, controller, questions))


def cost_of(fly: Fly, controller: GPMPC) -> float:
    """Returns the cost of a flight, infinite where it came to no end."""
    try:
        return flight_of(fly, controller).cost
    except (Diverged, SolverFailure):
        return math.inf


def ratio_of_errors(
    model: DynamicsModel, all_points: DynamicsModel, flight: Flight
) -> float:
    """Returns the root mean square of one-step errors, beside that of all points.

    Each state's errors count in units of its error by all points; states that these
    predict exactly, such as inputs on their way, do not count. NaN where all are.
    """
    errors = _squared_errors(model, flight)
    least = _squared_errors(all_points, flight)
    counts = least > (_EXACT * np.nanmax(np.abs(flight.states), axis=0)) ** 2
    if not counts.any():
        return math.nan
    return float(np.sqrt((errors[counts] / least[counts]).mean()))


def _squared_errors(model: DynamicsModel, flight: Flight) -> Array:
    """Returns mean squared errors (n,) of the predictions along a flight."""
    states = flight.states
    predicted = linearize(model, states[:-1], flight.inputs[:-1], False).mean
    errors = state_difference(predicted, states[1:], angles_of(model))
    finite = np.isfinite(errors).all(axis=1)  # a lost measurement is none
    return np.square(errors[finite]).mean(axis=0) if finite.any() else errors.sum(0)


def _cost(rollout: Rollout, controller: GPMPC, questions: list[Question]) -> float:
    """Returns the tracking cost of all steps of a flight.

    States that a plant does not show, such as inputs on their way, do not count.
    """
    cost = controller.problem.cost
    hidden = len(np.atleast_2d(cost.Q)[-1]) - rollout.states.shape[1]
    padding = ((0, 0), (0, max(hidden, 0)))
    reference_inputs = None
    if cost.penalized == "deviations":
        H = controller.horizon
        followed = [question.reference.over(H).inputs for question in questions]
        reference_inputs = np.array([np.asarray(inputs)[0] for inputs in followed])
    costs = cost.paid(
        states=np.pad(rollout.states, padding),
        inputs=rollout.inputs,
        references=np.pad(rollout.references, padding),
        previous_input=controller.initial_input,
        reference_inputs=reference_inputs,
    )
    total = float(costs.sum())
    return total if math.isfinite(total) else math.inf
