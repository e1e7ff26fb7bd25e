"""The checks of innovations, and of the sensors that they come from.

See ``_flight_checks``.
"""

import math

from scipy.stats import chi2

from gpmpc._compiled import njit_noalloc
from gpmpc.mpc._flight_memory import (
    BIAS,
    BIAS_WINDOW,
    CHANGES,
    FEWEST_CHANGES,
    FROZEN,
    INNOVATION,
    STILL,
    WELL,
    WINDOW,
    Alarm,
    rounding_of,
    wrapped,
)

_DOUBT = 10.0  # differences: the median of as many is doubled, of more less so
_RARE = 1e-6  # probability of a window's innovations below which they are no chance
_LARGEST_RATIO = float(chi2.isf(_RARE, WINDOW)) / WINDOW  # of their mean square
_LARGEST_BIAS = 3.0  # deviations of the model, which one error may keep for long
_CAP = 12.0  # most that one innovation counts for: no outlier decides alone
_LARGEST_SIGNED = 6.0  # most that one counts for, with its sign
_MISSED_MOTION = 0.05  # share of what moves in a step that a good model may miss
_FORGETTING = 0.8  # share of the largest motion's square that counts one step later
_UNSOLVED = 1e-7  # of a state's way, which a plan solved to a tolerance may miss
_LAST_DIGITS = 1e-12  # of a number, which the arithmetic of a plan may lose
_MEDIAN = 0.455  # of a chi-square of one degree
_SUDDEN = 0.1  # deviations of its noise: a sensor that comes to rest moves less
_SHARE = 0.1  # of the last step in the share of turns: ten are remembered
_WHITE = 0.4  # share of turns above which innovations scatter: of noise it is 2/3


@njit_noalloc
def follow_innovations(memory):
    """The states whose innovations are no chance: by a window's squares, and by bias.

    The first alarm is that of the largest mean square in a window, the second that of
    innovations which do not cancel each other in a longer one (Bar-Shalom, Li and
    Kirubarajan, 2001, section 5.4).
    """
    flight = memory.flight[0]
    largest = WELL
    most_biased = WELL
    largest_sum = _LARGEST_RATIO * WINDOW
    largest_bias = _LARGEST_BIAS * BIAS_WINDOW
    has_change = False
    for i in range(len(memory.states)):
        state = memory.states[i]
        innovation = wrapped(state.measured - state.predicted, state.is_angle)
        ratio, deviation = _follow_innovation(state, innovation)
        slot = flight.step % WINDOW
        state.ratio += ratio - state.ratios[slot]
        state.ratios[slot] = ratio
        slot = flight.step % BIAS_WINDOW
        state.bias += deviation - state.deviations[slot]
        state.deviations[slot] = deviation
        if state.ratio > largest_sum:
            largest_sum = state.ratio
            largest = Alarm(INNOVATION, i, math.sqrt(largest_sum / WINDOW))
        if abs(state.bias) > largest_bias:
            largest_bias = abs(state.bias)
            most_biased = Alarm(BIAS, i, largest_bias / BIAS_WINDOW)
        if _remember_change(state, innovation):
            has_change = True
    flight.steps_with_change += has_change
    return largest, most_biased


@njit_noalloc
def _follow_innovation(state, innovation):
    """A state's squared innovation over its variance, and itself over its deviation.

    The variance is the predicted one, the noise that the model has learned, that of
    the sensors and a share of what moves. Of an error of the model each step may have
    all; of the sensors' noise the mean of a window has little. A state whose sensors'
    noise is not known yet is not judged, such as one that is never measured in two
    steps on end.
    """
    is_judged = state.change_count >= FEWEST_CHANGES
    if is_judged:
        state.sensor_variance = _sensor_variance(state)
    if innovation != innovation:
        return 0.0, 0.0
    motion = state.predicted - state.plan_start
    motion = max(motion * motion, _FORGETTING * state.motion)
    state.motion = motion
    if not is_judged:
        return 0.0, 0.0
    size = _unsolved_part(state)
    variance = size * size + state.predicted_variance + state.model_noise
    variance += _MISSED_MOTION * _MISSED_MOTION * motion
    if variance != variance:  # the plan does not say how uncertain it is
        return 0.0, 0.0
    ratio = innovation * innovation / (variance + state.sensor_variance)
    ratio = min(ratio, _CAP)
    deviation = innovation / math.sqrt(variance + state.sensor_variance / BIAS_WINDOW)
    deviation = min(max(deviation, -_LARGEST_SIGNED), _LARGEST_SIGNED)
    return ratio, deviation


@njit_noalloc
def _unsolved_part(state):
    """By how much a plan may miss a state since it was solved to a tolerance.

    It does not depend on where the zero of the state is, but for rounding.
    """
    way = wrapped(state.measured - state.lately, state.is_angle)
    part = _UNSOLVED
    if abs(way) > 1.0:
        part = _UNSOLVED * abs(way)
    return part + _LAST_DIGITS * abs(state.measured)


@njit_noalloc
def _sensor_variance(state):
    """The variance of a state's sensor, by the median of its changes.

    Half the squared difference of white innovations is their variance; the median of
    few differences is uncertain.
    """
    count = min(state.change_count, CHANGES)
    scale = (1.0 + _DOUBT / max(count, 1)) / _MEDIAN / 2.0
    return scale * state.ordered_changes[count // 2]


@njit_noalloc
def _remember_change(state, innovation):
    """Remembers how an innovation differs from the last; returns whether it is known.

    It is not where one of the two was not measured.
    """
    change = innovation - state.innovation
    state.innovation = innovation
    is_known = change == change
    if is_known:
        _insert_change(state, change * change)
        if state.measured != state.last_measured:
            turns = change * state.last_change < 0.0
            state.turns += _SHARE * (turns - state.turns)
        state.last_change = change
    return is_known


@njit_noalloc
def _insert_change(state, value):
    """Puts a value into the ring of a state's changes, and in its place in order."""
    slot = state.change_count % CHANGES
    ordered = state.ordered_changes
    if state.change_count < CHANGES:
        j = state.change_count
    else:
        j = _find(ordered, state.squared_changes[slot])
        while j < CHANGES - 1 and ordered[j + 1] < value:
            ordered[j] = ordered[j + 1]
            j += 1
    while j > 0 and ordered[j - 1] > value:
        ordered[j] = ordered[j - 1]
        j -= 1
    ordered[j] = value
    state.squared_changes[slot] = value
    state.change_count += 1


@njit_noalloc
def _find(ordered, value):
    """The first index of ordered values at which one is no less than a value."""
    low = 0
    high = len(ordered) - 1
    while low < high:
        middle = (low + high) // 2
        if ordered[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@njit_noalloc
def follow_sensors(memory):
    """A state that is measured the same to the last digit while others change, or all.

    A sensor that has shown the same before, and then gone on, has coarse steps: it may.
    So may one without noise, whose state was to stay where it is.
    """
    moving_sensors = 0
    for i in range(len(memory.states)):
        state = memory.states[i]
        if state.measured != state.measured:
            continue
        if state.measured == state.last_measured:
            state.repeats += 1.0
            state.missed_moves += _was_to_change(state)
        else:
            if state.repeats > 0.0:
                state.is_coarse = 1.0
            state.repeats = 0.0
            state.missed_moves = 0.0
            move = state.measured - state.last_measured
            state.last_move = wrapped(move, state.is_angle)
            moving_sensors += 1
        state.last_measured = state.measured
    if memory.flight[0].steps_with_change < FEWEST_CHANGES:
        return WELL
    for i in range(len(memory.states)):
        state = memory.states[i]
        if state.is_coarse == 1.0:
            continue
        if moving_sensors > 0 and state.missed_moves >= WINDOW // 2:
            return Alarm(FROZEN, i, state.repeats)
        if moving_sensors == 0 and state.repeats >= WINDOW and _stopped_at_once(state):
            return Alarm(STILL, i, state.repeats)
    return WELL


@njit_noalloc
def _was_to_change(state):
    """Whether a sensor was to show another number, by its noise or by the last plan.

    A plan that predicts nothing does not say that the state was to stay.
    """
    move = wrapped(state.predicted - state.measured, state.is_angle)
    size = rounding_of(state.measured)
    variance = state.predicted_variance + state.model_noise
    return _is_noisy(state) or not move * move <= variance + size * size


@njit_noalloc
def _stopped_at_once(state):
    """Whether a sensor showed noise until it showed the same.

    A plant without noise comes to rest by ever smaller moves, or at a hard stop: all
    sensors then show the same, which is no fault. What its model misses changes the
    innovations, too, but not to and fro as noise does.
    """
    is_sudden = abs(state.last_move) > _SUDDEN * math.sqrt(state.sensor_variance)
    return _is_noisy(state) and state.turns > _WHITE and is_sudden


@njit_noalloc
def _is_noisy(state):
    """Whether a sensor's noise is more than rounding."""
    size = rounding_of(state.measured)
    return state.sensor_variance > size * size
