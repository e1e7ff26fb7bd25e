"""Problem: what a control step costs over the size of the GPs, the horizon and the state's dimension.

A cell is one n, N and H. A flight of the pendulums records questions, the beliefs and references of its steps; every
controller answers them in turns, warm-started from its own last answer, as in a loop. ``model``, ``build`` and
``solve`` are the medians of the decisions' own accounts (wall time); all other figures are processor time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import chain, cycle, product

import numpy as np
import torch

from gpmpc.bench.groups import Group
from gpmpc.bench.pendulums import pendulum_gp, pendulum_plant, pendulum_references
from gpmpc.bench.timing import Times, take_turns
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.mpc.controller import Controller, Decision, Reference, Timing
from gpmpc.mpc.convex_mpc import ConvexMPC
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.propagation import Linearization, MomentMatching, differentiate
from gpmpc.simulation import closed_loop
from gpmpc.status import Status

QUESTIONS = 40  # steps of the recorded flight
STD = 0.01  # [rad, rad/s] of the beliefs: a full covariance is propagated, as with an estimator in the loop
CACHES = ("hot", "flushed")


@dataclass(frozen=True)
class Grid:
    """Which cells are measured.

    Attributes:
        states: n; even.
        sizes: N.
        horizons: H.
        caches: Among ``"hot"`` and ``"flushed"``.
        seconds: Processor time a cell [s]; every controller answers ten times at least.
        seed: Of the GPs' data.

    Raises:
        SettingError: A list is empty, or one of its entries is out of range.
    """

    states: Sequence[int]
    sizes: Sequence[int]
    horizons: Sequence[int]
    caches: Sequence[str] = CACHES
    seconds: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("states", "sizes", "horizons", "caches"):
            if not isinstance(getattr(self, name), list | tuple) or not getattr(self, name):
                raise SettingError(name, f"must be a list with something in it; got {getattr(self, name)!r}")
        for n in self.states:
            check_number("states", n, least=2, whole=True)
            if n % 2:
                raise SettingError("states", f"a pendulum has two states, so n is even; got {n}")
        for name, least in (("sizes", 2), ("horizons", 1)):
            for value in getattr(self, name):
                check_number(name, value, least=least, whole=True)
        for cache in self.caches:
            if cache not in CACHES:
                raise SettingError("caches", f"must be among {', '.join(CACHES)}; got {cache!r}")
        check_number("seconds", self.seconds, above=0, unit="[s]")
        check_number("seed", self.seed, least=0, whole=True)

    def groups(self) -> list[Group]:
        """For every n, N and cache one of the GPs alone, and one for every horizon."""
        model = lru_cache(maxsize=1)(pendulum_gp)  # large ones are not kept until all are measured

        def alone(n: int, size: int, cache: str) -> list[dict]:
            return _linearisations(model(n, size, self.seed), cache, self)

        def stepping(n: int, size: int, cache: str, horizon: int) -> list[dict]:
            return _whole_steps(model(n, size, self.seed), horizon, cache, self)

        found = []
        states, sizes, caches, horizons = map(dict.fromkeys, (self.states, self.sizes, self.caches, self.horizons))
        for cell in product(states, sizes, caches):
            name = "n={} N={} {}".format(*cell)
            found.append(Group(f"{name} GPs alone", partial(alone, *cell)))
            found += [Group(f"{name} H={horizon}", partial(stepping, *cell, horizon)) for horizon in horizons]
        return found

    def rows(self, records: Sequence[list[dict]]) -> list[dict]:
        """Those of every group that is measured."""
        return list(chain.from_iterable(records))


def controllers(gp: GPPosterior, horizon: int) -> dict[str, Controller]:
    """The convex controllers that are compared, by name."""
    m = gp.state_dim // 2
    problem = TrackingProblem([10.0, 1.0] * m, [0.1] * m, input_lower=[-6.0] * m, input_upper=[6.0] * m)
    asked = (problem, horizon, [0.0] * m)
    return {
        "paper's form": ConvexMPC(gp, MomentMatching(), *asked, form="increment", covariance="full"),
        "zero order": ConvexMPC(gp, Linearization(), *asked),
        "mean only": ConvexMPC(gp, Linearization(), *asked, covariance="none"),
    }


@dataclass
class Answering:
    """Puts recorded questions to a controller, one a call, in an endless round.

    Attributes:
        controller: Who answers.
        questions: What is asked.
        kept: Status and timing of every answer so far.
    """

    controller: Controller
    questions: Sequence[tuple[Gaussian, Reference]]
    kept: list[tuple[Status, Timing]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._round, self._last = cycle(self.questions), None

    def __call__(self) -> Decision:
        """The next answer, warm-started from the last one."""
        self._last = self.controller.control(*next(self._round), self._last)
        self.kept.append((self._last.status, self._last.timing))
        return self._last


def recorded_questions(gp: GPPosterior, controller: Controller, steps: int) -> list[tuple[Gaussian, Reference]]:
    """The beliefs and references of a flight of the pendulums under a controller."""
    n, questions = gp.state_dim, []

    class Recording:
        horizon, problem = controller.horizon, controller.problem

        def control(self, belief, reference, previous=None):
            belief = Gaussian(belief.mean, STD**2 * torch.eye(n, dtype=torch.float64))
            questions.append((belief, reference))
            return controller.control(belief, reference, previous)

    references = pendulum_references(n, steps + controller.horizon + 1)
    closed_loop(pendulum_plant(n), Recording(), references, references[0], steps, on_failure="previous_plan")
    return questions


def _linearisations(gp: GPPosterior, cache: str, grid: Grid) -> list[dict]:
    """The GPs alone: the mean, the EKF's terms, exact moments, each with all derivatives."""
    n, exact = gp.state_dim, MomentMatching()
    references = torch.from_numpy(pendulum_references(n, QUESTIONS))
    covariance, input = STD**2 * torch.eye(n, dtype=torch.float64), torch.zeros(n // 2, dtype=torch.float64)

    def asking(answer: Callable[[Gaussian], object]) -> Callable[[], object]:
        beliefs = cycle([Gaussian(mean, covariance) for mean in references])
        return lambda: answer(next(beliefs))

    contenders = {
        "mean": asking(lambda belief: gp.mean_with_jacobian(belief.mean, input)),
        "mean and variance": asking(lambda belief: gp.predict_with_jacobian(belief.mean, input)),
        "exact moments": asking(lambda belief: exact(gp, belief, input)),
        "exact moments, all Jacobians": asking(lambda belief: differentiate(exact, gp, belief, input)),
    }
    times = take_turns(contenders, grid.seconds, least=10, flushed=cache == "flushed")
    return [_row("linearisation", gp, None, cache, name, taken) for name, taken in times.items()]


def _whole_steps(gp: GPPosterior, horizon: int, cache: str, grid: Grid) -> list[dict]:
    """The controllers, from a belief to an input."""
    contenders = controllers(gp, horizon)
    questions = recorded_questions(gp, contenders["mean only"], QUESTIONS)
    answering = {name: Answering(controller, questions) for name, controller in contenders.items()}
    times = take_turns(answering, grid.seconds, least=10, flushed=cache == "flushed")
    rows = []
    for name, taken in times.items():
        kept = answering[name].kept[-len(taken.seconds) :]
        parts = {part: [getattr(timing, part) for _, timing in kept] for part in ("model", "build", "solve")}
        row = _row("step", gp, horizon, cache, name, taken)
        row |= {part: 1e3 * float(np.median(values)) for part, values in parts.items()}
        rows.append(row | {"unsolved": sum(not status.solved for status, _ in kept)})
    return rows


def _row(part: str, gp: GPPosterior, horizon: int | None, cache: str, name: str, times: Times) -> dict:
    sizes = {"n": gp.state_dim, "m": gp.state_dim // 2, "N": len(gp), "H": horizon}
    return {"part": part, "what": name, **sizes, "cache": cache, **times.summary()}
