"""What fewer points cost: the one-step error and the closed loop, beside all points.

A controller is flown as its user flies it, and what it was asked is noted on the way:
the states it decided for, which test the models' predictions, and the references.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc._angles import angles_of, state_difference
from gpmpc._dynamics import DynamicsModel, linearize, to_array
from gpmpc.exceptions import Diverged, SettingError, SolverFailure
from gpmpc.export._replay import Question
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import GPMPC, Decision, Reference
from gpmpc.mpc._controller import one_step_on
from gpmpc.signals import Signals
from gpmpc.simulation import Rollout
from gpmpc.status import Status

Array = np.ndarray
# of a state, below which an error is round-off
_EXACT = 1e-12
#: flies a controller
Fly = Callable[[Any], Rollout]


class Flight(NamedTuple):
    """A flight, and what its controller was asked at each of its K steps."""

    questions: list[Question]  #: of a lost measurement, the state is NaN
    inputs: Array  #: that were applied (K, m)
    cost: float  #: of all steps

    @property
    def states(self) -> Array:
        """What was decided for (K, n)."""
        return np.array([question.measured for question in self.questions])


class _Witness:
    """A controller that notes what it is asked, where the state was known."""

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
        decision = self._controller.control(belief, reference, previous, parameters)
        if decision.status is not Status.INVALID_MEASUREMENT:
            self.questions.append(Question(measured, reference, parameters))
        return decision


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
    questions = _questions_by_step(rollout, witness)
    return Flight(questions, rollout.inputs, _cost(rollout, controller, questions))


def _questions_by_step(rollout: Rollout, witness: _Witness) -> list[Question]:
    """Returns what a controller was asked at each step (K,).

    Nobody asks it where a measurement was lost. The reference of such a step is that of
    the one before, a stage later, or at the beginning that of the first question.

    Raises:
        SettingError: It was asked at fewer steps than were decided.
    """
    is_known = [s is not Status.INVALID_MEASUREMENT for s in rollout.statuses]
    known = sum(is_known)
    asked = witness.questions
    if not 0 < known <= len(asked):
        rule = "must fly the controller that it is handed"
        got = f"it was asked {len(asked)} times in {known} steps"
        raise SettingError("fly", f"{rule}; {got} whose measurement was not lost")
    # a rehearsal, ``gpmpc.simulation.rehearse``, asks before the first step
    in_flight = iter(asked[len(asked) - known :])
    first = asked[len(asked) - known]
    question = first._replace(measured=np.full_like(first.measured, np.nan))
    questions = []
    for step, is_asked in enumerate(is_known):
        if is_asked:
            question = next(in_flight)
        elif step > 0:
            question = _lost_after(question, witness.horizon)
        questions.append(question)
    return questions


def _lost_after(question: Question, horizon: int) -> Question:
    """Returns the question of a step without a measurement, after another one."""
    followed = question.reference.over(horizon)
    later = replace(followed, states=one_step_on(followed.states))
    if followed.inputs is not None:
        later = replace(later, inputs=one_step_on(np.asarray(followed.inputs)))
    lost = np.full_like(question.measured, np.nan)
    return question._replace(measured=lost, reference=later)


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
