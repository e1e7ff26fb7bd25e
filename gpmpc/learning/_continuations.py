"""The ways in which an explanation may go on at a measurement, and their weights."""

from collections.abc import Iterator
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from gpmpc._angles import state_difference
from gpmpc._dynamics import Array, linearize
from gpmpc.learning._innovation import LearningStep
from gpmpc.learning._state import Expectation, Explanation

# Squared error over its variance up to which all sensors are right.
QUIET = 6.0
# Log prior of what happens in one step: another plant, whose change acts like an input;
# a push.
_NEW_PLANT = -12.0
_PUSH = -18.0
# Log prior of a change that acts on each output for itself, not like an input.
_OUTPUTS_APART = -3.0
# Log prior of each sensor that is wrong, but for the first: they fail one by one.
_ANOTHER_SENSOR = -5.0
# Steps for which a new plant does not change again: its first points are still to say
# how the change depends on state and input.
_SETTLING_STEPS = 5
_NEARLY_ZERO = 1e-100  # squared effect of an input
_INDEPENDENT = 0.01  # part of each deviation that no other sensor knows, at least
_NEGLIGIBLE = 40.0  # log weight below the heaviest, from which on nothing is kept
_HOPELESS = 1e8  # squared error over its variance that double precision compares


class Forecast(NamedTuple):
    """What an explanation and its model say of a step, before it is measured."""

    mean: Array  #: of the model alone (n,)
    latent: Array  #: covariance of the model alone (n, n)
    from_start: Array  #: covariance from where the plant was, moved by a step (n, n)
    by_input: Array  #: derivative of the mean by the input (n, m)
    point: Array  #: (phi, u, t), where the change is seen

    @property
    def is_finite(self) -> bool:
        """Whether the model has a number and a slope there."""
        total = self.mean.sum() + self.latent.sum() + self.from_start.sum()
        return bool(np.isfinite(total + self.by_input.sum() + self.point.sum()))


def forecast(explanation: Explanation, input: Array) -> Forecast:
    """Predicts a step by the model of an explanation alone.

    Args:
        explanation: Of what was measured before.
        input: Applied in the step (m,).
    """
    model = explanation.model
    start = explanation.expected
    states = start.mean[None]
    inputs = input[None]
    local = linearize(model.model, states, inputs)
    z, v, _ = model.features.linearize(states, inputs)
    from_start = start.covariance
    if not start.is_certain:
        from_start = local.A[0] @ start.covariance @ local.A[0].T
    return Forecast(
        mean=local.mean[0],
        latent=cast(Array, local.covariance)[0],
        from_start=from_start,
        by_input=local.B[0],
        point=np.concatenate([z[0], v[0], [model.time]]),
    )


def is_settling(explanation: Explanation) -> bool:
    """Returns whether the first points of another plant are being learned."""
    began = explanation.began
    if began is None or not len(explanation.model):
        return False
    return explanation.model.time - began < _SETTLING_STEPS


class Continuation(NamedTuple):
    """One way in which an explanation goes on."""

    explanation: Explanation  #: of the steps before
    forecast: Forecast  #: of the step, by it
    expected: Expectation  #: of what is measured, the measurement's noise included
    wrong: NDArray[np.bool_]  #: sensors that are wrong (n,)
    log_weight: float
    is_new_plant: bool = False  #: whether the plant is another one from this step on
    is_pushed: bool = False  #: whether the plant was moved to where it is measured

    @property
    def believes_all(self) -> bool:
        """Whether all sensors are right."""
        return not self.wrong.any()

    @property
    def began(self) -> float | None:
        """Time at which the plant became the one that it is [steps]."""
        explanation = self.explanation
        return explanation.model.time if self.is_new_plant else explanation.began

    @property
    def pushed(self) -> float | None:
        """Time at which the plant was last moved by a push [steps]."""
        explanation = self.explanation
        return explanation.model.time if self.is_pushed else explanation.pushed

    def says_the_same(self, other: "Continuation") -> bool:
        """Returns whether plant, push and wrong sensors are the same by another one."""
        is_same_plant = self.began == other.began and self.pushed == other.pushed
        return is_same_plant and np.array_equal(self.wrong, other.wrong)


class _Hypothesis(NamedTuple):
    """What is expected to be measured, if the plant is the same or another one."""

    expected: Expectation
    log_prior: float
    is_new_plant: bool = False


def continuations(
    explanation: Explanation, predicted: Forecast, step: LearningStep
) -> list[Continuation]:
    """Returns the ways in which an explanation may go on, with their weights.

    Args:
        explanation: Of the steps before.
        predicted: What it says of the step.
        step: Of the flight; its input, noise and measurements count.
    """
    model = explanation.model
    B = model.B_array
    surprise = model.learning.surprise
    noise = (B * step.noise_variance) @ B.T + np.diag(step.further_noise)
    same_plant = _same_plant(explanation, predicted, step.input, noise)
    expected = same_plant[0].expected
    variance = np.min(
        [np.diagonal(one.expected.covariance) for one in same_plant], axis=0
    )
    error = state_difference(step.next_state, expected.mean, model.angles)
    # A change that stops the plant is learned from a frozen sensor: the model alone
    # tells, too.
    motion = state_difference(expected.mean, step.state, model.angles)
    motion_alone = state_difference(predicted.mean, step.state, model.angles)
    largest_motion = np.maximum(np.abs(motion), np.abs(motion_alone))
    frozen = step.repeats & (largest_motion**2 > surprise * variance)
    if not frozen.any() and (error**2 <= QUIET * variance).all():
        # Nothing asks for another way.
        same_plant = same_plant[-1:]
        log_outlier = _log_outlier(error, noise, surprise)
        (_, log_likelihood), *_ = _sensor_sets(
            error, same_plant[0].expected, frozen, log_outlier
        )
        log_weight = explanation.log_weight + log_likelihood
        return [Continuation(explanation, predicted, expected, frozen, log_weight)]

    found = []
    hypotheses = same_plant + _new_plants(explanation, predicted, noise)
    for expected, log_prior, is_new_plant in hypotheses:
        error = state_difference(step.next_state, expected.mean, model.angles)
        log_outlier = _log_outlier(error, noise, surprise)
        for wrong, log_likelihood in _sensor_sets(error, expected, frozen, log_outlier):
            if wrong.any():
                log_likelihood -= _ANOTHER_SENSOR  # none for the first
            continuation = Continuation(
                explanation,
                predicted,
                expected,
                wrong,
                explanation.log_weight + log_prior + log_likelihood,
                is_new_plant,
            )
            found.append(continuation)
            if not is_new_plant and (wrong & ~frozen).any():
                pushed = continuation._replace(
                    wrong=frozen,
                    log_weight=continuation.log_weight + _PUSH,
                    is_pushed=True,
                )
                found.append(pushed)
    return found


def _log_outlier(error: Array, noise: Array, surprise: float) -> Array:
    """Returns the log density of what a wrong sensor shows (n,).

    It may be wrong by any order of magnitude. At a squared error of ``surprise`` noise
    variances it is as probable as a right one.

    Args:
        error: Measured less expected (n,).
        noise: Covariance of the noise (n, n).
        surprise: Of ``OnlineLearning``.
    """
    variance = np.diagonal(noise)
    squares = error**2 / (surprise * variance)
    return _ANOTHER_SENSOR - 0.5 * (
        surprise + np.log(2.0 * np.pi * variance) + np.log(squares.clip(1.0))
    )


def _same_plant(
    explanation: Explanation, predicted: Forecast, input: Array, noise: Array
) -> list[_Hypothesis]:
    """Returns what is expected where the plant goes on as explained.

    What its change is not sure of acts on each output for itself, or like an input.
    """
    model = explanation.model
    B = model.B_array
    alone = predicted.latent + predicted.from_start + noise
    if not explanation.active or not len(model):
        return [_Hypothesis(Expectation(predicted.mean, alone), log_prior=0.0)]
    start = explanation.expected
    local = model.linearize(start.mean[None], input[None])
    A = local.A[0]
    covariance = cast(Array, local.covariance)[0]
    change_variance = model.explainable_variance(covariance - predicted.latent)
    part_of_prior = np.sqrt((change_variance / model.signal).clip(0.0, 1.0))
    like_input = _like_input(explanation, predicted)
    like_input = B @ (part_of_prior[:, None] * like_input * part_of_prior) @ B.T
    from_start = A @ start.covariance @ A.T
    mean = local.mean[0]
    apart = Expectation(mean, covariance + from_start + noise)
    return [
        _Hypothesis(apart, _OUTPUTS_APART),
        _Hypothesis(Expectation(mean, alone + like_input), log_prior=0.0),
    ]


def _new_plants(
    explanation: Explanation, predicted: Forecast, noise: Array
) -> list[_Hypothesis]:
    """Returns what is expected where the plant is another one from this step on."""
    model = explanation.model
    if is_settling(explanation):
        return []
    B = model.B_array
    alone = predicted.latent + predicted.from_start + noise
    like_input = alone + B @ _like_input(explanation, predicted) @ B.T
    apart = alone + (B * model.signal) @ B.T
    return [
        _Hypothesis(Expectation(predicted.mean, like_input), _NEW_PLANT, True),
        _Hypothesis(
            Expectation(predicted.mean, apart), _NEW_PLANT + _OUTPUTS_APART, True
        ),
    ]


def _like_input(explanation: Explanation, predicted: Forecast) -> Array:
    """Returns the prior covariance (k, k) of a change that acts like an input.

    As other masses, actuators and winds do. Of each input so much that no output varies
    by more than the change's prior variance.
    """
    model = explanation.model
    by_input = model.B_inverse @ predicted.by_input
    scale = (model.signal[:, None] / (by_input**2).clip(_NEARLY_ZERO)).min(0)
    return (by_input * scale.clip(None, 1.0 / _NEARLY_ZERO)) @ by_input.T


def _sensor_sets(
    error: Array,
    expected: Expectation,
    frozen: NDArray[np.bool_],
    log_outlier: Array,
) -> Iterator[tuple[NDArray[np.bool_], float]]:
    """Yields sets of wrong sensors (n,) and the log likelihood of what is measured.

    First the smallest set, then each further sensor alone that may be it, then further
    ones together: each time the one whose absence explains most.

    Args:
        error: Measured less expected (n,).
        expected: With the covariance of the error.
        frozen: Sensors that are wrong in any case (n,).
        log_outlier: Log density of what a wrong sensor shows (n,).
    """
    variance = np.diagonal(expected.covariance)
    covariance = expected.covariance + np.diag(_INDEPENDENT**2 * variance)
    wrong = frozen | ~(error**2 < _HOPELESS * variance)
    is_first = True
    while not wrong.all():
        trusted = np.flatnonzero(~wrong)
        precision = np.linalg.inv(covariance[np.ix_(trusted, trusted)])
        weighted_error = precision @ error[trusted]
        _, log_determinant = np.linalg.slogdet(precision)
        log_likelihood = float(log_outlier[wrong].sum()) + 0.5 * float(
            log_determinant
            - error[trusted] @ weighted_error
            - len(trusted) * np.log(2.0 * np.pi)
        )
        yield wrong, log_likelihood
        # Without one of them: its part of the exponent and of the determinant goes.
        own_precision = np.diagonal(precision)
        own_density = 0.5 * (
            np.log(own_precision / (2.0 * np.pi)) - weighted_error**2 / own_precision
        )
        without = log_likelihood - own_density + log_outlier[trusted]
        best = int(without.argmax())
        if is_first:
            least = max(float(without[best]), log_likelihood) - _NEGLIGIBLE
            for index in np.flatnonzero(without >= least):
                alone = np.arange(len(error)) == trusted[index]
                yield wrong | alone, float(without[index])
        elif without[best] < log_likelihood:
            return
        is_first = False
        wrong = wrong | (np.arange(len(error)) == trusted[best])
    yield wrong, float(log_outlier.sum())
