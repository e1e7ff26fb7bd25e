"""The checks of a flight's step, compiled.

``judge_step`` takes a step into the memory of its flight and leaves the first alarm
there. Functions ``follow_*`` and ``remember_*`` write the memory, each of them once a
step, and ``judge_step`` itself counts the steps; ``check_*`` only read. The tuple
``alarms`` is the list of alarms, in the order in which they are named to the user. What
they are for is told in ``_judgement``.

    _flight_memory       what a flight has shown so far
    _innovation_checks   innovations, and the sensors that they come from
    _course_checks       distances, promises, what plans cost, inputs at their bounds

A measurement that is missing is NaN. It is no innovation, it tells nothing of its
sensor, and the plant counts as where the last plan predicted it. Numbers beyond
``UNMEASURED`` count as missing, in measurements and in plans: their squares may be
none, and one of them would stay in the sums of windows.
"""

import numpy as np

from gpmpc._compiled import compiled, njit_noalloc
from gpmpc.mpc._controller import KEPT
from gpmpc.mpc._course_checks import (
    check_climbing,
    check_promise,
    follow_approach,
    follow_bounds,
    follow_course,
    follow_distance,
    follow_loss,
    follow_promise,
    follow_reference,
    is_doubtful,
    planned_costs,
    remember_first_cost,
)
from gpmpc.mpc._flight_memory import (
    FAILURES,
    HEALTHY,
    LONG,
    MISFIT,
    NOVELTY,
    VIOLATION,
    WELL,
    WINDOW,
    Alarm,
    Reading,
    total,
    usual,
)
from gpmpc.mpc._innovation_checks import follow_innovations, follow_sensors

_FEW = 3  # steps of a window: failures, or plans far from the data
_FAR = 0.9  # novelty from which on a model says little more than before any data


@compiled(locked=True, allocates=False)
def judge_step(
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
    plan_cost, promise = planned_costs(memory, reading)
    if reading.is_applied:
        flight.horizon = len(means) - 1
    if flight.promise_window == 0:
        flight.promise_window = min(flight.horizon, LONG)

    # The order counts: sensor variances come from the innovations, distances need these
    # variances, and what a reference tells is news or not by the distance from it.
    innovation, bias = follow_innovations(memory)
    frozen = follow_sensors(memory)
    distance = follow_distance(memory, reading.reference)
    move = follow_reference(memory, reading.reference, distance)
    remember_first_cost(flight, plan_cost)
    promise_ratio = follow_promise(flight, distance, promise, move)
    course = follow_course(flight, distance, plan_cost, promise_ratio)
    far_plans = _follow_novelty(flight, reading.novelty)
    predicts_well = (
        innovation.reason == HEALTHY and bias.reason == HEALTHY and far_plans == 0.0
    )
    lost = follow_loss(flight, course, plan_cost, predicts_well)
    failures = _follow_failures(flight, reading.is_applied)
    violation = _follow_violation(flight, reading.violation)
    standing = follow_approach(flight, distance)
    saturated = follow_bounds(memory, reading.input, distance)
    alarms = (  # in the order in which they are named
        lost,
        frozen,
        innovation,
        bias,
        check_climbing(course, predicts_well),
        check_promise(course),
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
    return WELL


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
        and len(reading.input) == len(memory.inputs)
    )


@njit_noalloc
def _remember_measurement(memory, measured):
    """Remembers what is measured now."""
    for i in range(len(measured)):
        memory.states[i].measured = usual(measured[i])


@njit_noalloc
def _remember_plan(memory, reading):
    """Remembers where a plan begins, and what it predicts for the next step."""
    for i in range(len(memory.states)):
        state = memory.states[i]
        state.plan_start = np.nan
        state.predicted = np.nan
        state.predicted_variance = np.nan
        if reading.is_applied:
            state.plan_start = usual(reading.means[0, i])
            state.predicted = usual(reading.means[1, i])
            state.predicted_variance = reading.covariances[1, i, i]


@njit_noalloc
def _follow_failures(flight, is_applied):
    """Decisions of a window that could not be applied."""
    flight.failed[flight.step % WINDOW] = 0.0 if is_applied else 1.0
    failures = total(flight.failed)
    if failures >= _FEW:
        return Alarm(FAILURES, 0, failures)
    return WELL


@njit_noalloc
def _follow_novelty(flight, novelty):
    """How many plans of a window were far from the model's data."""
    flight.far[flight.step % WINDOW] = 1.0 if novelty > _FAR else 0.0
    return total(flight.far)


@njit_noalloc
def _check_novelty(flight, course, far_plans, novelty):
    """Plans far from the data, on a way that is long or not as promised."""
    is_on_its_way = course.distance > 0.5 * flight.longest_way
    matters = course.matters and (is_on_its_way or is_doubtful(course))
    if far_plans >= _FEW and matters:
        return Alarm(NOVELTY, 0, novelty)
    return WELL


@njit_noalloc
def _follow_violation(flight, violation):
    """Plans that have missed a constraint for long, the last no less than the first.

    A step without a plan, or whose violation is unknown, does not count.
    """
    if violation != violation:
        return WELL
    if violation <= KEPT:
        flight.violated = 0
        return WELL
    if flight.violated == 0:
        flight.first_violation = violation
    flight.violated += 1
    is_long = flight.violated > 2 * WINDOW
    if is_long and violation >= 0.9 * flight.first_violation:
        return Alarm(VIOLATION, 0, violation)
    return WELL
