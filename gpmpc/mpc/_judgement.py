"""Judges a flight while it flies, from what its controller expected: healthy, suspicious or lost, and why.

A decision that is SOLVED says that a program was solved, not that the plant does what was planned. Each step of a
flight tells more, and a judge looks at

* the *innovation*, measured minus predicted, whose squares over their variance are of chi-square where the model is
  right (Bar-Shalom, Li and Kirubarajan, 2001, section 5.4). The variance is the predicted one, the noise that the
  model has learned, that of the sensors, and a share of what moves. The sensors' noise is not known: it is the median
  of squared differences of successive innovations, in which what changes slowly has no part, and a jump no weight;
* the *promise*: what the stages of a plan cost, and what the same steps then cost in truth. In optimal control the
  cost falls by what is paid (Gruene and Rantzer, 2008, section 3); where steps cost several times as much as was
  promised, the plan does not lead where it says;
* the *distance* from the reference in the cost's metric: a plant whose distance grows faster and faster, against the
  promise, is lost;
* *novelty*, as long as the reference is far away or the promise not kept; *violation*, failed solves, sensors that
  stand still and inputs that stay at a bound without effect.

There is nothing to set. Windows are short (eight steps) beside those of the loss, so that one wrong measurement is no
alarm, and a change is named within ten steps.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.stats import chi2

from gpmpc._compiled import compiled, njit_noalloc
from gpmpc._dynamics import to_array
from gpmpc.exceptions import UnsupportedModel
from gpmpc.mpc._controller import Decision
from gpmpc.mpc._cost import Tracking
from gpmpc.mpc.problem import Problem
from gpmpc.signals import signals_of

Array = np.ndarray
Level = Literal["healthy", "suspicious", "lost"]

_WINDOW = 8  # steps over which innovations, novelty and failures are looked at
_MEMORY = 40  # differences of innovations that say how large the sensors' noise is
_FEWEST = 4  # of them, before any innovation is judged
_BIAS_WINDOW = 16  # steps over which innovations are to cancel each other
_DOUBT = 10.0  # differences, for as many of which their median is taken twice
_GROWTH = (6, 20)  # least and most steps in each half of a window of growth
_LONG = 20  # steps that a promise is followed for at most
_RARE = 1e-6  # probability of a window's innovations below which they are no chance
_LARGEST_RATIO = float(chi2.isf(_RARE, _WINDOW)) / _WINDOW  # of their mean square
_LARGEST_BIAS = 3.0  # deviations of the model, which one error may keep for long
_CAP = 12.0  # most that one innovation counts for: no outlier decides alone
_LARGEST_SIGNED = 6.0  # most that one counts for, with its sign
_SHARE = 0.05  # of what moves in a step that a good model may miss
_FORGETTING = 0.8  # share of the largest motion's square that counts one step later
_BROKEN = 4.0  # how many times a promise may be paid
_MATERIAL = 0.02  # share of the way travelled below which no distance matters
_FEW = 3  # steps of a window: failures, or plans far from the data
_FAR = 0.9  # novelty from which on a model says little more than before any data
_ROUNDING = 1e-9

# Why a step is not healthy; the number is that of the kernel.
_HEALTHY, _INNOVATION, _PROMISE, _NOVELTY, _VIOLATION, _FAILURES, _SATURATED = range(7)
_FROZEN = 7
_BIAS = 8
_AWAY = 9
_RISING = 10
_CLIMBING = 11
_STANDING = 12


class Judgement(NamedTuple):
    """What a step says of its flight."""

    level: Level = "healthy"
    reason: str = ""  #: in words; empty where it is healthy

    def __str__(self) -> str:
        return f"{self.level}: {self.reason}" if self.reason else self.level


class FlightJudgement(NamedTuple):
    """What all steps say of their flight: lost, if one of them says so, else what the last one says."""

    level: Level = "healthy"
    reason: str = ""  #: in words; empty where it is healthy
    step: int | None = None  #: the first one of that; None where it is healthy
    suspicious: int = 0  #: steps that were
    lost: int = 0  #: steps that were

    @classmethod
    def of(cls, steps: Sequence[Judgement]) -> "FlightJudgement":
        """The judgement of a flight by those of its steps."""
        levels = [judgement.level for judgement in steps]
        suspicious = levels.count("suspicious")
        lost = levels.count("lost")
        if not steps:
            return cls()
        if lost:
            first = levels.index("lost")
            reason = steps[first].reason
            if levels[-1] != "lost":
                last = len(levels) - 1 - levels[::-1].index("lost")
                reason += f"; back from step {last + 1} on"
            return cls("lost", reason, first, suspicious, lost)
        if levels[-1] == "healthy":
            return cls(suspicious=suspicious)
        first = len(levels)
        while first > 0 and levels[first - 1] == "suspicious":
            first -= 1
        return cls("suspicious", steps[-1].reason, first, suspicious)


class _Settings(NamedTuple):
    """What stays the same through a flight; n states and m inputs."""

    weights: Array  # of the states (n, n)
    terminal: Array  # of the last predicted one (n, n)
    model_noise: Array  # variances of a next state that plans leave out (n,)
    angles: Array  # 1 where a state is an angle (n,)
    lower: Array  # bounds of the inputs (m,)
    upper: Array  # (m,)


class _Memory(NamedTuple):
    """What a flight has shown so far; rings are filled in turns.

    Its fields are views of four arrays: to hand over each by itself takes longer than
    to judge.
    """

    ratios: Array  # squares of innovations over their variances (window, n)
    signed: Array  # innovations over their deviations (bias window, n)
    changes: Array  # squared differences of successive innovations (memory, n)
    ordered: Array  # the same, each state's in order (memory, n)
    ratio: Array  # sum of the ratios (n,)
    bias: Array  # sum of the signed ones (n,)
    motion: Array  # the largest square of a predicted motion, forgotten slowly (n,)
    variance: Array  # of the sensors' part of the innovations (n,)
    innovation: Array  # the last one (n,); NaN where there was none
    measured: Array  # the last measurement (n,)
    repeats: Array  # for how many steps a sensor has shown the same (n,)
    coarse: Array  # 1 where a sensor has gone on after showing the same (n,)
    start: Array  # the first measurement (n,)
    horizon_end: Array  # the last row of the last reference (n,)
    next_reference: Array  # its row for this step (n,)
    distances: Array  # (2 growth + 1,)
    costs: Array  # of plans (2 growth + 1,)
    news: Array  # squared steps of the reference's end, which no earlier plan knew
    paid: Array  # squared distances
    promised: Array  # what the plan of a step promised for the next steps
    far: Array  # 1 where a plan was far from the data (window,)
    failed: Array  # 1 where a decision was not applied (window,)
    counts: Array  # by the names below
    at_bound: Array  # for how many steps an input has stayed at a bound (m,)
    numbers: Array  # by the names below


(
    _STEPS,
    _CHANGES,
    _VIOLATED,
    _LOST_AS,
    _LOOK_AHEAD,
    _SINCE_NEWS,
    _SINCE_NEARER,
    _COUNTS,
) = range(8)
_TRAVEL, _LOST_AT, _VIOLATION_THEN, _STUCK_AT, _COST_BEFORE, _NEAREST, _NUMBERS = range(
    7
)
_RINGS = 7
_LENGTH = 2 * _GROWTH[1] + 1
_SIGNED = _WINDOW  # where the rings of each state begin, one below the other
_CHANGED = _SIGNED + _BIAS_WINDOW
_ORDERED = _CHANGED + _MEMORY
_LATEST = _ORDERED + _MEMORY
_ROWS = _LATEST + 11


class _Store(NamedTuple):
    """The arrays that the fields of a memory are views of."""

    states: Array  # (rows, n)
    rings: Array  # (rings, length)
    counts: Array  # (counts + m,)
    numbers: Array  # (numbers,)


@njit_noalloc
def _memory_in(store):
    states = store.states
    rings = store.rings
    counts = store.counts
    return _Memory(
        states[:_SIGNED],
        states[_SIGNED:_CHANGED],
        states[_CHANGED:_ORDERED],
        states[_ORDERED:_LATEST],
        states[_LATEST],
        states[_LATEST + 1],
        states[_LATEST + 2],
        states[_LATEST + 3],
        states[_LATEST + 4],
        states[_LATEST + 5],
        states[_LATEST + 6],
        states[_LATEST + 7],
        states[_LATEST + 8],
        states[_LATEST + 9],
        states[_LATEST + 10],
        rings[0],
        rings[1],
        rings[2],
        rings[3],
        rings[4],
        rings[5, :_WINDOW],
        rings[6, :_WINDOW],
        counts[:_COUNTS],
        counts[_COUNTS:],
        store.numbers,
    )


class _Reading(NamedTuple):
    """What is known of one step."""

    measured: Array  # (n,)
    reference: Array  # from this step on, to its end or as far as known (H + 1, n)
    before: Array  # state that the last plan started from (n,)
    expected: Array  # state that it predicted (n,); NaN without a plan
    spread: Array  # covariance of that (n, n)
    horizon: int  # H of the new plan
    cost: float  # of the new plan; NaN where there is none
    promised: float  # of its first stages, of ``_LONG`` at most
    input: Array  # applied now (m,)
    novelty: float
    violation: float
    applied: bool  # whether the decision is


class FlightJudge:
    """Judges the steps of one flight, in their order; for a robot of one's own as well as for ``closed_loop``.

    Args:
        problem: What the controller makes small; its state weights measure distances.
        noise: Variances (n,) of a next state that the covariances of plans leave out, as
            the model has learned them; zero by default.
        names: Of the states and of the inputs, for the reasons; by default their numbers.

    Attributes:
        last: Judgement of the last step.
    """

    def __init__(
        self,
        problem: Problem,
        noise: Any = None,
        names: tuple[Sequence[str], Sequence[str]] = ((), ()),
    ):
        n = problem.state_dim
        m = problem.input_dim
        angles = np.zeros(n)
        angles[list(problem.cost.angles)] = 1.0
        own_noise = np.zeros(n) if noise is None else np.asarray(noise, dtype=float)
        weights = problem.cost.Q.reshape(-1, n, n)[0]
        self._table = np.vstack([weights, problem.cost.terminal, own_noise, angles])
        self._bounds = np.array(problem.inputs.first, dtype=float)
        self._store = _Store(
            states=np.zeros((_ROWS, n)),
            rings=np.zeros((_RINGS, _LENGTH)),
            counts=np.zeros(_COUNTS + m, dtype=np.int64),
            numbers=np.zeros(_NUMBERS),
        )
        self._store.states[_ORDERED:_LATEST] = np.inf
        self._store.states[_LATEST + 4 :] = np.nan
        self._store.states[_LATEST + 6 : _LATEST + 8] = 0.0
        self._no_means = np.full((2, n), np.nan)
        self._no_covariances = np.full((2, n, n), np.nan)
        self._no_input = np.full(m, np.nan)
        self._constrained = bool(problem.constraints)
        self._states = tuple(names[0]) or tuple(f"state {i}" for i in range(n))
        self._inputs = tuple(names[1]) or tuple(f"input {j}" for j in range(m))
        self._means = self._no_means  # of the plan that was applied last
        self._covariances = self._no_covariances
        self.last = Judgement()

    @classmethod
    def of(
        cls,
        controller: Any,
        state_dim: int,
        input_dim: int,
        names: tuple[Sequence[str], Sequence[str]] | None = None,
    ) -> "FlightJudge":
        """A judge of a controller's flights, by its problem and by the noise that its model has learned.

        Of a controller without a problem no distance is judged. Names are by default its own.
        """
        problem = getattr(controller, "problem", None)
        if not isinstance(problem, Problem):
            nothing = Tracking(Q=np.zeros(state_dim), R=np.ones(input_dim))
            problem = Problem(nothing)
        if names is None:
            signals = signals_of(controller)
            names = signals.state_names, signals.input_names
        return cls(problem, _learned_noise(controller), names)

    def judge(
        self, measured: Array, reference: Array, decision: Decision | None
    ) -> Judgement:
        """Judges one step.

        Args:
            measured: The state as the controller got it (n,); NaN where it was not measured.
            reference: What it is to be from now on (H + 1, n), or a set point (n,).
            decision: What the controller decided on it; None where it was not called.
        """
        last_means = self._means
        last_covariances = self._covariances
        self._means = self._no_means
        self._covariances = self._no_covariances
        input = self._no_input
        novelty = math.nan
        violation = 0.0
        if decision is not None:
            input = _float64(decision.input)
            if decision.applicable:
                self._means = _float64(decision.means)
                self._covariances = _float64(decision.covariances)
                # One that would have to be measured first is not worth the time here.
                if not callable(decision.plan_novelty):
                    novelty = float(decision.plan_novelty)
                violation = float(decision.violation) if self._constrained else 0.0
        references = _float64(reference)
        if references.ndim == 1:
            references = references[None]
        code, index, value = _judge.unchecked(
            self._table,
            self._bounds,
            self._store,
            _float64(measured),
            references,
            last_means,
            last_covariances,
            self._means,
            input,
            (novelty, violation),
        )
        self.last = _ALL_WELL if code == _HEALTHY else self._words(code, index, value)
        return self.last

    def _words(self, code: int, index: int, value: float) -> Judgement:
        """The judgement of a kernel's code, with the state or input and the number that it is about."""
        if code in (_AWAY, _RISING):
            return Judgement("lost", _REASONS[code].format(value=value))
        names = self._inputs if code == _SATURATED else self._states
        return Judgement(
            "suspicious", _REASONS[code].format(name=names[index], value=value)
        )


def _learned_noise(controller: Any) -> Array | None:
    """Variances (n,) of the noise that a controller's model has learned, where its plans do not hold them.

    None where there is no such model.
    """
    steering = getattr(controller, "controller", controller)  # of one that learns
    prediction = getattr(steering, "prediction", None)
    model = getattr(steering, "model", None) or getattr(prediction, "model", None)
    try:
        noise = getattr(model, "noise_covariance", None)
    except UnsupportedModel:  # it depends on the state
        noise = None
    if noise is None:
        return None
    variances = to_array(noise).diagonal().copy()
    settings = getattr(prediction, "settings", None)
    propagator = getattr(prediction, "propagator", None)
    planned = settings is not None and settings.covariance != "none"
    if planned and getattr(propagator, "process_noise", False):
        return np.zeros_like(variances)
    return variances


_ALL_WELL = Judgement()
_FLOAT64 = np.dtype(np.float64)


def _float64(values: Any) -> Array:
    is_plain = type(values) is np.ndarray and values.dtype is _FLOAT64
    if is_plain and values.flags.c_contiguous:
        return values
    return np.ascontiguousarray(values, dtype=np.float64)


_REASONS = {
    _INNOVATION: "innovations of {name} are {value:.3g} standard deviations, root mean "
    f"square of {_WINDOW} steps",
    _BIAS: "innovations of {name} do not cancel each other: {value:.3g} standard "
    f"deviations in the mean of {_BIAS_WINDOW} steps",
    _FROZEN: "{name} is measured the same for {value:.0f} steps while other states move",
    _PROMISE: "steps cost {value:.3g} times what the plans promised",
    _NOVELTY: "plans are far from the data: there the model knows little more than its "
    "prior",
    _VIOLATION: "plans miss a constraint, by {value:.3g} now, and no less with time",
    _FAILURES: "{value:.0f} of the last " + f"{_WINDOW} decisions could not be applied",
    _SATURATED: "{name} is at its bound for {value:.0f} steps, and the distance from "
    "the reference does not fall",
    _AWAY: "ever faster away from its reference, against what the plans promised; "
    "{value:.3g} from it, in the metric of the cost",
    _CLIMBING: "the plans cost {value:.2g} times as much as at first and ever more, "
    "although the model predicts well",
    _STANDING: "no nearer to the reference for {value:.0f} steps",
    _RISING: "the plans cost {value:.3g} times as much as at first and ever more, "
    "although the model predicts well: the horizon is too short for the plant",
}


@compiled(locked=True, allocates=False)
def _judge(
    table,
    bounds,
    store,
    measured,
    reference,
    last_means,
    last_covariances,
    means,
    input,
    qualities,
):
    """Takes a step into the memory; returns why it is not healthy, which entry that is about, and a number."""
    n = len(measured)
    horizon = len(means) - 1
    settings = _Settings(
        table[:n],
        table[n : 2 * n],
        table[2 * n],
        table[2 * n + 1],
        bounds[0],
        bounds[1],
    )
    cost, promised = _plan_cost(settings, means, reference)
    reading = _Reading(
        measured,
        reference,
        last_means[0],
        last_means[1],
        last_covariances[1],
        horizon,
        cost,
        promised,
        input,
        qualities[0],
        qualities[1],
        cost == cost,
    )
    return _judge_step(settings, _memory_in(store), reading)


@njit_noalloc
def _judge_step(settings, memory, reading):
    counts = memory.counts
    numbers = memory.numbers
    k = counts[_STEPS]
    slot = k % _WINDOW
    if counts[_LOOK_AHEAD] == 0 and reading.applied:
        counts[_LOOK_AHEAD] = min(reading.horizon, _LONG)
    state, size, biased, bias = _judge_innovation(settings, memory, reading)
    frozen = _judge_sensors(memory, reading)
    distance, least = _measure_distance(settings, memory, reading)
    _read_news(settings, memory, reading)
    cost = _follow_cost(memory, reading)
    promise = _follow_promise(memory, reading, distance, least)
    half = min(max(counts[_LOOK_AHEAD] // 2, _GROWTH[0]), _GROWTH[1])
    memory.distances[k % _LENGTH] = distance
    memory.costs[k % _LENGTH] = cost
    was_away = memory.distances[(k - half) % _LENGTH] > least
    grows = was_away and _is_growing(memory.distances, k, half)
    cost_grows = _is_growing(memory.costs, k, half)
    memory.far[slot] = 1.0 if reading.novelty > _FAR else 0.0
    memory.failed[slot] = 0.0 if reading.applied else 1.0
    failures = _total(memory.failed)
    far = _total(memory.far)
    predicts_well = state < 0 and biased < 0 and far == 0.0
    was_nearer = memory.distances[(k - 2 * half) % _LENGTH] < distance
    share = 0.0  # of the cost from which the plans were to bring it down
    if counts[_SINCE_NEWS] > _LONG and numbers[_COST_BEFORE] > 0.0:
        share = cost / numbers[_COST_BEFORE]
    climbs = cost_grows and was_away and was_nearer and predicts_well and share > 0.1
    if counts[_LOST_AS] > 0 and distance < 0.5 * numbers[_LOST_AT]:
        counts[_LOST_AS] = 0
    if counts[_LOST_AS] == 0 and distance > least:
        if grows and promise > _BROKEN and distance > numbers[_TRAVEL]:
            counts[_LOST_AS] = _AWAY
        elif climbs and share > 2.0:
            counts[_LOST_AS] = _RISING
        numbers[_LOST_AT] = distance
    stuck = _judge_bounds(settings, memory, reading, distance, least)
    missed = _judge_violation(memory, reading)
    stands = _is_standing(memory, reading, distance, least)
    counts[_STEPS] = k + 1
    if counts[_LOST_AS] == _AWAY:
        return _AWAY, 0, distance
    if counts[_LOST_AS] == _RISING:
        return _RISING, 0, cost / numbers[_COST_BEFORE]
    if frozen >= 0:
        return _FROZEN, frozen, memory.repeats[frozen]
    if state >= 0:
        return _INNOVATION, state, size
    if biased >= 0:
        return _BIAS, biased, bias
    if climbs and distance > least:
        return _CLIMBING, 0, share
    if distance > least and promise > _BROKEN:
        return _PROMISE, 0, promise
    if failures >= _FEW:
        return _FAILURES, 0, failures
    is_on_its_way = distance > 0.5 * numbers[_TRAVEL] or promise > 0.5 * _BROKEN
    if far >= _FEW and distance > least and is_on_its_way:
        return _NOVELTY, 0, reading.novelty
    if missed:
        return _VIOLATION, 0, reading.violation
    if stands:
        return _STANDING, 0, float(counts[_SINCE_NEARER])
    if stuck >= 0:
        return _SATURATED, stuck, float(memory.at_bound[stuck])
    return _HEALTHY, 0, 0.0


@njit_noalloc
def _read_news(settings, memory, reading):
    """What the end of the reference tells that no plan has known before, in the cost's metric."""
    counts = memory.counts
    n = len(reading.measured)
    now = reading.reference[0]
    end = reading.reference[-1]
    square = 0.0
    size = 0.0
    for i in range(n):
        step = _wrapped(end[i] - memory.horizon_end[i], settings.angles[i])
        size += settings.weights[i, i] * end[i] * end[i]
        for j in range(n):
            if settings.weights[i, j] != 0.0:
                other = _wrapped(end[j] - memory.horizon_end[j], settings.angles[j])
                square += settings.weights[i, j] * step * other
    if not square > 1e-12 * max(1.0, size):
        square = 0.0
    is_new = square > 0.0 or counts[_STEPS] == 0
    counts[_SINCE_NEWS] = 0 if is_new else counts[_SINCE_NEWS] + 1
    memory.news[counts[_STEPS] % max(counts[_LOOK_AHEAD], 1)] = square
    following = reading.reference[min(1, len(reading.reference) - 1)]
    is_as_announced = True
    for i in range(n):
        off = _wrapped(now[i] - memory.next_reference[i], settings.angles[i])
        if abs(off) > _ROUNDING * max(1.0, abs(now[i])):
            is_as_announced = False
        memory.next_reference[i] = following[i]
        memory.horizon_end[i] = end[i]
    if not is_as_announced:  # no plan has promised anything of this
        for j in range(_LENGTH):
            memory.promised[j] = np.nan


@njit_noalloc
def _follow_cost(memory, reading):
    """What the plan costs; the largest while its reference was news is what it falls from."""
    counts = memory.counts
    numbers = memory.numbers
    cost = reading.cost
    if counts[_SINCE_NEWS] == 0 and cost > numbers[_COST_BEFORE]:
        numbers[_COST_BEFORE] = cost
    return cost


@njit_noalloc
def _plan_cost(settings, means, references):
    """The squared distances of a plan's means (H + 1, n) from their references, weighed: of all, and of the first."""
    H = len(means) - 1
    n = means.shape[1]
    total = 0.0
    first = 0.0
    for k in range(H):
        weights = settings.terminal if k == H - 1 else settings.weights
        wanted = references[min(k + 1, len(references) - 1)]
        for i in range(n):
            off = _wrapped(means[k + 1, i] - wanted[i], settings.angles[i])
            for j in range(n):
                if weights[i, j] != 0.0:
                    other = _wrapped(means[k + 1, j] - wanted[j], settings.angles[j])
                    total += weights[i, j] * off * other
        if k == _LONG - 1:
            first = total
    return total, total if H <= _LONG else first


@njit_noalloc
def _total(values):
    total = 0.0
    for value in values:
        total += value
    return total


@njit_noalloc
def _wrapped(value, is_angle):
    if is_angle == 0.0:
        return value
    return value - 2.0 * math.pi * np.round(value / (2.0 * math.pi))


@njit_noalloc
def _judge_innovation(settings, memory, reading):
    """The states whose innovations are no chance, with their root mean square or mean in deviations; or -1.

    The first is that of the largest squares in a window, the second that whose
    innovations do not cancel each other in a longer one.
    """
    counts = memory.counts
    k = counts[_STEPS]
    changes = counts[_CHANGES]
    slot = k % _WINDOW
    signed_slot = k % _BIAS_WINDOW
    place = changes % _MEMORY
    known = min(changes, _MEMORY)
    is_judged = changes >= _FEWEST
    # Half the squared difference of white innovations is their variance; the median of
    # a chi-square of one degree is 0.455, and that of a few is uncertain.
    scale = (1.0 + _DOUBT / max(known, 1)) / 0.455 / 2.0
    has_change = False
    worst = -1
    worst_ratio = _LARGEST_RATIO * _WINDOW
    biased = -1
    bias = _LARGEST_BIAS * _BIAS_WINDOW
    for i in range(len(reading.measured)):
        innovation = reading.measured[i] - reading.expected[i]
        innovation = _wrapped(innovation, settings.angles[i])
        ratio = 0.0
        signed = 0.0
        if is_judged:
            memory.variance[i] = scale * memory.ordered[known // 2, i]
        if innovation == innovation:
            motion = reading.expected[i] - reading.before[i]
            motion = max(motion * motion, _FORGETTING * memory.motion[i])
            memory.motion[i] = motion
            size = _ROUNDING * max(1.0, abs(reading.measured[i]))
            # Of an error of the model each step may have all, the sensors' cancel.
            own = size * size + reading.spread[i, i] + settings.model_noise[i]
            own += _SHARE * _SHARE * motion
            if is_judged:
                ratio = innovation * innovation / (own + memory.variance[i])
                ratio = min(ratio, _CAP)
                signed = innovation / math.sqrt(own + memory.variance[i] / _BIAS_WINDOW)
                signed = min(max(signed, -_LARGEST_SIGNED), _LARGEST_SIGNED)
        memory.ratio[i] += ratio - memory.ratios[slot, i]
        memory.bias[i] += signed - memory.signed[signed_slot, i]
        memory.ratios[slot, i] = ratio
        memory.signed[signed_slot, i] = signed
        if memory.ratio[i] > worst_ratio:
            worst = i
            worst_ratio = memory.ratio[i]
        if abs(memory.bias[i]) > bias:
            biased = i
            bias = abs(memory.bias[i])
        change = innovation - memory.innovation[i]
        memory.innovation[i] = innovation
        if change == change:
            has_change = True
            _remember(memory, changes, i, change * change)
        elif changes > 0:  # what is not known is taken for what was
            last = memory.changes[(place - 1) % _MEMORY, i]
            _remember(memory, changes, i, last)
    counts[_CHANGES] += has_change
    return worst, math.sqrt(worst_ratio / _WINDOW), biased, bias / _BIAS_WINDOW


@njit_noalloc
def _remember(memory, changes, i, value):
    """Puts a value into the ring of a state's changes, and into its place in their order."""
    place = changes % _MEMORY
    if changes < _MEMORY:
        j = changes
    else:
        oldest = memory.changes[place, i]
        j = 0
        end = _MEMORY - 1
        while j < end:  # the first that is no less than the oldest: itself
            middle = (j + end) // 2
            if memory.ordered[middle, i] < oldest:
                j = middle + 1
            else:
                end = middle
        while j < _MEMORY - 1 and memory.ordered[j + 1, i] < value:
            memory.ordered[j, i] = memory.ordered[j + 1, i]
            j += 1
    while j > 0 and memory.ordered[j - 1, i] > value:
        memory.ordered[j, i] = memory.ordered[j - 1, i]
        j -= 1
    memory.ordered[j, i] = value
    memory.changes[place, i] = value


@njit_noalloc
def _judge_sensors(memory, reading):
    """A state that is measured the same to the last digit while others change; or -1.

    A sensor that has shown the same before, and then gone on, has coarse steps: it may.
    """
    n = len(reading.measured)
    changing = 0
    for i in range(n):
        if reading.measured[i] == memory.measured[i]:
            memory.repeats[i] += 1.0
        else:
            if memory.repeats[i] > 0.0:
                memory.coarse[i] = 1.0
            memory.repeats[i] = 0.0
            changing += 1
        memory.measured[i] = reading.measured[i]
    if changing == 0 or memory.counts[_CHANGES] < _FEWEST:
        return -1
    for i in range(n):
        if memory.repeats[i] >= _WINDOW // 2 and memory.coarse[i] == 0.0:
            return i
    return -1


@njit_noalloc
def _measure_distance(settings, memory, reading):
    """Distance from the reference in the cost's metric, and the least that matters."""
    n = len(reading.measured)
    for i in range(n):
        if memory.start[i] != memory.start[i]:
            memory.start[i] = reading.measured[i]
    now = reading.reference[0]
    end = reading.reference[-1]
    square = 0.0
    travel = 0.0
    noise = 0.0
    for i in range(n):
        off = _wrapped(reading.measured[i] - now[i], settings.angles[i])
        way = _wrapped(end[i] - memory.start[i], settings.angles[i])
        for j in range(n):
            weight = settings.weights[i, j]
            if weight != 0.0:
                other = _wrapped(reading.measured[j] - now[j], settings.angles[j])
                square += weight * off * other
                other = _wrapped(end[j] - memory.start[j], settings.angles[j])
                travel += weight * way * other
        variance = settings.model_noise[i] + memory.variance[i]
        if reading.spread[i, i] == reading.spread[i, i]:
            variance += reading.spread[i, i]
        size = _ROUNDING * max(1.0, abs(reading.measured[i]))
        noise += settings.weights[i, i] * (variance + size * size)
    travel = math.sqrt(max(0.0, travel))
    if travel == travel:
        memory.numbers[_TRAVEL] = max(memory.numbers[_TRAVEL], travel)
    least = max(_MATERIAL * memory.numbers[_TRAVEL], 4.0 * math.sqrt(noise))
    return math.sqrt(max(0.0, square)), least


@njit_noalloc
def _follow_promise(memory, reading, distance, least):
    """What steps cost in truth over what the plan before them promised; 0 where that is not known."""
    counts = memory.counts
    k = counts[_STEPS]
    h = counts[_LOOK_AHEAD]
    if h == 0:
        return 0.0
    slot = k % h
    # One wrong measurement costs nothing.
    nearer = min(distance, memory.distances[(k - 1) % _LENGTH]) if k > 0 else distance
    memory.paid[slot] = nearer * nearer
    # What noise costs was not promised, nor what is done early for what came later.
    allowed = memory.promised[slot] + 0.25 * h * least * least
    is_known = min(reading.horizon, _LONG) == h
    memory.promised[slot] = reading.promised if is_known else np.nan
    if k < h or counts[_CHANGES] <= _FEWEST:  # the noise is not known yet
        return 0.0
    paid = 0.0
    for j in range(h):
        paid += memory.paid[j]
        allowed += memory.news[j]
    ratio = paid / (allowed + 1e-300)
    return ratio if ratio == ratio else 0.0


@njit_noalloc
def _is_growing(ring, k, half):
    """Whether the last value is the largest of a window, and grew in its second half no slower than in its first."""
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
def _judge_bounds(settings, memory, reading, distance, least):
    """An input that has stayed at a bound for long while the distance fell by nothing; or -1."""
    stuck = -1
    for j in range(len(settings.lower)):
        u = reading.input[j]
        size = _ROUNDING * max(1.0, abs(u))
        if u <= settings.lower[j] + size or u >= settings.upper[j] - size:
            if memory.at_bound[j] == 0:
                memory.numbers[_STUCK_AT] = distance
            memory.at_bound[j] += 1
        else:
            memory.at_bound[j] = 0
        longest = 2 * max(_LONG, reading.horizon)
        falls = distance < max(least, 0.95 * memory.numbers[_STUCK_AT])
        if memory.at_bound[j] > longest and distance >= least and not falls:
            stuck = j
    return stuck


@njit_noalloc
def _is_standing(memory, reading, distance, least):
    """Whether it has come no nearer for long, while half of the way is still before it."""
    counts = memory.counts
    numbers = memory.numbers
    is_nearer = distance < 0.9 * numbers[_NEAREST]
    if is_nearer or counts[_SINCE_NEWS] == 0:
        numbers[_NEAREST] = distance
        counts[_SINCE_NEARER] = 0
        return False
    counts[_SINCE_NEARER] += 1
    is_far = distance > max(least, 0.5 * numbers[_TRAVEL])
    return is_far and counts[_SINCE_NEARER] > 3 * max(_LONG, reading.horizon)


@njit_noalloc
def _judge_violation(memory, reading):
    """Whether plans have missed a constraint for long, and the last by no less than the first."""
    counts = memory.counts
    numbers = memory.numbers
    if not reading.violation > 1e-6:
        counts[_VIOLATED] = 0
        return False
    if counts[_VIOLATED] == 0:
        numbers[_VIOLATION_THEN] = reading.violation
    counts[_VIOLATED] += 1
    return (
        counts[_VIOLATED] > 2 * _WINDOW
        and reading.violation >= 0.9 * numbers[_VIOLATION_THEN]
    )
