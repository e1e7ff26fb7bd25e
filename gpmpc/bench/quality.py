"""Problem: which controller gives the best flight for the time at hand? Cost over time, for all of them at once.

Every contender flies the same flights: the quadrotor's translational subsystem, the plant in the loop, the same seeds
of its noise. What is paid is the stage cost that all of them were told to make small, summed along the true flight,

    1/K  sum_{k=1..K} |x_k - r_k|^2_Q + sum_{k=0..K-1} |u_k - u_{k-1}|^2_R

and it is divided, flights by flights, by what NMPC on the true model pays with the longest horizon: 1 is what knowing
the truth and having all the time in the world buys. Nothing bounds a state here, so what covariances are for, keeping
away from bounds, does not show; what they take does.

Contenders take turns, flight by flight. A decision's time is the processor time of its thread; what is compiled or
loaded at a first call is spent before.
"""

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain, product

import numpy as np

from gpmpc.bench.contenders import TRUTH, Contender
from gpmpc.bench.groups import Group
from gpmpc.bench.quadrotor import HOVER, NOISE, OUTER, TRAJECTORIES, problem, trained
from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.metrics import tracking_error
from gpmpc.mpc.controller import Controller, Decision, Reference
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.simulation import Rollout, closed_loop, rehearse
from gpmpc.trajectories import states_along

LOST = 5.0  # [m] from the reference, some hundred times what is usual: nothing to compare costs with
SAME = 1e-3  # difference of two costs below which the seeds' noise hides it: it buys no time


@dataclass(frozen=True)
class Field:
    """Who flies, and how often.

    Attributes:
        contenders: In any order.
        steps: Of a flight.
        seeds: Of the noise: flights on each trajectory.
        trajectories: Of ``gpmpc.bench.quadrotor.TRAJECTORIES``.

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

    def groups(self, models: Mapping[str, GPPosterior] | None = None) -> list[Group]:
        """A flight each; ``lost`` says why one has no result.

        Args:
            models: What was learned, by trajectory; by default GPs of 189 transitions of a dithered flight.
        """
        model = cache(trained) if models is None else models.__getitem__
        controller = cache(lambda trajectory, contender: contender.controller(model(trajectory)))

        def flown(seed: int, trajectory: str, contender: Contender) -> dict:
            try:
                return _paid(*_flight(controller(trajectory, contender), trajectory, self.steps, seed))
            except GpmpcError as error:
                return {"lost": f"{trajectory}, seed {seed}: {error}"}

        return [
            Group(f"{name} seed {seed} H={who.horizon} {who.words}", partial(flown, seed, name, who))
            for seed, name, who in self._flights
        ]

    def rows(self, records: Sequence[dict]) -> list[dict]:
        """What each contender paid, in cost and in time; nothing before all have flown all flights.

        Returns:
            A row for every contender: ``what`` is typed after ``gpmpc run``, with ``horizon=H``; ``median`` and ``p99``
            of a decision [ms]; ``cost`` is the geometric mean over the trajectories of its ratio to NMPC's on the same
            flights, ``cost ...`` by trajectory; ``rmse ...`` [m]; ``failed`` counts solves; ``front`` says whether no
            other controller on a learned model is as good, to 0.1 %, in less time or better in the same. Who lost a
            flight has none of these numbers, and ``lost`` says how.
        """
        flights = self._flights
        if len(records) < len(flights):
            return []
        flown: dict[Contender, dict[str, list[dict]]] = defaultdict(lambda: defaultdict(list))
        for (_, trajectory, contender), record in zip(flights, records, strict=True):
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
