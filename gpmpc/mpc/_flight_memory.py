"""What a flight has shown so far, and what is known of it from the beginning.

The memory of ``_flight_checks``: one record for each state, each input and the flight
as a whole, and one for each weight. Python makes them, compiled code writes them.
"""

import math
from typing import NamedTuple

import numpy as np

from gpmpc._arrays import UNMEASURED
from gpmpc._compiled import njit_noalloc

Array = np.ndarray

WINDOW = 8  # steps over which innovations, novelty and failures are looked at
BIAS_WINDOW = 16  # steps over which innovations are to cancel each other
CHANGES = 40  # differences of innovations that say how large the sensors' noise is
FEWEST_CHANGES = 4  # of them, before any innovation is judged
GROWTH = (6, 20)  # least and most steps in each half of a window of growth
LONG = 20  # steps that a promise is followed for at most
RING = 2 * GROWTH[1] + 1  # steps that distances and costs are remembered for
ROUNDING = 1e-9

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
ESCAPING = 13
STILL = 14

# What a flight has shown so far of each state. Rings are filled in turns: step k writes
# slot k modulo the length, but for those of changes, whose count stands beside them.
STATE_MEMORY = np.dtype(
    [
        ("model_noise", np.float64),  # variance of the next one that plans leave out
        ("is_angle", np.float64),  # 1 where it is
        ("innovation", np.float64),  # the last one; NaN where there was none
        ("ratios", np.float64, WINDOW),  # squared innovations over their variances
        ("ratio", np.float64),  # their sum
        ("deviations", np.float64, BIAS_WINDOW),  # innovations over their deviations
        ("bias", np.float64),  # their sum
        ("last_change", np.float64),  # of the innovation, when it was known
        # share of changes against the last one, forgotten slowly; as long as it moves
        ("turns", np.float64),
        ("change_count", np.int64),  # differences of successive innovations so far
        ("squared_changes", np.float64, CHANGES),  # their squares
        ("ordered_changes", np.float64, CHANGES),  # the same, from the smallest on
        ("sensor_variance", np.float64),  # the sensors' part of the innovations
        ("motion", np.float64),  # largest squared predicted motion, forgotten slowly
        ("measured", np.float64),  # now; NaN where it is not
        ("last_measured", np.float64),  # before, at any step
        ("last_move", np.float64),  # of what is measured, when it last showed one
        # by the last plan, which began one step ago; NaN without one
        ("plan_start", np.float64),  # where it began
        ("predicted", np.float64),  # where it led by now
        ("predicted_variance", np.float64),
        ("repeats", np.float64),  # for how many steps the sensor has shown the same
        ("missed_moves", np.float64),  # those of them in which it was to change
        ("is_coarse", np.float64),  # 1 where it has gone on after showing the same
        # where the reference has been lately; at first, where the state was
        ("lately", np.float64),
        ("horizon_end", np.float64),  # the end of the last reference
        ("next_reference", np.float64),  # its value for this step
        ("component", np.float64),  # of the difference whose length is measured
    ]
)
INPUT_MEMORY = np.dtype(
    [
        ("lower", np.float64),
        ("upper", np.float64),
        # for how many steps it has stayed at a bound away from the reference
        ("steps_at_bound", np.int64),
        ("distance_at_bound", np.float64),  # when it came to its bound
    ]
)
# One that is not zero in either of two matrices (n, n).
WEIGHT = np.dtype(
    [
        ("row", np.int64),
        ("column", np.int64),
        ("of_stage", np.float64),
        ("of_end", np.float64),  # of the last predicted state
    ]
)
# What a flight has shown of all states together. Of the rings of ``RING`` slots, two
# turn after that many steps; the other three only use the first ``promise_window``
# slots, and turn after as many steps.
FLIGHT_MEMORY = np.dtype(
    [
        ("step", np.int64),  # number of the step, from 0
        ("steps_with_change", np.int64),  # steps so far in which any state had a change
        ("horizon", np.int64),  # of the last plan that was applied; 0 at first
        # steps that a promise is followed for; 0 at first
        ("promise_window", np.int64),
        ("since_news", np.int64),  # steps since the reference has moved far
        # steps since the plant came nearer to it, or was there
        ("since_nearer", np.int64),
        ("violated", np.int64),  # steps for which plans have missed a constraint
        ("lost", np.int64),  # why it is lost, or ``HEALTHY``
        # the first alarm of the last step, as in ``Alarm``
        ("reason", np.int64),
        ("entry", np.int64),
        ("value", np.float64),
        # the farthest that the reference's end was from where it had been lately
        ("longest_way", np.float64),
        ("distance_when_lost", np.float64),
        ("cost_ratio_when_lost", np.float64),  # of the last plan since then
        ("first_violation", np.float64),
        # largest of the first plans to a new reference, and what its moves have added
        ("first_cost", np.float64),
        ("awaits_cost", np.int64),  # 1 until there is a plan to the last news
        ("nearest", np.float64),  # distance on the way there; infinite at rest
        ("distances", np.float64, RING),
        ("costs", np.float64, RING),  # of plans
        # modulo promise_window: what a step may cost more than plans before it promised
        ("allowances", np.float64, RING),
        ("paid", np.float64, RING),  # modulo promise_window: squared distances
        # modulo promise_window: by the plan of a step, for as many steps after it; NaN
        # where there was none
        ("promises", np.float64, RING),
        ("far", np.float64, WINDOW),  # 1 where a plan was far from the data
        ("failed", np.float64, WINDOW),  # 1 where a decision was not applied
    ]
)


class Memory(NamedTuple):
    """What is known of a flight of n states and m inputs."""

    states: Array  # (n,) of ``STATE_MEMORY``
    inputs: Array  # (m,) of ``INPUT_MEMORY``
    weights: Array  # of the distance, of ``WEIGHT``
    flight: Array  # (1,) of ``FLIGHT_MEMORY``


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


WELL = Alarm(HEALTHY, entry=0, value=0.0)


def new_flight_memory() -> Array:
    """Returns the memory (1,) of all states together at the start of a flight."""
    flight = np.zeros(1, FLIGHT_MEMORY)
    flight["promises"] = np.nan
    return flight


def new_state_memory(model_noise: Array, is_angle: Array) -> Array:
    """Returns the memory (n,) of states at the start of a flight.

    Their noise is variances (n,); ``is_angle`` (n,) is 1 where one is an angle.
    """
    states = np.zeros(len(model_noise), STATE_MEMORY)
    states["model_noise"] = model_noise
    states["is_angle"] = is_angle
    states["ordered_changes"] = np.inf
    unknown = (
        "innovation",
        "last_measured",
        "plan_start",
        "predicted",
        "predicted_variance",
        "lately",
        "horizon_end",
        "next_reference",
    )
    for field in unknown:
        states[field] = np.nan
    return states


def new_input_memory(lower: Array, upper: Array) -> Array:
    """Returns the memory (m,) of inputs with bounds (m,) at the start of a flight."""
    inputs = np.zeros(len(lower), INPUT_MEMORY)
    inputs["lower"] = lower
    inputs["upper"] = upper
    return inputs


def weights_of(stage: Array, end: Array) -> Array:
    """Returns what is not zero of the weights (n, n) of a stage and of the end."""
    rows, columns = np.nonzero((stage != 0.0) | (end != 0.0))
    weights = np.zeros(len(rows), WEIGHT)
    weights["row"] = rows
    weights["column"] = columns
    weights["of_stage"] = stage[rows, columns]
    weights["of_end"] = end[rows, columns]
    return weights


@njit_noalloc
def usual(value):
    """A number such as are measured and planned, or else NaN."""
    return value if abs(value) < UNMEASURED else np.nan


@njit_noalloc
def total(values):
    """The sum of values."""
    result = 0.0
    for value in values:
        result += value
    return result


@njit_noalloc
def wrapped(value, is_angle):
    """A difference, of angles within half a turn."""
    if is_angle == 0.0:
        return value
    return value - 2.0 * math.pi * np.round(value / (2.0 * math.pi))


@njit_noalloc
def rounding_of(value):
    """By how much two numbers of this size may differ and be the same."""
    return ROUNDING * max(1.0, abs(value))
