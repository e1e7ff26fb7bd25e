"""The checks of a flight's step, compiled.

``judge_step`` takes a step into the memory of its flight and leaves the first alarm
there. Functions ``_follow_*`` and ``_remember_*`` write the memory, each of them once a
step, and ``judge_step`` itself counts the steps; ``_check_*`` only read. The tuple
``alarms`` is the list of alarms, in the order in which they are named to the user. What
they are for is told in ``_judgement``.

A measurement that is missing is NaN. It is no innovation, it tells nothing of its
sensor, and the plant counts as where the last plan predicted it. Numbers beyond
``UNMEASURED`` count as missing, in measurements and in plans: their squares may be
none, and one of them would stay in the sums of windows.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from gpmpc._arrays import UNMEASURED
from gpmpc._compiled import compiled, njit_noalloc
from gpmpc.mpc._controller import KEPT

Array = np.ndarray

WINDOW = 8  # steps over which innovations, novelty and failures are looked at
BIAS_WINDOW = 16  # steps over which innovations are to cancel each other
_CHANGES = 40  # differences of innovations that say how large the sensors' noise is
_FEWEST = 4  # of them, before any innovation is judged
_DOUBT = 10.0  # differences: the median of as many is doubled, of more less so
_GROWTH = (6, 20)  # least and most steps in each half of a window of growth
_LONG = 20  # steps that a promise is followed for at most
_RING = 2 * _GROWTH[1] + 1  # steps that distances and costs are remembered for
_RARE = 1e-6  # probability of a window's innovations below which they are no chance
_LARGEST_RATIO = float(chi2.isf(_RARE, WINDOW)) / WINDOW  # of their mean square
_LARGEST_BIAS = 3.0  # deviations of the model, which one error may keep for long
_CAP = 12.0  # most that one innovation counts for: no outlier decides alone
_LARGEST_SIGNED = 6.0  # most that one counts for, with its sign
_MISSED_MOTION = 0.05  # share of what moves in a step that a good model may miss
_FORGETTING = 0.8  # share of the largest motion's square that counts one step later
_BROKEN = 4.0  # how many times a promise may be paid
_MATERIAL = 0.02  # share of the way travelled below which no distance matters
_FEW = 3  # steps of a window: failures, or plans far from the data
_FAR = 0.9  # novelty from which on a model says little more than before any data
_CLIMBED = 0.1  # of its first cost, from which on plans that cost ever more count
_RISEN = 2.0  # of its first cost, from which on they are lost
_ROUNDING = 1e-9
_UNSOLVED = 1e-7  # of a state's size, which a plan solved to a tolerance may miss
_MEDIAN = 0.455  # of a chi-square of one degree

# Why a step is not healthy.
MISFIT = -1  # its arrays do not fit each other, and it was not judged
HEALTHY = 0
INNOVATION = 1
PROMISE = 2
NOVELTY = 3
VIOLATION = 4
FAILURES = 5
SATURATED = 6
FROZEN = 7
BIAS = 8
AWAY = 9
RISING = 10
CLIMBING = 11
STANDING = 12

# What a flight has shown so far of each state. Rings are filled in turns: step k writes
# slot k modulo the length, but for those of changes, whose count stands beside them.
STATE_MEMORY = np.dtype(
    [
        ("innovation", np.float64),  # the last one; NaN where there was none
        ("ratios", np.float64, WINDOW),  # squared innovations over their variances
        ("ratio", np.float64),  # their sum
        ("deviations", np.float64, BIAS_WINDOW),  # innovations over their deviations
        ("bias", np.float64),  # their sum
        ("change_count", np.int64),  # differences of successive innovations so far
        ("squared_changes", np.float64, _CHANGES),  # their squares
        ("ordered_changes", np.float64, _CHANGES),  # the same, from the smallest on
        ("sensor_variance", np.float64),  # the sensors' part of the innovations
        ("motion", np.float64),  # largest squared predicted motion, forgotten slowly
        ("measured", np.float64),  # now; NaN where it is not
        ("last_measured", np.float64),  # before, at any step
        # by the last plan, which began one step ago; NaN without one
        ("plan_start", np.float64),  # where it began
        ("predicted", np.float64),  # where it led by now
        ("predicted_variance", np.float64),
        ("repeats", np.float64),  # for how many steps the sensor has shown the same
        ("missed_moves", np.float64),  # those of them in which it was to change
        ("is_coarse", np.float64),  # 1 where it has gone on after showing the same
        ("start", np.float64),  # the first measurement
        ("horizon_end", np.float64),  # the end of the last reference
        ("next_reference", np.float64),  # its value for this step
    ]
)
# What it has shown of all states together. Of the rings of ``_RING`` slots, two turn
# after that many steps; the other three only use the first ``promise_window`` slots,
# and turn after as many steps.
FLIGHT_MEMORY = np.dtype(
    [
        ("step", np.int64),  # number of the step, from 0
        ("steps_with_change", np.int64),  # steps so far in which any state had a change
        ("horizon", np.int64),  # of the last plan that was applied; 0 at first
        # steps that a promise is followed for; 0 at first
        ("promise_window", np.int64),
        ("since_news", np.int64),  # steps since the reference's end has moved
        # steps since the plant came nearer to it, or was there
        ("since_nearer", np.int64),
        ("violated", np.int64),  # steps for which plans have missed a constraint
        ("lost", np.int64),  # why it is lost, or ``HEALTHY``
        # the first alarm of the last step, as in ``Alarm``
        ("reason", np.int64),
        ("entry", np.int64),
        ("value", np.float64),
        ("longest_way", np.float64),  # from the start to the reference's end
        ("distance_when_lost", np.float64),
        ("cost_ratio_when_lost", np.float64),  # of the last plan since then
        ("first_violation", np.float64),
        ("first_cost", np.float64),  # largest of the first plans to a new reference
        ("awaits_cost", np.int64),  # 1 until there is a plan to the last news
        ("nearest", np.float64),  # distance on the way there; infinite at rest
        ("distances", np.float64, _RING),
        ("costs", np.float64, _RING),  # of plans
        # modulo promise_window: squared moves of the reference's end, which no plan
        # before has known
        ("allowances", np.float64, _RING),
        ("paid", np.float64, _RING),  # modulo promise_window: squared distances
        # modulo promise_window: by the plan of a step, for as many steps after it; NaN
        # where there was none
        ("promises", np.float64, _RING),
        ("far", np.float64, WINDOW),  # 1 where a plan was far from the data
        ("failed", np.float64, WINDOW),  # 1 where a decision was not applied
    ]
)


class Settings(NamedTuple):
    """What stays the same through a flight; n states and m inputs."""

    weights: Array  # of the states (n, n)
    terminal: Array  # of the last predicted one (n, n)
    model_noise: Array  # variances of a next state that plans leave out (n,)
    angles: Array  # 1 where a state is an angle (n,)
    lower: Array  # bounds of the inputs (m,)
    upper: Array  # (m,)


class Memory(NamedTuple):
    """What a flight has shown so far."""

    states: Array  # (n,) of ``STATE_MEMORY``
    flight: Array  # (1,) of ``FLIGHT_MEMORY``
    # for how many steps each input has stayed at a bound away from the reference (m,)
    at_bound: Array
    distance_at_bound: Array  # when each input came to its bound (m,)


class Reading(NamedTuple):
    """What is known of one step."""

    measured: Array  # (n,)
    reference: Array  # from this step on, to its end or as far as known (H + 1, n)
    means: Array  # of the plan (H + 1, n); two rows of NaN without one
    covariances: Array  # likewise (H + 1, n, n)
    input: Array  # applied until the next step, whoever chose it (m,); NaN if unknown
    is_applied: bool  # whether the plan is
    novelty: float  # of the plan; NaN if unknown
    violation: float  # likewise


class Alarm(NamedTuple):
    """What a check says of a step."""

    reason: int  # ``HEALTHY`` where it is
    entry: int  # the state or input that it is about
    value: float  # that the words name


_WELL = Alarm(HEALTHY, entry=0, value=0.0)


class _Distance(NamedTuple):
    """How far the plant is from its reference, in the cost's metric."""

    now: float
    negligible_below: float  # a distance that does not matter


class _Course(NamedTuple):
    """Where distances and costs have gone, for several checks."""

    distance: float  # from the reference, in the cost's metric
    matters: bool  # whether the distance does
    promise_ratio: float  # what steps cost over what was promised; 0 if not known
    cost_ratio: float  # plan's cost over the first one; 0 while the reference is news
    distance_grows: bool  # faster and faster
    cost_climbs: bool  # faster and faster, while the distance has grown


def new_flight_memory() -> Array:
    """Returns the memory (1,) of all states together at the start of a flight."""
    flight = np.zeros(1, FLIGHT_MEMORY)
    flight["promises"] = np.nan
    return flight


def new_state_memory(count: int) -> Array:
    """Returns the memory of states (count,) at the start of a flight."""
    states = np.zeros(count, STATE_MEMORY)
    states["ordered_changes"] = np.inf
    unknown = (
        "innovation",
        "last_measured",
        "plan_start",
        "predicted",
        "predicted_variance",
        "start",
        "horizon_end",
        "next_reference",
    )
    for field in unknown:
        states[field] = np.nan
    return states


@compiled(locked=True, allocates=False)
def judge_step(
    settings,
    memory,
    measured,
    reference,
    means,
    covariances,
    input,
    is_applied,
    novelty,
    violation,
):
    """Takes a step into the memory; returns the reason of its first alarm.

    The last eight arguments are those of a ``Reading``, which Python would take half as
    long to make as this to judge.
    """
    reading = Reading(
        measured,
        reference,
        means,
        covariances,
        input,
        is_applied,
        novelty,
        violation,
    )
    if not _fit_each_other(memory, reading):
        return MISFIT
    flight = memory.flight[0]
    _remember_measurement(memory, measured)
    planned_squares, promise = _plan_distances(settings, reading)
    if reading.is_applied:
        flight.horizon = len(means) - 1
    if flight.promise_window == 0:
        flight.promise_window = min(flight.horizon, _LONG)

    # The order counts: sensor variances come from the innovations, distances need these
    # variances, and a promise is followed after the news that may withdraw it.
    innovation, bias = _follow_innovations(settings, memory)
    frozen = _follow_sensors(settings, memory)
    distance = _follow_distance(settings, memory, reading.reference)
    _remember_reference(settings, memory, reading.reference)
    _remember_first_cost(flight, planned_squares)
    promise_ratio = _follow_promise(flight, distance, promise)
    course = _follow_course(flight, distance, planned_squares, promise_ratio)
    far_plans = _follow_novelty(flight, reading.novelty)
    predicts_well = (
        innovation.reason == HEALTHY and bias.reason == HEALTHY and far_plans == 0.0
    )
    lost = _follow_loss(flight, course, planned_squares, predicts_well)
    failures = _follow_failures(flight, reading.is_applied)
    violation = _follow_violation(flight, reading.violation)
    standing = _follow_approach(flight, distance)
    saturated = _follow_bounds(settings, memory, reading.input, distance)
    alarms = (  # in the order in which they are named
        lost,
        frozen,
        innovation,
        bias,
        _check_climbing(course, predicts_well),
        _check_promise(course),
        failures,
        _check_novelty(flight, course, far_plans, reading.novelty),
        violation,
        standing,
        saturated,
    )
    _remember_plan(memory, reading)
    flight.step += 1
    alarm = _first(alarms)
    flight.reason = alarm.reason
    flight.entry = alarm.entry
    flight.value = alarm.value
    return alarm.reason


@njit_noalloc
def _first(alarms):
    """The first alarm of several."""
    for alarm in alarms:
        if alarm.reason != HEALTHY:
            return alarm
    return _WELL


@njit_noalloc
def _fit_each_other(memory, reading):
    """Whether arrays have as many states, inputs and stages as others."""
    n = len(memory.states)
    stages = len(reading.means)
    return (
        len(reading.measured) == n
        and len(reading.reference) > 0
        and reading.reference.shape[1] == n
        and stages > 1  # the next state is one of them
        and reading.means.shape[1] == n
        and reading.covariances.shape == (stages, n, n)
        and len(reading.input) == len(memory.at_bound)
    )


@njit_noalloc
def _usual(value):
    """A number such as are measured and planned, or else NaN."""
    return value if abs(value) < UNMEASURED else np.nan


@njit_noalloc
def _remember_measurement(memory, measured):
    """Remembers what is measured now."""
    for i in range(len(measured)):
        memory.states[i].measured = _usual(measured[i])


@njit_noalloc
def _remember_plan(memory, reading):
    """Remembers where a plan begins, and what it predicts for the next step."""
    for i in range(len(memory.states)):
        state = memory.states[i]
        state.plan_start = np.nan
        state.predicted = np.nan
        state.predicted_variance = np.nan
        if reading.is_applied:
            state.plan_start = _usual(reading.means[0, i])
            state.predicted = _usual(reading.means[1, i])
            state.predicted_variance = reading.covariances[1, i, i]


@njit_noalloc
def _follow_innovations(settings, memory):
    """The states whose innovations are no chance: by a window's squares, and by bias.

    The first alarm is that of the largest mean square in a window, the second that of
    innovations which do not cancel each other in a longer one (Bar-Shalom, Li and
    Kirubarajan, 2001, section 5.4).
    """
    flight = memory.flight[0]
    largest = _WELL
    most_biased = _WELL
    largest_sum = _LARGEST_RATIO * WINDOW
    largest_bias = _LARGEST_BIAS * BIAS_WINDOW
    has_change = False
    for i in range(len(memory.states)):
        state = memory.states[i]
        innovation = _wrapped(state.measured - state.predicted, settings.angles[i])
        ratio, deviation = _follow_innovation(
            state, innovation, settings.model_noise[i]
        )
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
def _follow_innovation(state, innovation, model_noise):
    """A state's squared innovation over its variance, and itself over its deviation.

    The variance is the predicted one, the noise that the model has learned, that of
    the sensors and a share of what moves. Of an error of the model each step may have
    all; of the sensors' noise the mean of a window has little. A state whose sensors'
    noise is not known yet is not judged, such as one that is never measured in two
    steps on end.
    """
    is_judged = state.change_count >= _FEWEST
    if is_judged:
        state.sensor_variance = _sensor_variance(state)
    if innovation != innovation:
        return 0.0, 0.0
    motion = state.predicted - state.plan_start
    motion = max(motion * motion, _FORGETTING * state.motion)
    state.motion = motion
    if not is_judged:
        return 0.0, 0.0
    size = _UNSOLVED * max(1.0, abs(state.measured))
    variance = size * size + state.predicted_variance + model_noise
    variance += _MISSED_MOTION * _MISSED_MOTION * motion
    if variance != variance:  # the plan does not say how uncertain it is
        return 0.0, 0.0
    ratio = innovation * innovation / (variance + state.sensor_variance)
    ratio = min(ratio, _CAP)
    deviation = innovation / math.sqrt(variance + state.sensor_variance / BIAS_WINDOW)
    deviation = min(max(deviation, -_LARGEST_SIGNED), _LARGEST_SIGNED)
    return ratio, deviation


@njit_noalloc
def _sensor_variance(state):
    """The variance of a state's sensor, by the median of its changes.

    Half the squared difference of white innovations is their variance; the median of
    few differences is uncertain.
    """
    count = min(state.change_count, _CHANGES)
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
    return is_known


@njit_noalloc
def _insert_change(state, value):
    """Puts a value into the ring of a state's changes, and in its place in order."""
    slot = state.change_count % _CHANGES
    ordered = state.ordered_changes
    if state.change_count < _CHANGES:
        j = state.change_count
    else:
        j = _find(ordered, state.squared_changes[slot])
        while j < _CHANGES - 1 and ordered[j + 1] < value:
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
def _follow_sensors(settings, memory):
    """A state that is measured the same to the last digit while others change.

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
            state.missed_moves += _was_to_change(settings, state, i)
        else:
            if state.repeats > 0.0:
                state.is_coarse = 1.0
            state.repeats = 0.0
            state.missed_moves = 0.0
            moving_sensors += 1
        state.last_measured = state.measured
    if moving_sensors == 0 or memory.flight[0].steps_with_change < _FEWEST:
        return _WELL
    for i in range(len(memory.states)):
        state = memory.states[i]
        if state.missed_moves >= WINDOW // 2 and state.is_coarse == 0.0:
            return Alarm(FROZEN, i, state.repeats)
    return _WELL


@njit_noalloc
def _was_to_change(settings, state, i):
    """Whether a sensor was to show another number, by its noise or by the last plan.

    A plan that predicts nothing does not say that the state was to stay.
    """
    move = _wrapped(state.predicted - state.measured, settings.angles[i])
    size = _ROUNDING * max(1.0, abs(state.measured))
    variance = state.predicted_variance + settings.model_noise[i]
    is_noisy = state.sensor_variance > size * size
    return is_noisy or not move * move <= variance + size * size


@njit_noalloc
def _follow_distance(settings, memory, reference):
    """The distance from the reference in the cost's metric, and the least that matters.

    No distance matters that is small beside the way from the start to the reference, or
    beside noise. Where nothing is known of a state the distance stays as it was; it is
    infinite before any is known.
    """
    flight = memory.flight[0]
    n = len(memory.states)
    for i in range(n):
        state = memory.states[i]
        if state.start != state.start:
            state.start = state.measured
    now = reference[0]
    end = reference[-1]
    square = 0.0
    way_square = 0.0
    noise = 0.0
    for i in range(n):
        state = memory.states[i]
        present = _present(state)
        off = _wrapped(present - now[i], settings.angles[i])
        way = _wrapped(end[i] - state.start, settings.angles[i])
        for j in range(n):
            weight = settings.weights[i, j]
            if weight != 0.0:
                off_j = _wrapped(
                    _present(memory.states[j]) - now[j], settings.angles[j]
                )
                square += weight * off * off_j
                way_j = _wrapped(end[j] - memory.states[j].start, settings.angles[j])
                way_square += weight * way * way_j
        variance = settings.model_noise[i] + state.sensor_variance
        if state.predicted_variance == state.predicted_variance:
            variance += state.predicted_variance
        size = _ROUNDING * max(1.0, abs(present))
        noise += settings.weights[i, i] * (variance + size * size)
    if way_square == way_square:
        way_length = math.sqrt(max(0.0, way_square))
        flight.longest_way = max(flight.longest_way, way_length)
    least = max(_MATERIAL * flight.longest_way, 4.0 * math.sqrt(noise))
    if square == square:
        return _Distance(math.sqrt(max(0.0, square)), least)
    if flight.step == 0:
        return _Distance(np.inf, least)
    return _Distance(flight.distances[(flight.step - 1) % _RING], least)


@njit_noalloc
def _present(state):
    """Where a state is: as it was measured, or else as the last plan predicted it."""
    is_measured = state.measured == state.measured
    return state.measured if is_measured else state.predicted


@njit_noalloc
def _remember_reference(settings, memory, reference):
    """Remembers what a reference tells that no plan has known before."""
    flight = memory.flight[0]
    move = _move_of_end(settings, memory, reference[-1])
    if move > 0.0 or flight.step == 0:
        flight.since_news = 0
    else:
        flight.since_news += 1
    flight.allowances[flight.step % max(flight.promise_window, 1)] = move
    now = reference[0]
    following = reference[min(1, len(reference) - 1)]
    is_as_announced = True
    for i in range(len(now)):
        state = memory.states[i]
        off = _wrapped(now[i] - state.next_reference, settings.angles[i])
        if abs(off) > _ROUNDING * max(1.0, abs(now[i])):
            is_as_announced = False
        state.next_reference = following[i]
        state.horizon_end = reference[-1, i]
    if not is_as_announced:  # no plan has promised anything of this
        for j in range(_RING):
            flight.promises[j] = np.nan


@njit_noalloc
def _move_of_end(settings, memory, end):
    """The squared move of a reference's end in the cost's metric; 0 for rounding."""
    square = 0.0
    size = 0.0
    for i in range(len(end)):
        move = _wrapped(end[i] - memory.states[i].horizon_end, settings.angles[i])
        size += settings.weights[i, i] * end[i] * end[i]
        for j in range(len(end)):
            if settings.weights[i, j] != 0.0:
                move_j = end[j] - memory.states[j].horizon_end
                move_j = _wrapped(move_j, settings.angles[j])
                square += settings.weights[i, j] * move * move_j
    return square if square > 1e-12 * max(1.0, size) else 0.0


@njit_noalloc
def _remember_first_cost(flight, planned_squares):
    """Remembers the largest cost of the first plans that knew of a new reference.

    It is what the cost is to fall from.
    """
    if flight.since_news == 0:
        flight.awaits_cost = 1
    if flight.awaits_cost == 1 and planned_squares == planned_squares:
        flight.first_cost = max(flight.first_cost, planned_squares)
        flight.awaits_cost = 0


@njit_noalloc
def _plan_distances(settings, reading):
    """Squared distances of a plan from its references: of all stages, and of the first.

    The first stages are as many as a promise is followed for. In contrast to the stage
    costs of a decision these are distances alone, which any controller's plan has and a
    measurement can be compared with. They are NaN where no plan is applied.
    """
    if not reading.is_applied:
        return np.nan, np.nan
    means = reading.means
    references = reading.reference
    H = len(means) - 1
    n = means.shape[1]
    total = 0.0
    first = 0.0
    for k in range(H):
        weights = settings.terminal if k == H - 1 else settings.weights
        target = references[min(k + 1, len(references) - 1)]
        for i in range(n):
            mean = _usual(means[k + 1, i])
            off = _wrapped(mean - target[i], settings.angles[i])
            for j in range(n):
                if weights[i, j] != 0.0:
                    mean_j = _usual(means[k + 1, j])
                    off_j = _wrapped(mean_j - target[j], settings.angles[j])
                    total += weights[i, j] * off * off_j
        if k == _LONG - 1:
            first = total
    return total, total if H <= _LONG else first


@njit_noalloc
def _follow_promise(flight, distance, promise):
    """What steps cost over what a plan promised for them; 0 where it is not known.

    In optimal control the cost falls by what is paid (Gruene and Rantzer, 2008,
    section 3). At step 30, with a window of 20, slot 10 holds the promise of step 10
    for the steps 11 .. 30, and gets that of step 30.
    """
    k = flight.step
    h = flight.promise_window
    if h == 0:
        return 0.0
    slot = k % h
    nearer = distance.now
    if k > 0:  # one wrong measurement costs nothing
        nearer = min(nearer, flight.distances[(k - 1) % _RING])
    flight.paid[slot] = nearer * nearer
    # The slot still holds what step k - h promised. Noise was not promised, nor what
    # prepares for a reference that is known later.
    negligible_square = distance.negligible_below * distance.negligible_below
    allowed_cost = flight.promises[slot] + 0.25 * h * negligible_square
    is_comparable = min(flight.horizon, _LONG) == h
    flight.promises[slot] = promise if is_comparable else np.nan
    if k < h or flight.steps_with_change <= _FEWEST:  # the noise is not known yet
        return 0.0
    paid = 0.0
    for j in range(h):
        paid += flight.paid[j]
        allowed_cost += flight.allowances[j]
    ratio = paid / (allowed_cost + 1e-300)
    return ratio if ratio == ratio else 0.0


@njit_noalloc
def _follow_course(flight, distance, planned_squares, promise_ratio):
    """Remembers distance and cost; returns where they have gone."""
    k = flight.step
    flight.distances[k % _RING] = distance.now
    flight.costs[k % _RING] = planned_squares
    half = min(max(flight.promise_window // 2, _GROWTH[0]), _GROWTH[1])
    was_away = flight.distances[(k - half) % _RING] > distance.negligible_below
    was_nearer = flight.distances[(k - 2 * half) % _RING] < distance.now
    cost_ratio = 0.0
    if flight.since_news > _LONG and flight.first_cost > 0.0:
        cost_ratio = planned_squares / flight.first_cost
    return _Course(
        distance=distance.now,
        matters=distance.now > distance.negligible_below,
        promise_ratio=promise_ratio,
        cost_ratio=cost_ratio,
        distance_grows=was_away and _is_growing(flight.distances, k, half),
        cost_climbs=was_away and was_nearer and _is_growing(flight.costs, k, half),
    )


@njit_noalloc
def _is_growing(ring, k, half):
    """Whether value k is the largest of a window, and its growth has not slowed down.

    The second half of the window is compared with the first.
    """
    size = len(ring)
    last = ring[k % size]
    middle = ring[(k - half) % size]
    first = ring[(k - 2 * half) % size]
    if k < 2 * half or not last > middle > first:
        return False
    for j in range(2 * half):
        if ring[(k - j) % size] > last:
            return False
    return last - middle >= 0.8 * (middle - first) and last > 1.2 * middle


@njit_noalloc
def _follow_loss(flight, course, planned_squares, predicts_well):
    """A plant that runs away, by its distance or by what its plans cost.

    It stays lost until it has come back by half.
    """
    if flight.lost != HEALTHY and course.distance < 0.5 * flight.distance_when_lost:
        flight.lost = HEALTHY
    if flight.lost == HEALTHY and course.matters:
        is_far = course.distance > flight.longest_way
        is_broken = course.promise_ratio > _BROKEN
        if course.distance_grows and is_broken and is_far:
            flight.lost = AWAY
        elif course.cost_climbs and predicts_well and course.cost_ratio > _RISEN:
            flight.lost = RISING
        flight.distance_when_lost = course.distance
    if flight.lost == AWAY:
        return Alarm(AWAY, 0, course.distance)
    if flight.lost == RISING:
        if planned_squares == planned_squares:
            flight.cost_ratio_when_lost = planned_squares / flight.first_cost
        return Alarm(RISING, 0, flight.cost_ratio_when_lost)
    return _WELL


@njit_noalloc
def _check_climbing(course, predicts_well):
    """Plans that cost ever more although the model predicts well."""
    climbs = course.cost_climbs and predicts_well and course.cost_ratio > _CLIMBED
    if climbs and course.matters:
        return Alarm(CLIMBING, 0, course.cost_ratio)
    return _WELL


@njit_noalloc
def _check_promise(course):
    """Steps that cost several times what was promised."""
    if course.matters and course.promise_ratio > _BROKEN:
        return Alarm(PROMISE, 0, course.promise_ratio)
    return _WELL


@njit_noalloc
def _follow_failures(flight, is_applied):
    """Decisions of a window that could not be applied."""
    flight.failed[flight.step % WINDOW] = 0.0 if is_applied else 1.0
    failures = _total(flight.failed)
    if failures >= _FEW:
        return Alarm(FAILURES, 0, failures)
    return _WELL


@njit_noalloc
def _follow_novelty(flight, novelty):
    """How many plans of a window were far from the model's data."""
    flight.far[flight.step % WINDOW] = 1.0 if novelty > _FAR else 0.0
    return _total(flight.far)


@njit_noalloc
def _check_novelty(flight, course, far_plans, novelty):
    """Plans far from the data, on a way that is long or not as promised."""
    is_on_its_way = course.distance > 0.5 * flight.longest_way
    is_doubtful = course.promise_ratio > 0.5 * _BROKEN
    if far_plans >= _FEW and course.matters and (is_on_its_way or is_doubtful):
        return Alarm(NOVELTY, 0, novelty)
    return _WELL


@njit_noalloc
def _follow_violation(flight, violation):
    """Plans that have missed a constraint for long, the last no less than the first.

    A step without a plan, or whose violation is unknown, does not count.
    """
    if violation != violation:
        return _WELL
    if violation <= KEPT:
        flight.violated = 0
        return _WELL
    if flight.violated == 0:
        flight.first_violation = violation
    flight.violated += 1
    is_long = flight.violated > 2 * WINDOW
    if is_long and violation >= 0.9 * flight.first_violation:
        return Alarm(VIOLATION, 0, violation)
    return _WELL


@njit_noalloc
def _follow_approach(flight, distance):
    """No way made for long, while half of it is still ahead.

    Steps at rest are no steps on the way: what is pushed away then begins a new one.
    """
    if distance.now <= distance.negligible_below:
        flight.nearest = np.inf
        flight.since_nearer = 0
        return _WELL
    if distance.now < 0.9 * flight.nearest or flight.since_news == 0:
        flight.nearest = distance.now
        flight.since_nearer = 0
        return _WELL
    flight.since_nearer += 1
    is_far = distance.now > 0.5 * flight.longest_way
    if is_far and flight.since_nearer > 3 * max(_LONG, flight.horizon):
        return Alarm(STANDING, 0, float(flight.since_nearer))
    return _WELL


@njit_noalloc
def _follow_bounds(settings, memory, input, distance):
    """An input that has stayed at a bound for long while the distance did not fall.

    At rest an input may be at a bound, such as a brake; one that is not known does not
    count.
    """
    alarm = _WELL
    long = 2 * max(_LONG, memory.flight[0].horizon)
    for j in range(len(settings.lower)):
        if distance.now <= distance.negligible_below:
            memory.at_bound[j] = 0
            continue
        if input[j] != input[j]:
            continue
        size = _ROUNDING * max(1.0, abs(input[j]))
        if settings.upper[j] - settings.lower[j] <= size:  # it is locked
            continue
        is_low = input[j] <= settings.lower[j] + size
        if is_low or input[j] >= settings.upper[j] - size:
            # It is infinite until a distance is known.
            if memory.at_bound[j] == 0 or memory.distance_at_bound[j] == np.inf:
                memory.distance_at_bound[j] = distance.now
            memory.at_bound[j] += 1
        else:
            memory.at_bound[j] = 0
        is_nearer = distance.now < 0.95 * memory.distance_at_bound[j]
        if memory.at_bound[j] > long and not is_nearer:
            alarm = Alarm(SATURATED, j, float(memory.at_bound[j]))
    return alarm


@njit_noalloc
def _total(values):
    total = 0.0
    for value in values:
        total += value
    return total


@njit_noalloc
def _wrapped(value, is_angle):
    """A difference, of angles within half a turn."""
    if is_angle == 0.0:
        return value
    return value - 2.0 * math.pi * np.round(value / (2.0 * math.pi))
