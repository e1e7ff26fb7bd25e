"""One step of online learning: is it learned, put in doubt, or does it end a doubt?

The package's text describes the procedure.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from gpmpc._angles import state_difference
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.learning._changed_model import ChangedModel, Comparison, ObservedChange
from gpmpc.learning._innovation import LARGEST_LEAD, Innovation, LearningStep
from gpmpc.learning._state import Doubt, Expectation, LearningState, NewPlant

# Differences of errors that say how large the noise is: at least, and at most.
_FEWEST_RATIOS = 3
_MOST_RATIOS = 100
# Deviations of the noise from which on an error is no measurement: an invalid one, as
# sensors mark it. Of such numbers even the squares are none.
_ABSURD = 1e50
_MISALIGNED = 0.1  # part of errors that no input explains, in deviations, at most
# Where acting on a measurement is at stake, not a model: squared errors of outputs that
# err, at least, and what no input explains, at most.
_NOTABLE = 9.0
_DEVIATIONS = 3.0
_MOST_CONFIRMATIONS = 1e6  # for the size of an error
_LONGEST_BRIDGE = 2  # steps in doubt whose measurement is not acted on, at most
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
        if before.doubt is None:
            return before.after_gap(measured)
        return _resolve_outside_model(before, before.doubt, input, measured, observed)
    noise_ratios = _with_noise_ratio(before, observed.value)
    learning_state = before.with_measurement(measured, observed.value, noise_ratios)
    if len(noise_ratios) < _FEWEST_RATIOS:
        return learning_state.later()
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
        # It is that of ``learning_state`` as well, and not None here.
        try:
            return _resolve_doubt(learning_state, step, comparison, before.doubt)
        except np.linalg.LinAlgError:  # the model has a mean there, and no slope
            return _resolve_outside_model(
                before, before.doubt, input, measured, observed
            )
    innovation = comparison.planned(before.active)
    # What is no number is surprising, too.
    surprising = not innovation.largest_square <= model.learning.surprise
    if not surprising and not step.repeats.all():
        return _accept(learning_state, comparison)
    expected = learning_state.expect(Expectation.certain(before.state, model), step)
    if surprising or _is_frozen(learning_state, step, expected):
        return _put_in_doubt(
            learning_state,
            step,
            comparison,
            expected_if_wrong=expected,
            trusted_noise_ratios=before.noise_ratios,
        )
    return learning_state.later()


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


def _accept(learning_state: LearningState, comparison: Comparison) -> LearningState:
    """Makes a step a point of the change, and decides whether the change is used."""
    unexplained_steps = max(0, learning_state.unexplained_steps - 1)
    learned = replace(
        learning_state,
        model=comparison.model_with_step,
        unexplained_steps=unexplained_steps,
    )
    return _count_lead(learned, comparison.lead)


def _count_lead(learning_state: LearningState, lead: float) -> LearningState:
    """Decides whether the change is used, by its lead over the last steps."""
    settings = learning_state.model.learning
    leads = np.append(learning_state.leads, lead)[-settings.window :]
    total = float(leads.sum())
    active = total >= 0 if learning_state.active else total > settings.margin
    version = learning_state.version + (active or learning_state.active)
    return replace(learning_state, leads=leads, active=active, version=version).later()


def _count_doubtful_lead(learning_state: LearningState, lead: float) -> LearningState:
    """Counts a step in doubt, which may end the use of a change but not begin it."""
    return (
        _count_lead(learning_state, lead)
        if learning_state.active
        else learning_state.later()
    )


def _put_in_doubt(
    learning_state: LearningState,
    step: LearningStep,
    comparison: Comparison,
    expected_if_wrong: Expectation,
    trusted_noise_ratios: Array,
    bounded_density_to_beat: float = 0.0,
) -> LearningState:
    """Holds a measurement back that no prediction explains.

    Args:
        learning_state: With the measurement.
        step: The step that led to it.
        comparison: Of the predictions of the step.
        expected_if_wrong: Where the plant is if all measurements in doubt are wrong.
        trusted_noise_ratios: Those before the steps in doubt.
        bounded_density_to_beat: What the bounded log density of a plant that the
            measurement before has put forward must exceed, for it to be tried.
    """
    trusted = _trusted_sensors(step, expected_if_wrong, learning_state.model)
    previous_doubt = learning_state.doubt  # that the measurement did not resolve
    unexplained_steps = learning_state.unexplained_steps
    steps_in_doubt = 1
    starts = [Expectation.certain(step.state, learning_state.model)]
    continued_plants: tuple[NewPlant, ...] = ()
    if previous_doubt is not None:
        if (trusted | previous_doubt.trusted).all():
            # The sensors that were wrong are right again: they were for one step.
            learning_state = learning_state.without_doubt(previous_doubt)
            starts = [_begun_now(previous_doubt.expected)]
        else:
            unexplained_steps = min(learning_state.unexplained_steps + 1, _PATIENCE)
            steps_in_doubt = previous_doubt.steps_in_doubt + 1
            continued_plants = _without_last_measurement(
                previous_doubt.new_plants, step, bounded_density_to_beat
            )
            if previous_doubt.bridged:
                # The change begins with this step, or with the first in doubt.
                starts.append(_begun_now(previous_doubt.expected))
                starts.append(previous_doubt.expected)

    acts_like_input = _acts_like_input(
        innovation=learning_state.innovation(expected_if_wrong),
        by_input=learning_state.model.B_inverse @ expected_if_wrong.by_input,
        notable=_NOTABLE,
        deviations=_DEVIATIONS,
    )
    bridged = steps_in_doubt <= _LONGEST_BRIDGE and not acts_like_input
    new_plants: tuple[NewPlant, ...] = ()
    if not _is_frozen(learning_state, step, expected_if_wrong):
        new_plants = tuple(
            _new_plant(
                learning_state,
                step,
                start,
                unexplained_steps,
                steps_in_doubt,
                may_be_tried=acts_like_input,
            )
            for start in starts
        )
        new_plants += continued_plants
    doubt = Doubt(
        expected=expected_if_wrong.conditioned_on(
            learning_state.state, trusted, learning_state.model
        ),
        trusted=trusted,
        trusted_noise_ratios=trusted_noise_ratios,
        new_plants=new_plants,
        steps_in_doubt=steps_in_doubt,
        bridged=bridged,
    )
    in_doubt = replace(
        learning_state,
        unexplained_steps=unexplained_steps,
        doubt=doubt,
        version=learning_state.version + (doubt.tried_plant is not None),
    )
    return _count_doubtful_lead(in_doubt, comparison.lead)


def _begun_now(start: Expectation) -> Expectation:
    """Returns an expectation from which on a change acts."""
    return start._replace(
        by_input=0.0 * start.by_input, by_change=0.0 * start.by_change
    )


def _without_last_measurement(
    plants: tuple[NewPlant, ...],
    step: LearningStep,
    density_to_beat: float,
) -> tuple[NewPlant, ...]:
    """Returns new plants of which the last measurement, of a step, was wrong.

    A plant that explains all outputs but one, and more than anything else does, is
    tried: one sensor is wrong. The others are given up if the measurement before was
    wrong already.

    Args:
        plants: Put forward by the measurement before.
        step: The step that none of them explains.
        density_to_beat: Bounded log density that the one of a plant has to exceed.
    """
    remaining_plants = []
    for plant in plants:
        surprise = plant.model.learning.surprise
        expected = plant.after(step)
        innovation = _innovation_of(plant, step, expected)
        explained = int(np.count_nonzero(innovation.squares <= surprise))
        several_explained = 1 < explained == len(innovation.error) - 1
        density = innovation.bounded_log_density(surprise)
        is_tried = several_explained and density > density_to_beat
        if plant.expected is not None and not is_tried:
            continue
        confirmations_left = plant.confirmations_left
        if is_tried:
            confirmations_left = max(1, confirmations_left - 1)
            trusted = _trusted_sensors(step, expected, plant.model)
            expected = expected.conditioned_on(step.next_state, trusted, plant.model)
        remaining_plants.append(
            plant._replace(
                model=plant.model.later(1.0),
                expected=expected,
                confirmations_left=confirmations_left,
                tried=is_tried,
            )
        )
    return tuple(remaining_plants)


def _new_plant(
    learning_state: LearningState,
    step: LearningStep,
    start: Expectation,
    unexplained_steps: int,
    steps_in_doubt: int,
    may_be_tried: bool,
) -> NewPlant:
    """Returns the plant whose change explains a measurement.

    Args:
        learning_state: With the measurement.
        step: That led to it.
        start: Where the plant was before; ``by_change`` says since when it is changed.
        unexplained_steps: Each asks for a further confirmation.
        steps_in_doubt: This one included.
        may_be_tried: Whether several sensors err together, from what is trusted.
    """
    model = learning_state.model.without_points()
    surprise = model.learning.surprise
    expected = start.after(step, model.model, model)
    error = state_difference(step.next_state, expected.mean, model.angles)
    from_change = np.linalg.pinv(expected.by_change)
    variance = ((from_change @ expected.covariance) * from_change).sum(-1)
    z, v, _ = model.features.linearize(start.mean[None], step.input[None])
    observed = step._replace(
        point=np.concatenate([z[0], v[0], [model.time]]),
        observed_change=from_change @ error,
        # What predicts adds the latent variance again.
        noise_variance=np.maximum(variance - step.latent_variance, step.noise_variance),
    )
    comparison = model.predict_then_learn(observed)
    further = comparison.with_change.largest_square / surprise
    confirmations = 1 + unexplained_steps + int(min(further, _MOST_CONFIRMATIONS))
    tried = False
    if may_be_tried and confirmations <= steps_in_doubt <= _LONGEST_BRIDGE:
        planned = learning_state.expect(start, step)
        tried = _acts_like_input(
            innovation=learning_state.innovation(planned),
            by_input=model.B_inverse @ planned.by_input,
            notable=surprise,
        )
    return NewPlant(
        model=comparison.model_with_step.later(1.0),
        expected=None,
        confirmations_left=confirmations,
        tried=tried,
    )


def _trusted_sensors(
    step: LearningStep, expected: Expectation, model: ChangedModel
) -> NDArray[np.bool_]:
    """Returns which sensors (n,) move in a step, and show what is expected."""
    error = state_difference(step.next_state, expected.mean, model.angles)
    threshold = model.learning.surprise * np.diagonal(expected.covariance)
    return (error**2 <= threshold) & ~step.repeats


def _is_frozen(
    learning_state: LearningState, step: LearningStep, expected: Expectation
) -> bool:
    """Returns whether a sensor repeats itself exactly while the plant moves."""
    motion = state_difference(expected.mean, step.state, learning_state.model.angles)
    threshold = learning_state.model.learning.surprise * np.diagonal(
        expected.covariance
    )
    return bool(((motion**2 > threshold) & step.repeats).any())


def _acts_like_input(
    innovation: Innovation, by_input: Array, notable: float, deviations: float = 0.0
) -> bool:
    """Returns whether several outputs err in the proportion in which inputs act.

    One wrong sensor is wrong alone, and several are not wrong in that proportion.

    Args:
        innovation: Of the model that plans.
        by_input: Derivative of what it predicted by the input (k, m).
        notable: Squared error over its variance from which on an output errs.
        deviations: What noise may add to a proportion.
    """
    deviation = np.sqrt(innovation.variance)
    errors = innovation.error / deviation
    effects = by_input / deviation[:, None]
    coefficients, _, rank, _ = np.linalg.lstsq(effects, errors, rcond=None)
    several = np.count_nonzero(errors**2 > notable) > 1
    remaining = np.linalg.norm(errors - effects @ coefficients)
    tolerance = max(_MISALIGNED * float(np.linalg.norm(errors)), deviations)
    aligned = remaining <= tolerance
    # As many independent effects as outputs explain any errors.
    return bool(several and aligned and rank < len(errors))


def _resolve_doubt(
    learning_state: LearningState,
    step: LearningStep,
    comparison: Comparison,
    doubt: Doubt,
) -> LearningState:
    """Explains the measurement in doubt by the one after it."""
    settings = learning_state.model.learning
    # The measurement was wrong: what is measured follows from the state before it.
    expected_if_wrong = learning_state.expect(doubt.expected, step)
    if_wrong = learning_state.innovation(expected_if_wrong)
    # The plant was moved: what is measured follows from the measurement in doubt.
    if_moved = comparison.planned(learning_state.active)

    density_to_beat = max(if_wrong.log_density, if_moved.log_density) + LARGEST_LEAD
    plants = [_confirmed(plant, step, density_to_beat) for plant in doubt.new_plants]
    confirmed = tuple(plant for plant in plants if plant is not None)
    for plant in confirmed:
        if plant.confirmations_left == 0:
            return _switch_plant(learning_state.without_doubt(doubt), plant.model)
    if confirmed:
        continued_doubt = _continued_doubt(
            learning_state,
            step,
            doubt,
            expected_if_wrong,
            new_plants=tuple(p._replace(model=p.model.later(1.0)) for p in confirmed),
        )
        confirmed_once = replace(
            learning_state, doubt=continued_doubt, version=learning_state.version + 1
        )
        return _count_doubtful_lead(confirmed_once, comparison.lead)
    if if_wrong.largest_square <= settings.surprise:
        return _count_doubtful_lead(
            learning_state.without_doubt(doubt), comparison.lead
        )
    if if_moved.largest_square <= settings.surprise:
        # A plant that moves is seen by several sensors; one alone may be wrong twice.
        is_single_sensor = np.count_nonzero(if_wrong.squares > settings.surprise) == 1
        if (
            is_single_sensor
            and doubt.bridged
            and doubt.steps_in_doubt < _LONGEST_BRIDGE
        ):
            # Nor is a measurement acted on that follows from the one in doubt.
            continued_doubt = _continued_doubt(
                learning_state, step, doubt, expected_if_wrong, bridged=True
            )
            after = replace(learning_state, doubt=continued_doubt)
        else:
            after = learning_state.without_doubt(doubt)
        return _count_doubtful_lead(after, comparison.lead)
    bounded_density = max(
        if_wrong.bounded_log_density(settings.surprise),
        if_moved.bounded_log_density(settings.surprise),
    )
    return _put_in_doubt(
        learning_state,
        step,
        comparison,
        expected_if_wrong,
        doubt.trusted_noise_ratios,
        bounded_density_to_beat=bounded_density + LARGEST_LEAD,
    )


def _continued_doubt(
    learning_state: LearningState,
    step: LearningStep,
    doubt: Doubt,
    expected_if_wrong: Expectation,
    new_plants: tuple[NewPlant, ...] = (),
    bridged: bool = False,
) -> Doubt:
    """Returns a doubt that lasts a step longer.

    Args:
        learning_state: With the measurement of now.
        step: The step that led to it.
        doubt: By the step before.
        expected_if_wrong: Where the plant is if all measurements in doubt are wrong.
        new_plants: Those that the next step may confirm.
        bridged: Whether the controller acts on what is expected.
    """
    model = learning_state.model
    trusted = _trusted_sensors(step, expected_if_wrong, model)
    return Doubt(
        expected=expected_if_wrong.conditioned_on(learning_state.state, trusted, model),
        trusted=trusted,
        trusted_noise_ratios=doubt.trusted_noise_ratios,
        new_plants=new_plants,
        steps_in_doubt=doubt.steps_in_doubt + 1,
        bridged=bridged,
    )


def _resolve_outside_model(
    before: LearningState,
    doubt: Doubt,
    input: Array,
    measured: Array,
    observed: ObservedChange,
) -> LearningState:
    """Takes the measurement in doubt, where the model has no number, for wrong.

    So the one after it (n,) has to follow from the state before the doubt.
    """
    model = before.model
    unknown = np.full_like(before.observed_change, np.nan)
    learning_state = before.with_measurement(measured, unknown, before.noise_ratios)
    step = LearningStep(
        state=before.state,
        input=input,
        next_state=measured,
        point=observed.point,
        observed_change=unknown,
        latent_variance=observed.latent_variance,
        noise_variance=_noise_variance(doubt.trusted_noise_ratios, model),
    )
    expected = learning_state.expect(doubt.expected, step)
    innovation = learning_state.innovation(expected)
    if innovation.largest_square <= model.learning.surprise:
        return learning_state.without_doubt(doubt).later()
    acts_like_input = _acts_like_input(
        innovation=innovation,
        by_input=model.B_inverse @ expected.by_input,
        notable=_NOTABLE,
        deviations=_DEVIATIONS,
    )
    may_be_bridged = doubt.steps_in_doubt < _LONGEST_BRIDGE
    continued_doubt = _continued_doubt(
        learning_state,
        step,
        doubt,
        expected,
        bridged=may_be_bridged and not acts_like_input,
    )
    unexplained_steps = min(learning_state.unexplained_steps + 1, _PATIENCE)
    return replace(
        learning_state,
        doubt=continued_doubt,
        unexplained_steps=unexplained_steps,
        version=learning_state.version + learning_state.active,
    ).later()


def _confirmed(
    plant: NewPlant, step: LearningStep, density_to_beat: float
) -> NewPlant | None:
    """Returns a new plant that explains a further step; None where it does not.

    Args:
        plant: The new plant.
        step: The further step.
        density_to_beat: Log density that the new plant's has to exceed.
    """
    if step.repeats.all():
        return None
    model = plant.model
    if plant.expected is None:
        comparison = model.predict_then_learn(step)
        innovation = comparison.with_change
        model = comparison.model_with_step
    else:
        innovation = _innovation_of(plant, step, plant.after(step))
    explained = innovation.largest_square <= model.learning.surprise
    if not (explained and innovation.log_density > density_to_beat):
        return None
    return plant._replace(
        model=model,
        expected=None,
        confirmations_left=plant.confirmations_left - 1,
    )


def _innovation_of(
    plant: NewPlant, step: LearningStep, expected: Expectation
) -> Innovation:
    """Computes the innovation of a step that a new plant predicts."""
    model = plant.model
    error = state_difference(step.next_state, expected.mean, model.angles)
    return Innovation(
        error=model.B_inverse @ error,
        variance=model.explainable_variance(expected.covariance),
    )


def _switch_plant(
    learning_state: LearningState, new_plant: ChangedModel
) -> LearningState:
    """Forgets what was seen, and uses the change of another plant."""
    switched = replace(
        learning_state,
        model=new_plant,
        leads=learning_state.leads[:0],
        active=True,
        version=learning_state.version + 1,
        doubt=None,
    )
    return switched.later()
