"""One step of online learning: how the explanations of a flight go on.

The package's text describes the method.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.stats import chi2

from gpmpc._angles import state_difference
from gpmpc._arrays import is_measured
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.learning._changed_model import ChangedModel
from gpmpc.learning._continuations import (
    QUIET,
    Continuation,
    Forecast,
    continuations,
    forecast,
    is_settling,
)
from gpmpc.learning._innovation import LearningStep
from gpmpc.learning._state import Expectation, Explanation, LearningState

# Differences of errors that say how large the noise is: at least, and at most.
_FEWEST_RATIOS = 3
_MOST_RATIOS = 100
# Those that tell, of all outputs together, whether noise has just grown; and by how
# much it may.
_LATEST_RATIOS = 9
_NOTABLE_RATIO = 2.0
_LARGEST_RATIO = 1e4
# Ratios of which the median is taken, at least: those that are not known yet count as
# of the model's own noise, since one sensor may be wrong from the beginning.
_FEWEST_OF_MEDIAN = 16
_MOST_EXPLANATIONS = 8
_LARGEST_LEAD = 20.0  # of the heaviest explanation's log weight, over those kept
# Steps for which a lighter explanation may agree with the heaviest on the state.
_PATIENCE = 5
# Noise variance of what is only predicted, in variances of the prediction.
_UNTAUGHT = 1e6


@explains_arguments
def learn_from_step(
    before: LearningState, input: Array, measured: Array
) -> LearningState:
    """Learns from one step of a flight.

    Args:
        before: What the steps before have taught, with the state measured last.
        input: Applied in the step (m,).
        measured: State measured after it (n,).
    """
    # Arrays of their own: callers may reuse theirs.
    input = np.array(input, dtype=float)
    measured = np.array(measured, dtype=float)
    forecasts = [forecast(one, input) for one in before.explanations]
    predicted = forecasts[0]
    if not is_measured(measured).all() or not predicted.is_finite:
        return before.after_gap(measured)

    model = before.model
    error = state_difference(measured, predicted.mean, model.angles)
    observed_change = model.B_inverse @ error
    unexplained = error - model.B_array @ observed_change
    after = _at_measurement(before, measured, observed_change, unexplained)
    if len(after.noise_ratios) < _FEWEST_RATIOS:
        return after.with_explanations((before.heaviest.believing(measured),))
    step = LearningStep(
        state=before.state,
        input=input,
        next_state=measured,
        point=predicted.point,
        observed_change=observed_change,
        unexplained=unexplained,
        latent_variance=model.explainable_variance(predicted.latent),
        noise_variance=_noise_variance(after.noise_ratios, before.heaviest),
        further_noise=_further_noise(after.further_ratios, model),
        follows_gap=before.is_gap,
    )
    if len(before.explanations) == 1:
        ordinary = _ordinary_step(before.heaviest, step)
        if ordinary is not None:
            return after.with_explanations((ordinary,))

    candidates: list[Continuation] = []
    for explanation, of_explanation in zip(before.explanations, forecasts, strict=True):
        if of_explanation.is_finite:
            candidates += continuations(explanation, of_explanation, step)
    heaviest, *others = _heaviest(candidates)
    explanations = [_continued(heaviest, heaviest, step)]
    for other in others:
        explanation = _continued(other, heaviest, step)
        if explanation.agreed_steps <= _PATIENCE:
            explanations.append(explanation)
    return after.with_explanations(tuple(explanations))


def _at_measurement(
    before: LearningState, measured: Array, observed_change: Array, unexplained: Array
) -> LearningState:
    """Returns the state at a measurement, with what the step says of the noise.

    Args:
        before: With the changes that were observed before.
        measured: State after the step (n,).
        observed_change: In the step (k,).
        unexplained: What d cannot explain of the error (n,).
    """
    if before.is_gap:
        return replace(before, state=measured, is_gap=False, has_failed=False)
    model = before.model
    believed_change = before.observed_change
    difference = np.abs(observed_change - before.observed_change)
    if not before.heaviest.expected.is_certain:
        # A sensor that is wrong once has a part in one difference, and no offset has.
        believed_change = before.believed_change
        difference = np.minimum(difference, np.abs(observed_change - believed_change))
    noise_ratios = before.noise_ratios
    further_ratios = before.further_ratios
    ratio = difference**2 / (2.0 * model.gp_noise)
    if np.isfinite(ratio).all():
        noise_ratios = np.vstack([noise_ratios, ratio])[-_MOST_RATIOS:]
    if model.has_unreached_states:
        # A sensor that repeats itself counts as one that does not scatter.
        scattered = np.where(before.state == measured, 0.0, unexplained)
        ratio = scattered**2 / model.sensor_noise
        further_ratios = np.vstack([further_ratios, ratio])[-_MOST_RATIOS:]
    return replace(
        before,
        state=measured,
        observed_change=observed_change,
        believed_change=believed_change,
        noise_ratios=noise_ratios,
        further_ratios=further_ratios,
        has_failed=False,
    )


def _noise_variance(noise_ratios: Array, heaviest: Explanation) -> Array:
    """Returns the noise (k,) of the model, or of the last steps where that is more.

    The median of differences of successive errors tells it: what changes slowly has no
    part in them, and a sensor that is wrong now and then has no weight. A change that
    varies fast adds to the differences of the outputs that it acts on. So where a
    change is used, the median over all outputs together counts where it is less.

    Args:
        noise_ratios: Of the last steps (w, k).
        heaviest: The explanation that plans.
    """
    gp_noise = heaviest.model.gp_noise
    outputs = len(gp_noise)
    median = _median(noise_ratios, _FEWEST_OF_MEDIAN) / _chi2_median(1)
    if heaviest.active:
        mean_ratios = noise_ratios.mean(axis=1)
        together = _median(mean_ratios, _FEWEST_OF_MEDIAN)
        median = np.minimum(median, together * outputs / _chi2_median(outputs))
    latest = _median(noise_ratios[-_LATEST_RATIOS:].ravel())
    if not _NOTABLE_RATIO < latest < _LARGEST_RATIO:
        latest = 0.0  # by chance, or no noise
    return gp_noise * np.maximum(median, latest / _chi2_median(1)).clip(1.0)


def _further_noise(further_ratios: Array, model: ChangedModel) -> Array:
    """Returns the noise (n,) besides that of the GP, or that of the last steps.

    What no change can explain is noise, however slowly it changes.

    Args:
        further_ratios: Of the last steps (w, n).
        model: Whose noise it is.
    """
    if not len(further_ratios):
        return model.further_noise
    median = _median(further_ratios, _FEWEST_OF_MEDIAN) / _chi2_median(1)
    latest = _median(further_ratios[-_LATEST_RATIOS:])
    is_notable = (latest > _NOTABLE_RATIO) & (latest < _LARGEST_RATIO)
    grown = np.where(is_notable, latest, 0.0) / _chi2_median(1)
    variance = model.sensor_noise * np.maximum(median, grown)
    return np.maximum(model.further_noise, variance)


@cache
def _chi2_median(degrees: int) -> float:
    return float(chi2.median(degrees))


def _median(values: Array, fewest: int = 0) -> Any:
    """Returns the median over the first axis, the upper one of an even number.

    NumPy takes several times as long, which every step would pay.

    Args:
        values: Those that are known (w, ...); at least one.
        fewest: Of which it is taken. As many as are missing count as zero.
    """
    count = len(values)
    unknown = max(0, fewest - count)
    rank = (count + unknown) // 2 - unknown
    if rank < 0:
        return 0.0 * values[0]
    return np.partition(values, rank, axis=0)[rank]


def _ordinary_step(before: Explanation, step: LearningStep) -> Explanation | None:
    """Goes on where all sensors are right; None where anything asks for another way."""
    if not before.expected.is_certain or step.repeats.any() or is_settling(before):
        return None
    model = before.model
    comparison = model.predict_then_learn(step)
    innovation = comparison.planned(before.active)
    error = step.unexplained + model.B_array @ innovation.error
    variance = model.B_squared @ innovation.variance + step.further_noise
    # What is no number is not quiet, too.
    if not (error**2 <= QUIET * variance).all():
        return None
    learned = replace(before, model=comparison.model_with_step)
    return learned.believing(step.next_state).with_lead(comparison.lead)


def _heaviest(candidates: Sequence[Continuation]) -> list[Continuation]:
    """Returns the heaviest ways to go on, heaviest first, each plant and doubt once.

    One that believes all sensors is always among those that are near enough: so no
    doubt lasts.
    """
    ordered = sorted(candidates, key=lambda one: one.log_weight, reverse=True)
    kept: list[Continuation] = []
    for candidate in ordered:
        if ordered[0].log_weight - candidate.log_weight > _LARGEST_LEAD:
            break
        if any(candidate.says_the_same(other) for other in kept):
            continue
        nobody_believes = not any(other.believes_all for other in kept)
        is_needed = candidate.believes_all and nobody_believes
        if len(kept) < _MOST_EXPLANATIONS or is_needed:
            kept.append(candidate)
    return kept


def _continued(
    continuation: Continuation, heaviest: Continuation, step: LearningStep
) -> Explanation:
    """Returns an explanation after a step.

    Args:
        continuation: How it goes on.
        heaviest: How the heaviest one does.
        step: Of the flight.
    """
    is_as_before = not (continuation.is_new_plant or continuation.is_pushed)
    agrees = continuation.believes_all and heaviest.believes_all
    agreed_steps = 0
    if is_as_before and agrees and continuation is not heaviest:
        agreed_steps = continuation.explanation.agreed_steps + 1
    before = replace(
        continuation.explanation,
        log_weight=continuation.log_weight - heaviest.log_weight,
        agreed_steps=agreed_steps,
    )
    expected = _expected_state(continuation, step)
    after = replace(
        before,
        expected=expected,
        began=continuation.began,
        pushed=continuation.pushed,
    )
    model = before.model
    if continuation.is_new_plant:
        model = model.without_points()
        after = replace(after, model=model, active=True, leads=np.empty(0))
    if continuation.is_pushed or not step.teaches:
        return after
    comparison = model.predict_then_learn(
        _observed_step(continuation, expected, step, model)
    )
    learned = replace(after, model=comparison.model_with_step)
    if continuation.is_new_plant:
        return learned
    return learned.with_lead(comparison.lead)


def _expected_state(continuation: Continuation, step: LearningStep) -> Expectation:
    """Returns where the plant is after a step."""
    wrong = continuation.wrong
    if not wrong.any():
        return Expectation.certain(step.next_state)
    expected = continuation.expected
    if continuation.is_pushed:  # and a sensor is frozen: the others say nothing of it
        return Expectation(
            mean=np.where(wrong, expected.mean, step.next_state),
            covariance=np.where(np.outer(wrong, wrong), expected.covariance, 0.0),
        )
    angles = continuation.explanation.model.angles
    error = state_difference(step.next_state, expected.mean, angles)
    return expected.conditioned_on(error, step.next_state, ~wrong)


def _observed_step(
    continuation: Continuation,
    expected: Expectation,
    step: LearningStep,
    model: ChangedModel,
) -> LearningStep:
    """Returns what a step says of the change, by an explanation.

    Args:
        continuation: How it goes on.
        expected: Where the plant is after the step.
        step: Of the flight.
        model: With the change that the step is to teach.
    """
    predicted: Forecast = continuation.forecast
    change = state_difference(expected.mean, predicted.mean, model.angles)
    variance = model.explainable_variance(expected.covariance)
    if not continuation.is_new_plant:
        # What is only predicted is what the change has said itself.
        variance = _UNTAUGHT * variance
    return LearningStep(
        state=continuation.explanation.expected.mean,
        input=step.input,
        next_state=expected.mean,
        point=predicted.point,
        observed_change=model.B_inverse @ change,
        unexplained=step.unexplained,
        latent_variance=model.explainable_variance(predicted.latent),
        noise_variance=(
            step.noise_variance
            + model.explainable_variance(predicted.from_start)
            + variance
        ),
        further_noise=step.further_noise,
        follows_gap=step.follows_gap,
    )
