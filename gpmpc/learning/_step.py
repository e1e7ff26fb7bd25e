"""One step of online learning: is it learned, put in doubt, or does it end a doubt?

The package's text describes the procedure.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.stats import chi2

from gpmpc._angles import state_difference
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.learning._changed_model import ChangedModel, Comparison
from gpmpc.learning._innovation import LARGEST_LEAD, Innovation, LearningStep
from gpmpc.learning._settings import OnlineLearning
from gpmpc.learning._state import Doubt, Expectation, LearningState

# Differences of errors that say how large the noise is: at least, and at most.
_FEWEST_RATIOS = 3
_MOST_RATIOS = 100
# Deviations of the noise from which on an error is no measurement: an invalid one, as
# sensors mark it. Of such numbers even the squares are none.
_ABSURD = 1e50
_MISALIGNED = 0.1  # part of errors that no input explains, in deviations, at most
_MOST_CONFIRMATIONS = 1e6  # for the size of an error
_PATIENCE = 2  # further confirmations for steps that nothing explained, at most


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
    model = before.model
    # Arrays of their own: callers may reuse theirs.
    input = np.array(input, dtype=float)
    measured = np.array(measured, dtype=float)
    observed = model.observe(before.state, input, measured)
    if not (np.abs(observed.value) < _ABSURD * np.sqrt(model.gp_noise)).all():
        return before.after_gap(measured)
    noise_ratios = _with_noise_ratio(before, observed.value)
    seen = before.with_measurement(measured, observed.value, noise_ratios)
    if len(noise_ratios) < _FEWEST_RATIOS:
        return seen.later()
    step = LearningStep(
        state=before.state,
        input=input,
        next_state=measured,
        point=observed.point,
        observed_change=observed.value,
        latent_variance=observed.latent_variance,
        noise_variance=_noise_variance(noise_ratios, model),
    )
    comparison = model.predict_then_learn(step)
    if before.doubt is not None:
        # It is that of ``seen`` as well, and not None here.
        return _resolve_doubt(seen, step, comparison, before.doubt)
    innovation = comparison.planned(before.active)
    surprising = innovation.largest_square > model.learning.surprise
    if not surprising and not step.repeats.all():
        return _accept(seen, comparison)
    expected = seen.expect(Expectation.certain(before.state), step)
    if surprising or _is_frozen(seen, step, expected):
        return _put_in_doubt(
            seen,
            step,
            comparison,
            expected_if_wrong=expected,
            trusted_noise_ratios=before.noise_ratios,
        )
    return seen.later()


def _with_noise_ratio(before: LearningState, observed_change: Array) -> Array:
    """Returns the noise ratios (w,) with the one of a further observed change (k,)."""
    squares = (observed_change - before.observed_change) ** 2 / before.model.gp_noise
    ratio = float(squares.mean()) / 2.0
    if not np.isfinite(ratio):
        return before.noise_ratios
    return np.append(before.noise_ratios, ratio)[-_MOST_RATIOS:]


def _noise_variance(noise_ratios: Array, model: ChangedModel) -> Array:
    """Returns the noise (k,) of the model, or of the last steps where that is more.

    What changes slowly has no part in differences of successive errors, and a jump no
    weight in their median.
    """
    noise = model.gp_noise
    outputs = len(noise)
    median = float(np.sort(noise_ratios)[len(noise_ratios) // 2])
    return noise * max(1.0, median * outputs / _chi2_median(outputs))


@cache
def _chi2_median(degrees: int) -> float:
    return float(chi2.median(degrees))


def _accept(seen: LearningState, comparison: Comparison) -> LearningState:
    """Makes a step a point of the change, and decides whether the change is used."""
    unexplained_steps = max(0, seen.unexplained_steps - 1)
    learned = replace(
        seen, model=comparison.model_with_step, unexplained_steps=unexplained_steps
    )
    return _count_lead(learned, comparison.lead)


def _count_lead(seen: LearningState, lead: float) -> LearningState:
    """Decides whether the change is used, by its lead over the last steps."""
    settings = seen.model.learning
    leads = np.append(seen.leads, lead)[-settings.window :]
    total = float(leads.sum())
    active = total >= 0 if seen.active else total > settings.margin
    version = seen.version + (active or seen.active)
    return replace(seen, leads=leads, active=active, version=version).later()


def _count_doubtful_lead(seen: LearningState, lead: float) -> LearningState:
    """Counts a step in doubt, which may end the use of a change but not begin it."""
    return _count_lead(seen, lead) if seen.active else seen.later()


def _put_in_doubt(
    seen: LearningState,
    step: LearningStep,
    comparison: Comparison,
    expected_if_wrong: Expectation,
    trusted_noise_ratios: Array,
) -> LearningState:
    """Holds a measurement back that no prediction explains.

    Args:
        seen: With the measurement.
        step: The step that led to it.
        comparison: Of the predictions of the step.
        expected_if_wrong: Where the plant is if all measurements in doubt are wrong.
        trusted_noise_ratios: Those before the steps in doubt.
    """
    settings = seen.model.learning
    previous_doubt = seen.doubt  # that the measurement did not resolve
    if previous_doubt is None:
        unexplained_steps = seen.unexplained_steps
        steps_in_doubt = 1
    else:
        unexplained_steps = min(seen.unexplained_steps + 1, _PATIENCE)
        steps_in_doubt = previous_doubt.steps_in_doubt + 1

    new_plant = None
    confirmations_left = 1 + unexplained_steps
    tries_new_plant = False
    if not _is_frozen(seen, step, expected_if_wrong):
        alone = seen.model.without_points().predict_then_learn(step)
        new_plant = alone.model_with_step.later(1.0)
        further = alone.with_change.largest_square / settings.surprise
        confirmations_left += int(min(further, _MOST_CONFIRMATIONS))
        tries_new_plant = confirmations_left == 1 and _acts_like_input(
            innovation=comparison.planned(seen.active),
            by_input=seen.model.B_inverse @ expected_if_wrong.by_input,
            surprise=settings.surprise,
        )

    in_doubt = replace(
        seen,
        unexplained_steps=unexplained_steps,
        doubt=Doubt(
            expected=expected_if_wrong,
            trusted_noise_ratios=trusted_noise_ratios,
            new_plant=new_plant,
            confirmations_left=confirmations_left,
            steps_in_doubt=steps_in_doubt,
            tries_new_plant=tries_new_plant,
        ),
        version=seen.version + tries_new_plant,
    )
    return _count_doubtful_lead(in_doubt, comparison.lead)


def _is_frozen(seen: LearningState, step: LearningStep, expected: Expectation) -> bool:
    """Returns whether a sensor repeats itself exactly while the plant moves."""
    motion = state_difference(expected.mean, step.state, seen.model.angles)
    threshold = seen.model.learning.surprise * np.diagonal(expected.covariance)
    return bool(((motion**2 > threshold) & step.repeats).any())


def _acts_like_input(innovation: Innovation, by_input: Array, surprise: float) -> bool:
    """Returns whether several outputs err in the proportion in which inputs act.

    One wrong sensor is wrong alone, and several are not wrong in that proportion.

    Args:
        innovation: Of the model that plans.
        by_input: Derivative of what it predicted by the input (k, m).
        surprise: Squared error over its variance from which on an output errs.
    """
    deviation = np.sqrt(innovation.variance)
    errors = innovation.error / deviation
    effects = by_input / deviation[:, None]
    coefficients, _, rank, _ = np.linalg.lstsq(effects, errors, rcond=None)
    several = np.count_nonzero(errors**2 > surprise) > 1
    remaining = np.linalg.norm(errors - effects @ coefficients)
    aligned = remaining <= _MISALIGNED * np.linalg.norm(errors)
    return bool(several and aligned and rank < len(errors))


def _resolve_doubt(
    seen: LearningState, step: LearningStep, comparison: Comparison, doubt: Doubt
) -> LearningState:
    """Explains the measurement in doubt by the one after it."""
    settings = seen.model.learning
    # The measurement was wrong: what is measured follows from the state before it.
    expected_if_wrong = seen.expect(doubt.expected, step)
    if_wrong = seen.innovation(expected_if_wrong)
    # The plant was moved: what is measured follows from the measurement in doubt.
    if_moved = comparison.planned(seen.active)

    density_to_beat = max(if_wrong.log_density, if_moved.log_density) + LARGEST_LEAD
    new_plant = _new_plant_if_confirmed(doubt, step, density_to_beat, settings)
    if new_plant is not None and doubt.confirmations_left == 1:
        return _switch_plant(seen, new_plant)
    if new_plant is not None:
        confirmed = Doubt(
            expected=expected_if_wrong,
            trusted_noise_ratios=doubt.trusted_noise_ratios,
            new_plant=new_plant.later(1.0),
            confirmations_left=doubt.confirmations_left - 1,
            steps_in_doubt=doubt.steps_in_doubt + 1,
        )
        return _count_doubtful_lead(replace(seen, doubt=confirmed), comparison.lead)
    if min(if_moved.largest_square, if_wrong.largest_square) <= settings.surprise:
        return _count_doubtful_lead(seen.without_doubt(doubt), comparison.lead)
    return _put_in_doubt(
        seen, step, comparison, expected_if_wrong, doubt.trusted_noise_ratios
    )


def _new_plant_if_confirmed(
    doubt: Doubt, step: LearningStep, density_to_beat: float, settings: OnlineLearning
) -> ChangedModel | None:
    """Returns the new plant of a doubt with a step that it explains; None otherwise.

    Args:
        doubt: The doubt.
        step: A further step.
        density_to_beat: Log density that the new plant's has to exceed.
        settings: Those of the learning.
    """
    if doubt.new_plant is None or step.repeats.all():
        return None
    comparison = doubt.new_plant.predict_then_learn(step)
    innovation = comparison.with_change
    explained = innovation.largest_square <= settings.surprise
    if explained and innovation.log_density > density_to_beat:
        return comparison.model_with_step
    return None


def _switch_plant(seen: LearningState, new_plant: ChangedModel) -> LearningState:
    """Forgets what was seen, and uses the change of another plant."""
    switched = replace(
        seen,
        model=new_plant,
        leads=seen.leads[:0],
        active=True,
        version=seen.version + 1,
        doubt=None,
    )
    return switched.later()
