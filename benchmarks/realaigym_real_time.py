"""Plays the league's double pendulum as if computing took its time.

Every decision and every search is timed (processor time, all threads), and acts as much
simulated time later. One core gives torques every 2 ms and decides every 20 ms; a
second one searches from where the pendulum is expected at the search's end. Until a
plan is known the actuated joint is braked; then the other starts are searched for a
better one, while the plan flies and is improved every 20 ms. One that leads nowhere is
dropped, since it would be flown faster and faster.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import ceil, inf
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from benchmarks.realaigym import (
    BRAKE,
    INPUT,
    PLAN,
    REPLAN,
    TICKS,
    TORQUE,
    Array,
    Parts,
    state_of,
    upright,
)
from gpmpc._kernels.gp_rollout import Feedback
from gpmpc.gaussian import Gaussian
from gpmpc.models import RollOut
from gpmpc.mpc import GPMPC, ControlLoop, Decision, ManyStarts, Reference
from gpmpc.mpc._policy import Command

# predicted time below the line up to which a plan is not compared with those of other
# starts [s]
GOOD = 1.0


class Flight(NamedTuple):
    """A plan and its times in inputs of 2 ms.

    It begins at one and is known from the other, when its core is free again.
    """

    loop: ControlLoop
    plan: Decision
    value: float  #: of the criterion
    start: int
    known: int


@dataclass
class RealTimePilot:
    """Flies the best plan that is known; a plan is known after the time it took.

    Attributes: step: Takes a few programs a decision. search: Its starts are taken one
        after the other, again and again while there is no plan. criterion: Of plans:
        predicted time below the line [s]. joint: With the motor: 0, 1. lead: Time from
        a search's call to its first state, in time steps of the plan. share: Of the
        lead, after which no further start is taken.
    """

    step: GPMPC
    search: ManyStarts
    criterion: Callable[[Decision, Reference], float]
    joint: int
    lead: int = 3
    share: float = 0.5
    seconds: list[float] = field(default_factory=list)  #: of each decision [s]
    searched: list[float] = field(default_factory=list)  #: of each search [s]
    between: list[float] = field(default_factory=list)  #: of each torque [s]
    _flight: Flight | None = None
    _decided: Flight | None = None
    _found: Flight | None = None
    _last: float = -1.0
    _count: int = 0
    _turn: int = 0  #: starts taken since there was a plan worth following

    def __post_init__(self) -> None:
        self._roll_out = RollOut(self.search.planner.prediction.model)
        H = self.lead
        limit = np.full((H, 1), TORQUE)
        free = np.full((H, 1), np.inf)
        gains = np.tile(-BRAKE * np.eye(4)[1 + 2 * self.joint], (1, H, 1, 1))
        self._brake = Feedback(
            np.zeros((1, H, 4)),
            np.zeros((1, H, 1)),
            gains,
            -limit,
            limit,
            -free,
            free,
            np.zeros(1),
        )

    def torques(self, x: Any, t: float) -> Array:
        """Returns the torques of both joints (2,) at a state and a time [s]."""
        state = state_of(x)
        if abs(t - self._last) > 1.5 * INPUT:
            self._flight = self._decided = self._found = None
            self._count = self._turn = 0
        self._last = t
        now = self._count
        if self._decided is not None and now >= self._decided.known:
            if self._decided.value > REPLAN:
                self._flight = None
                self._turn = 0
            else:
                self._flight = self._decided
            self._decided = None
        if self._found is not None and now >= self._found.known:
            flown = (
                REPLAN
                if self._flight is None
                else self._value(self._flight, self._found.start) - PLAN
            )
            if self._found.value < flown:
                self._flight = self._found
                self._decided = None
            self._found = None
        begin = process_time()
        torque = -BRAKE * float(state[1 + 2 * self.joint])
        if self._flight is not None:
            torque = self._flight.loop.input_between(
                state, (now - self._flight.start) / TICKS
            )[0]
        self.between.append(process_time() - begin)
        if now % TICKS == 0:
            self._think(state, now)
        self._count += 1
        out = np.zeros(2)
        out[self.joint] = np.clip(torque, -TORQUE, TORQUE)
        return out

    def _think(self, state: Array, now: int) -> None:
        """Lets both cores begin what they are free for.

        A decision, and a search where the flight is not good.
        """
        flight = self._flight
        if flight is not None and self._decided is None and now > flight.start:
            self._decided = self._decide(state, now, flight)
        if self._found is None and (
            flight is None or (flight.value > GOOD and self._turn < len(self.search))
        ):
            self._found = self._search(state, now, flight)

    def _value(self, flight: Flight, start: int) -> float:
        """The criterion of what is left of a flight from a time on."""
        means = flight.plan.means[
            min(max(0, start - flight.start) // TICKS, len(flight.plan.means) - 2) :
        ]
        return self.criterion(replace(flight.plan, means=means), upright(means))

    def _search(self, state: Array, now: int, flight: Flight | None) -> Flight:
        """Returns the best plan of as many starts as the time allows.

        They begin where the pendulum will be then.
        """
        begin = process_time()
        if flight is None:
            expected = self._roll_out(state[None], self._brake)[0][0, -1]
        else:
            means = flight.plan.means
            expected = means[
                min((now - flight.start) // TICKS + self.lead, len(means) - 1)
            ]
        expected = expected if np.isfinite(expected).all() else state
        start = Gaussian.certain(expected), Reference(np.zeros(4))
        best = None
        lowest = inf
        first = self._turn % len(self.search)
        for plan, value in self.search.plans(*start, first=first):
            self._turn += 1
            if best is None or value < lowest:
                best = plan
                lowest = value
            if lowest <= GOOD or process_time() - begin > self.share * self.lead * PLAN:
                break
        assert best is not None
        found = self._timed(best, begin, now, now + self.lead * TICKS, self.searched)
        return (
            found if found.known == found.start else found._replace(value=inf)
        )  # too late to begin with

    def _decide(self, state: Array, now: int, flight: Flight) -> Flight:
        begin = process_time()
        passed = (now - flight.start) // TICKS
        inputs, states = (
            _later(part, passed) for part in (flight.plan.inputs, flight.plan.means)
        )
        previous = flight.plan if passed == 1 else None
        plan = self.step.control(
            Gaussian.certain(state), upright(states), previous, None, (inputs, states)
        )
        return self._timed(plan, begin, now, now, self.seconds)

    def _timed(
        self, plan: Decision, begin: float, now: int, start: int, times: list[float]
    ) -> Flight:
        """The flight of a plan whose making began at a processor time.

        Its value is infinite where it is of no use.
        """
        loop = ControlLoop(self.step)
        value = inf
        if plan.applicable:
            loop.last = Command(plan.input, plan.status, plan, plan)
            loop.input_between(plan.means[0], 0.0)  # its gains
            value = self.criterion(plan, upright(plan.means))
        times.append(process_time() - begin)
        done = now + max(1, ceil(times[-1] / INPUT))
        return Flight(
            loop, plan, value, start, max(start, done) if value < inf else done
        )


def real_time_pilot(parts: Parts, joint: int) -> RealTimePilot:
    """Makes a real-time pilot from parts."""
    search = ManyStarts(
        parts.planner, parts.planner, parts.guesses, (2, 3), parts.criterion
    )
    real_time = RealTimePilot(parts.controller, search, parts.criterion, joint)
    for k in range(
        (real_time.lead + 4) * TICKS
    ):  # compiles everything before the clock counts
        real_time.torques(np.array([np.pi, 0.2, 0.0, 0.0]), INPUT * k)
    return RealTimePilot(parts.controller, search, parts.criterion, joint)


def _later(part: Array, stages: int) -> Array:
    """Inputs or states from a later stage on, the last one repeated."""
    stages = min(stages, len(part) - 1)
    return np.concatenate([part[stages:], np.repeat(part[-1:], stages, axis=0)])
