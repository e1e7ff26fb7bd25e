"""Closed-loop cost over the time of a decision, for every controller and propagation of the package.

    .venv/bin/python -m benchmarks.quality [--steps 50] [--seeds 3]

Every contender flies the same flights: the quadrotor's translational subsystem, the plant in the loop, the same seeds
of its noise. Its name is what is typed after ``gpmpc run``, and it is built from that name alone. The cost is the stage
cost that all of them minimise, summed along the true flight,

    1/K  sum_{k=1..K} |x_k - r_k|^2_Q + sum_{k=0..K-1} |u_k - u_{k-1}|^2_R

divided by that of NMPC on the true model with the longest horizon. Nothing bounds a state here, so what covariances buy
does not show; what they take does. Contenders take turns, flight by flight. A decision's time is the processor time of
its thread; compiling and loading come before. Writes ``outputs/benchmarks/quality.json`` and ``quality.png``.
"""

import argparse
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain, product
from typing import Any, NamedTuple

import numpy as np

from benchmarks.quadrotor import HOVER, NOISE, OUTER, TRAJECTORIES, problem, trained
from benchmarks.timing import RESULTS, markdown_table, use_one_thread, write_results
from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.metrics import tracking_error
from gpmpc.mpc.controller import Controller, Decision, Reference
from gpmpc.mpc.gp_mpc import GPMPC, NonlinearGPMPC
from gpmpc.mpc.lqr import LQR
from gpmpc.mpc.nmpc import NMPC
from gpmpc.mpc.problem import TrackingProblem
from gpmpc.mpc.state_form import StateFormMPC
from gpmpc.plotting import png, quality
from gpmpc.propagation import Linearization, MeanEquivalence, MomentMatching, Unscented
from gpmpc.simulation import Rollout, closed_loop, rehearse
from gpmpc.trajectories import states_along

LOST = 5.0  # [m] from the reference, some hundred times what is usual: nothing to compare costs with
SAME = 1e-3  # difference of two costs below which the seeds' noise hides it: it buys no time
HORIZONS = (1, 5, 10, 20)
PROPAGATIONS = {
    "mean_equivalence": MeanEquivalence(),
    "linearization": Linearization(),
    "moment_matching": MomentMatching(),
    "unscented": Unscented(),
}
CONTROLLERS = {  # by their names in conf/controller: class, propagation, and what else is set there
    "convex": (GPMPC, "linearization", {}),
    "paper": (GPMPC, "moment_matching", {"form": "velocity", "covariance": "full"}),
    "state_form": (StateFormMPC, "linearization", {}),
    "nonlinear": (NonlinearGPMPC, "moment_matching", {}),
    "lqr": (LQR, None, {}),
    "nmpc": (NMPC, None, {}),
}


def main() -> None:
    """Flies, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=50, help="of a flight")
    parser.add_argument("--seeds", type=int, default=3, help="flights on each trajectory")
    arguments = parser.parse_args()
    use_one_thread()
    field = Field(contenders(), arguments.steps, arguments.seeds)
    rows = field.rows(list(field.fly()))
    header = ("what", "H", "median", "p99", "cost", "failed", "lost")
    print(markdown_table(header, [[row.get(key) for key in header] for row in rows]))
    write_results("quality", rows)
    (RESULTS / "quality.png").write_bytes(png(quality(rows), dpi=130))


class Family(NamedTuple):
    """One choice of settings, at many horizons.

    Attributes:
        name: Kind of controller, for the reader.
        words: What chooses it.
        longest: The longest horizon that is worth the time.
    """

    name: str
    words: str
    longest: float = math.inf


TRUTH = Family("NMPC, true model", "controller=nmpc")
INCREMENTS, STATES = "increments (paper)", "state form, Clarabel"
MEAN, ZERO_ORDER = "trajectory, mean only", "trajectory, zero order"
SPREAD, CONVERGED = "trajectory, diagonal or full", "trajectory, converged"
NONLINEAR = "nonlinear GP-MPC"
CONVEX, FULL, DIAGONAL = "controller=convex", "controller.covariance=full", "controller.covariance=diagonal"
NONE, EXACT, POINTS = "controller.covariance=none", "propagation=moment_matching", "propagation=unscented"
MORE = "controller.iterations=100 controller.tolerance=1e-6"
FIRST_ORDER = "propagation=linearization"
FAMILIES = (
    TRUTH,
    Family("LQR", "controller=lqr"),
    Family(INCREMENTS, "controller=paper"),
    Family(INCREMENTS, f"controller=paper {DIAGONAL}"),
    Family(INCREMENTS, f"controller=paper {NONE}"),
    Family(MEAN, f"{CONVEX} {NONE}"),
    Family(ZERO_ORDER, CONVEX),
    Family(ZERO_ORDER, f"{CONVEX} propagation=mean_equivalence"),
    Family(ZERO_ORDER, f"{CONVEX} {EXACT}"),
    Family(ZERO_ORDER, f"{CONVEX} {POINTS}"),
    Family(SPREAD, f"{CONVEX} {DIAGONAL}"),
    Family(SPREAD, f"{CONVEX} {DIAGONAL} {EXACT}"),
    Family(SPREAD, f"{CONVEX} {FULL}"),
    Family(SPREAD, f"{CONVEX} {FULL} {EXACT}"),
    Family(SPREAD, f"{CONVEX} {FULL} {POINTS}"),
    Family(CONVERGED, f"{CONVEX} {NONE} {MORE}"),
    Family(CONVERGED, f"{CONVEX} {MORE}"),
    Family(STATES, "controller=state_form"),
    Family(NONLINEAR, f"controller=nonlinear {FIRST_ORDER}"),
    Family(NONLINEAR, "controller=nonlinear"),
)


@dataclass(frozen=True)
class Contender:
    """A controller with its settings.

    Attributes:
        family: Kind of controller, for the reader.
        words: What is typed after ``gpmpc run`` to choose it, the horizon apart.
        horizon: H.
    """

    family: str
    words: str
    horizon: int

    def controller(self, model: GPPosterior) -> Controller:
        """The controller that the words mean, on a learned model, or for ``nmpc`` on the plant itself.

        Raises:
            SettingError: Words that mean none.
        """
        chosen = dict(word.split("=", 1) for word in self.words.split())
        name = chosen.pop("controller", None)
        if name not in CONTROLLERS:
            raise SettingError("controller", f"must be one of {', '.join(CONTROLLERS)}; got {name!r}")
        make, propagation, own = CONTROLLERS[name]
        propagation = chosen.pop("propagation", propagation)
        own = own | {key.removeprefix("controller."): _value(text) for key, text in chosen.items()}
        parts: list[Any] = [OUTER if make is NMPC else model]
        if propagation is not None:
            parts.append(PROPAGATIONS[propagation])
        return make(*parts, problem(), self.horizon, HOVER, **own)


def contenders(horizons: Sequence[int] = HORIZONS) -> list[Contender]:
    """Every controller and propagation of the package, at every horizon that is worth its time.

    Raises:
        SettingError: No horizon, or one that is none.
    """
    if not isinstance(horizons, list | tuple) or not horizons:
        raise SettingError("horizons", f"must be a list with something in it; got {horizons!r}")
    for horizon in horizons:
        check_number("horizons", horizon, least=1, whole=True)
    return [
        Contender(family.name, family.words, horizon)
        for family in FAMILIES
        for horizon in sorted(set(horizons))
        if horizon <= family.longest
    ]


def _value(text: str) -> str | int | float:
    """A setting's value as YAML would read it."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


@dataclass(frozen=True)
class Field:
    """Who flies, and how often.

    Attributes:
        contenders: In any order.
        steps: Of a flight.
        seeds: Of the noise: flights on each trajectory.
        trajectories: Of ``benchmarks.quadrotor.TRAJECTORIES``.

    Raises:
        SettingError: A number out of range, nobody, or an unknown trajectory.
    """

    contenders: Sequence[Contender]
    steps: int = 50
    seeds: int = 3
    trajectories: Sequence[str] = tuple(TRAJECTORIES)

    def __post_init__(self) -> None:
        if not self.contenders:
            raise SettingError("contenders", "there must be one")
        check_number("steps", self.steps, least=1, whole=True)
        check_number("seeds", self.seeds, least=1, whole=True)
        for name in self.trajectories:
            if name not in TRAJECTORIES:
                raise SettingError("trajectories", f"must be among {', '.join(TRAJECTORIES)}; got {name!r}")

    @property
    def truth(self) -> Contender:
        """NMPC on the true model at the longest horizon: what all others are divided by."""
        return Contender(TRUTH.name, TRUTH.words, max(contender.horizon for contender in self.contenders))

    @property
    def _flights(self) -> list[tuple[int, str, Contender]]:
        """Seed, trajectory and contender, in their order: contenders take turns."""
        everyone = list(dict.fromkeys([self.truth, *self.contenders]))
        return list(product(range(self.seeds), dict.fromkeys(self.trajectories), everyone))

    def fly(self, models: Mapping[str, GPPosterior] | None = None) -> Iterator[dict]:
        """Yields the record of every flight; ``lost`` says why one has no result.

        Args:
            models: What was learned, by trajectory; by default GPs of 189 transitions of a dithered flight.
        """
        model = cache(trained) if models is None else models.__getitem__
        controller = cache(lambda trajectory, contender: contender.controller(model(trajectory)))

        for seed, trajectory, contender in self._flights:
            try:
                yield _paid(*_flight(controller(trajectory, contender), trajectory, self.steps, seed))
            except GpmpcError as error:
                yield {"lost": f"{trajectory}, seed {seed}: {error}"}

    def rows(self, records: Sequence[dict]) -> list[dict]:
        """What each contender paid, in cost and in time.

        Returns:
            A row for every contender: ``what`` is typed after ``gpmpc run``, with ``horizon=H``; ``median`` and ``p99``
            of a decision [ms]; ``cost`` is the geometric mean over the trajectories of its ratio to NMPC's on the same
            flights, ``cost ...`` by trajectory; ``rmse ...`` [m]; ``failed`` counts solves; ``front`` says whether no
            other controller on a learned model is as good, to 0.1 %, in less time or better in the same. Who lost a
            flight has none of these numbers, and ``lost`` says how.
        """
        flown: dict[Contender, dict[str, list[dict]]] = defaultdict(lambda: defaultdict(list))
        for (_, trajectory, contender), record in zip(self._flights, records, strict=True):
            flown[contender][trajectory].append(record)
        rows = [_row(contender, flown[contender], flown[self.truth], self.steps) for contender in self.contenders]
        candidates = [row for row in rows if row["lost"] is None and row["family"] != TRUTH.name]
        members = pareto_front([row["median"] for row in candidates], [row["cost"] for row in candidates], SAME)
        for row, member in zip(candidates, members, strict=True):
            row["front"] = member
        return rows


def stage_cost(
    weights: TrackingProblem, states: np.ndarray, references: np.ndarray, inputs: np.ndarray, before: Sequence[float]
) -> float:
    """What a flight paid per step of the tracking cost on states and increments; see the module's text.

    Args:
        weights: Q and R.
        states: x_0 .. x_K (K + 1, n); the initial one costs nothing.
        references: r_0 .. r_K (K + 1, n).
        inputs: u_0 .. u_{K-1} (K, m).
        before: u_{-1} (m,).
    """
    errors, increments = states[1:] - references[1:], np.diff(inputs, axis=0, prepend=[before])
    paid = np.einsum("ki,ij,kj", errors, weights.Q, errors) + np.einsum("ki,ij,kj", increments, weights.R, increments)
    return float(paid / len(inputs))


def pareto_front(times: Sequence[float], costs: Sequence[float], least: float = 0.0) -> list[bool]:
    """Who is not dominated: nobody is at least as good in both and better in one.

    Args:
        times: Less is better.
        costs: Less is better.
        least: What takes more time has to cost less by more than this.
    """
    order = sorted(range(len(times)), key=lambda i: (times[i], costs[i]))
    members, best, at = [False] * len(order), np.inf, np.nan
    for i in order:
        if costs[i] < best - least:
            members[i], best, at = True, costs[i], times[i]
        elif (times[i], costs[i]) == (at, best):  # not told apart
            members[i] = True
    return members


def _paid(rollout: Rollout, seconds: Sequence[float]) -> dict:
    """What came of one flight.

    Raises:
        GpmpcError: The vehicle has left its path.
    """
    distance = np.linalg.norm((rollout.states - rollout.references)[:, ::2], axis=1)
    if distance.max() > LOST:
        raise GpmpcError(f"{LOST:g} m off its path after {int(np.argmax(distance > LOST))} steps")
    return {
        "cost": stage_cost(problem(), rollout.states, rollout.references, rollout.inputs, HOVER),
        "rmse": float(tracking_error(rollout.states, rollout.references).total),
        "seconds": list(seconds),
        "failed": len(rollout.failures),
    }


def _flight(controller: Controller, trajectory: str, steps: int, seed: int) -> tuple[Rollout, list[float]]:
    """One flight, and the processor time of each of its decisions [s]."""
    states = states_along(TRAJECTORIES[trajectory], OUTER.time_step * np.arange(steps + controller.horizon + 1))
    reference = Reference(states, np.tile(HOVER, (len(states) - 1, 1)))  # as gpmpc run hands it over
    clocked = _Clocked(controller)
    rehearse(OUTER, controller, reference, states[0])
    rollout = closed_loop(
        OUTER, clocked, reference, states[0], steps, noise=NOISE, seed=seed, on_failure="previous_plan"
    )
    return rollout, clocked.seconds


class _Clocked:
    """A controller whose decisions are timed."""

    def __init__(self, controller: Controller):
        self.horizon, self.problem, self._controller = controller.horizon, controller.problem, controller
        self.seconds: list[float] = []

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        began = time.thread_time_ns()
        decision = self._controller.control(belief, reference, previous)
        self.seconds.append(1e-9 * (time.thread_time_ns() - began))
        return decision


def _row(contender: Contender, flown: Mapping[str, list[dict]], truth: Mapping[str, list[dict]], steps: int) -> dict:
    """Of records by trajectory."""
    records = list(chain.from_iterable(flown.values()))
    lost, astray = (
        next((record["lost"] for record in chain.from_iterable(of.values()) if "lost" in record), None)
        for of in (flown, truth)
    )
    lost = lost or (astray and f"nothing to compare with: NMPC on the true model, {astray}")
    row = {"part": "quality", "family": contender.family, "what": contender.words, "H": contender.horizon}
    row |= {"flights": sum("lost" not in record for record in records), "steps": steps, "lost": lost, "front": False}
    if lost is not None:
        return row

    def paid(of: Sequence[dict]) -> float:
        return sum(record["cost"] for record in of)

    costs = {name: paid(of) / paid(truth[name]) for name, of in flown.items()}
    seconds = list(chain.from_iterable(record["seconds"] for record in records))
    row |= {"median": 1e3 * float(np.median(seconds)), "p99": 1e3 * float(np.quantile(seconds, 0.99))}
    row |= {"cost": float(np.exp(np.mean(np.log(list(costs.values())))))}
    row |= {f"cost {name}": float(ratio) for name, ratio in costs.items()}
    row |= {
        f"rmse {name}": float(np.sqrt(np.mean([record["rmse"] ** 2 for record in of]))) for name, of in flown.items()
    }
    return row | {"failed": sum(record["failed"] for record in records), "samples": len(seconds)}


if __name__ == "__main__":
    main()
