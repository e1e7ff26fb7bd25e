"""The checks of where a flight goes: its distance, what it pays, and what plans cost.

See ``_flight_checks``. Lengths are those of the cost's metric: the square of a distance
is what a stage of it costs.
"""

import math
from typing import NamedTuple

import numpy as np

from gpmpc._compiled import njit_noalloc
from gpmpc.mpc._flight_memory import (
    AWAY,
    CLIMBING,
    ESCAPING,
    FEWEST_CHANGES,
    GROWTH,
    HEALTHY,
    LONG,
    PROMISE,
    RING,
    RISING,
    SATURATED,
    STANDING,
    WELL,
    WINDOW,
    Alarm,
    rounding_of,
    usual,
    wrapped,
)

_BROKEN = 4.0  # how many times a promise may be paid
_MATERIAL = 0.02  # share of the way travelled below which no distance matters
_NEWS = 0.05  # share of the distance that a reference has to move for a new way
_LATELY = 0.02  # share of the way to the reference that its recent place makes a step
_CLIMBED = 0.1  # of its first cost, from which on plans that cost ever more count
_RISEN = 2.0  # of its first cost, from which on they are lost


class Distance(NamedTuple):
    """How far the plant is from its reference."""

    now: float
    negligible_below: float  # a distance that does not matter


class _Move(NamedTuple):
    """What a reference tells that no plan before has known."""

    unannounced: float  # how far it is from what was announced for this step
    of_end: float  # how far its end has moved
    end_cost: float  # what its end's move costs by the weights of the end


class Course(NamedTuple):
    """Where distances and costs have gone, for several checks."""

    distance: float
    matters: bool  # whether the distance does
    is_far: bool  # farther than any way travelled
    promise_ratio: float  # what steps cost over what was promised; 0 if not known
    cost_ratio: float  # plan's cost over the first one; 0 while the reference is news
    distance_grows: bool  # faster and faster
    cost_climbs: bool  # faster and faster, while the distance has grown


@njit_noalloc
def follow_distance(memory, reference):
    """The distance from the reference, and the least that matters.

    No distance matters that is small beside the way that was travelled lately, or
    beside noise. Where nothing is known of a state the distance stays as it was; it is
    infinite before any is known.
    """
    flight = memory.flight[0]
    states = memory.states
    _follow_way(memory, reference)
    for i in range(len(states)):
        state = states[i]
        off = _present(state) - reference[0, i]
        state.component = wrapped(off, state.is_angle)
    square = _squared_length(memory)
    noise = _squared_noise(memory)
    negligible = max(_MATERIAL * flight.longest_way, 4.0 * math.sqrt(noise))
    if square == square:
        return Distance(math.sqrt(max(0.0, square)), negligible)
    if flight.step == 0:
        return Distance(np.inf, negligible)
    return Distance(flight.distances[(flight.step - 1) % RING], negligible)


@njit_noalloc
def _follow_way(memory, reference):
    """Follows the longest way: from where the reference has been lately to its end.

    At first that is where the flight begins. Of a set point it is the way there; of a
    path, what it makes within some fifty steps, however long it is altogether.
    """
    flight = memory.flight[0]
    for i in range(len(memory.states)):
        state = memory.states[i]
        if state.lately != state.lately:
            state.lately = state.measured
        way = wrapped(reference[-1, i] - state.lately, state.is_angle)
        state.component = way
        step = wrapped(reference[0, i] - state.lately, state.is_angle)
        if step == step:
            state.lately += _LATELY * step
    square = _squared_length(memory)
    if square == square:
        flight.longest_way = max(flight.longest_way, math.sqrt(max(0.0, square)))


@njit_noalloc
def _squared_noise(memory):
    """The part of the squared distance that noise and uncertainty make.

    Of a plan far from the data that is noise alone: ignorance excuses no distance.
    """
    flight = memory.flight[0]
    last_plan_was_far = flight.far[(flight.step - 1) % WINDOW] > 0.0
    noise = 0.0
    for e in range(len(memory.weights)):
        weight = memory.weights[e]
        if weight.row == weight.column:
            state = memory.states[weight.row]
            variance = state.model_noise + state.sensor_variance
            is_predicted = state.predicted_variance == state.predicted_variance
            if is_predicted and not last_plan_was_far:
                variance += state.predicted_variance
            size = rounding_of(_present(state))
            noise += weight.of_stage * (variance + size * size)
    return noise


@njit_noalloc
def _present(state):
    """Where a state is: as it was measured, or else as the last plan predicted it."""
    is_measured = state.measured == state.measured
    return state.measured if is_measured else state.predicted


@njit_noalloc
def _squared_length(memory):
    """The squared length of the states' components."""
    square = 0.0
    for e in range(len(memory.weights)):
        weight = memory.weights[e]
        if weight.of_stage != 0.0:
            row = memory.states[weight.row].component
            column = memory.states[weight.column].component
            square += weight.of_stage * row * column
    return square


@njit_noalloc
def _squared_length_at_end(memory):
    """The same by the weights of the last predicted state."""
    square = 0.0
    for e in range(len(memory.weights)):
        weight = memory.weights[e]
        if weight.of_end != 0.0:
            row = memory.states[weight.row].component
            column = memory.states[weight.column].component
            square += weight.of_end * row * column
    return square


@njit_noalloc
def planned_costs(memory, reading):
    """What a plan costs, and what its first stages cost as steps that are paid.

    The first stages are as many as a promise is followed for. In contrast to the stage
    costs of a decision these are squared distances alone, which any controller's plan
    has and a measurement can be compared with. Of a plan the last state has a weight of
    its own, of steps none. They are NaN where no plan is applied.
    """
    if not reading.is_applied:
        return np.nan, np.nan
    means = reading.means
    references = reading.reference
    states = memory.states
    H = len(means) - 1
    steps = 0.0
    steps_before_end = 0.0
    promise = 0.0
    for k in range(H):
        target = references[min(k + 1, len(references) - 1)]
        for i in range(len(states)):
            off = usual(means[k + 1, i]) - target[i]
            states[i].component = wrapped(off, states[i].is_angle)
        steps_before_end = steps
        steps += _squared_length(memory)
        if k < LONG:
            promise = steps
    return steps_before_end + _squared_length_at_end(memory), promise


@njit_noalloc
def follow_reference(memory, reference, distance):
    """How far the reference has moved in a way that no plan has known before.

    A move that is small beside the distance begins no new way: what the way was to cost
    rises by as much as the move adds.
    """
    flight = memory.flight[0]
    move = _move_of_reference(memory, reference)
    farthest = max(move.unannounced, move.of_end)
    if flight.step == 0 or farthest > _NEWS * distance.now:
        flight.since_news = 0
    else:
        flight.since_news += 1
        added = move.end_cost
        added += max(flight.horizon - 1, 0) * move.of_end * move.of_end
        flight.first_cost = (math.sqrt(flight.first_cost) + math.sqrt(added)) ** 2
        flight.nearest += farthest
    return move


@njit_noalloc
def _move_of_reference(memory, reference):
    """How far a reference is from the last one, one step on; remembers it for the next.

    Moves within rounding are none.
    """
    states = memory.states
    following = min(1, len(reference) - 1)
    for i in range(len(states)):
        state = states[i]
        now = reference[0, i]
        state.component = _rounded_move(now - state.next_reference, now, state)
        state.next_reference = reference[following, i]
    unannounced = _squared_length(memory)
    for i in range(len(states)):
        state = states[i]
        end = reference[-1, i]
        state.component = _rounded_move(end - state.horizon_end, end, state)
        state.horizon_end = end
    return _Move(
        unannounced=math.sqrt(max(0.0, unannounced)),
        of_end=math.sqrt(max(0.0, _squared_length(memory))),
        end_cost=max(0.0, _squared_length_at_end(memory)),
    )


@njit_noalloc
def _rounded_move(difference, value, state):
    """How far a state's reference has moved; 0 for rounding, and at first."""
    move = wrapped(difference, state.is_angle)
    return move if abs(move) > rounding_of(value) else 0.0


@njit_noalloc
def remember_first_cost(flight, plan_cost):
    """Remembers the largest cost of the first plans that knew of a new reference.

    It is what the cost is to fall from.
    """
    if flight.since_news == 0:
        flight.awaits_cost = 1
    if flight.awaits_cost == 1 and plan_cost == plan_cost:
        flight.first_cost = max(flight.first_cost, plan_cost)
        flight.awaits_cost = 0


@njit_noalloc
def follow_promise(flight, distance, promise, move):
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
    counted_distance = distance.now
    if k > 0:  # one wrong measurement costs nothing
        counted_distance = min(counted_distance, flight.distances[(k - 1) % RING])
    flight.paid[slot] = counted_distance * counted_distance
    # The slots still hold what belongs to step k - h. Its plan promised no noise, nor
    # what prepares for a reference that is known later: of an end that moved just then
    # it knew a single stage.
    negligible_square = distance.negligible_below * distance.negligible_below
    allowed_cost = flight.promises[slot] + 0.25 * h * negligible_square
    allowed_cost += flight.allowances[slot]
    flight.allowances[slot] = _allowance(move, h)
    is_comparable = min(flight.horizon, LONG) == h
    flight.promises[slot] = promise if is_comparable else np.nan
    if k < h or flight.steps_with_change <= FEWEST_CHANGES:  # the noise is not known
        return 0.0
    paid = 0.0
    for j in range(h):
        paid += flight.paid[j]
        allowed_cost += flight.allowances[j]
    ratio = paid / (allowed_cost + 1e-300)
    return ratio if ratio == ratio else 0.0


@njit_noalloc
def _allowance(move, h):
    """What h steps may cost more than promised, by what the reference does now.

    An end that moves is prepared for. What was not announced is ahead in each of the
    steps, and adds to what others were: h of them, each h times as much as one, are no
    less than the sum of all, squared.
    """
    unannounced = h * move.unannounced
    return move.of_end * move.of_end + unannounced * unannounced


@njit_noalloc
def follow_course(flight, distance, plan_cost, promise_ratio):
    """Remembers distance and cost; returns where they have gone."""
    k = flight.step
    flight.distances[k % RING] = distance.now
    flight.costs[k % RING] = plan_cost
    half = min(max(flight.promise_window // 2, GROWTH[0]), GROWTH[1])
    # Before the window is full its slots hold zeros, and nothing is growing.
    was_away = flight.distances[(k - half) % RING] > distance.negligible_below
    was_nearer = flight.distances[(k - 2 * half) % RING] < distance.now
    cost_ratio = 0.0
    if flight.since_news > LONG and flight.first_cost > 0.0:
        cost_ratio = plan_cost / flight.first_cost
    return Course(
        distance=distance.now,
        matters=distance.now > distance.negligible_below,
        is_far=distance.now > flight.longest_way,
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
def follow_loss(flight, course, plan_cost, predicts_well):
    """A plant that runs away, by its distance or by what its plans cost.

    It stays lost until it has come back by half.
    """
    if flight.lost != HEALTHY and course.distance < 0.5 * flight.distance_when_lost:
        flight.lost = HEALTHY
    if flight.lost == HEALTHY:
        flight.distance_when_lost = course.distance
    runs_away = course.distance_grows and course.is_far
    costs_rise = course.cost_climbs and course.cost_ratio > _RISEN
    has_no_cause = flight.lost == HEALTHY or flight.lost == ESCAPING
    if has_no_cause and course.matters:
        if runs_away and course.promise_ratio > _BROKEN:
            flight.lost = AWAY
        elif costs_rise and predicts_well:
            flight.lost = RISING
        elif costs_rise and runs_away:  # plans promise it, of a model that is wrong
            flight.lost = ESCAPING
    if flight.lost == HEALTHY:
        return WELL
    if flight.lost != RISING:
        return Alarm(flight.lost, 0, course.distance)
    if plan_cost == plan_cost:
        flight.cost_ratio_when_lost = plan_cost / flight.first_cost
    return Alarm(RISING, 0, flight.cost_ratio_when_lost)


@njit_noalloc
def check_climbing(course, predicts_well):
    """Plans that cost ever more although the model predicts well."""
    climbs = course.cost_climbs and predicts_well and course.cost_ratio > _CLIMBED
    if climbs and course.matters:
        return Alarm(CLIMBING, 0, course.cost_ratio)
    return WELL


@njit_noalloc
def check_promise(course):
    """Steps that cost several times what was promised."""
    if course.matters and course.promise_ratio > _BROKEN:
        return Alarm(PROMISE, 0, course.promise_ratio)
    return WELL


@njit_noalloc
def is_doubtful(course):
    """Whether a promise is half as badly kept as one that is broken."""
    return course.promise_ratio > 0.5 * _BROKEN


@njit_noalloc
def follow_approach(flight, distance):
    """No way made for long, while half of it is still ahead.

    Steps at rest are no steps on the way: what is pushed away then begins a new one.
    """
    if distance.now <= distance.negligible_below:
        flight.nearest = np.inf
        flight.since_nearer = 0
        return WELL
    if distance.now < 0.9 * flight.nearest or flight.since_news == 0:
        flight.nearest = distance.now
        flight.since_nearer = 0
        return WELL
    flight.since_nearer += 1
    is_far = distance.now > 0.5 * flight.longest_way
    if is_far and flight.since_nearer > 3 * max(LONG, flight.horizon):
        return Alarm(STANDING, 0, float(flight.since_nearer))
    return WELL


@njit_noalloc
def follow_bounds(memory, applied_input, distance):
    """An input that has stayed at a bound for long while the distance did not fall.

    At rest an input may be at a bound, such as a brake; one that is not known does not
    count.
    """
    alarm = WELL
    long = 2 * max(LONG, memory.flight[0].horizon)
    for j in range(len(memory.inputs)):
        input = memory.inputs[j]
        if distance.now <= distance.negligible_below:
            input.steps_at_bound = 0
            continue
        value = applied_input[j]
        if value != value:
            continue
        size = rounding_of(value)
        if input.upper - input.lower <= size:  # it is locked
            continue
        if value <= input.lower + size or value >= input.upper - size:
            # It is infinite until a distance is known.
            if input.steps_at_bound == 0 or input.distance_at_bound == np.inf:
                input.distance_at_bound = distance.now
            input.steps_at_bound += 1
        else:
            input.steps_at_bound = 0
        is_nearer = distance.now < 0.95 * input.distance_at_bound
        if input.steps_at_bound > long and not is_nearer:
            alarm = Alarm(SATURATED, j, float(input.steps_at_bound))
    return alarm
