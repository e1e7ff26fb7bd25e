"""Closed-loop cost over the time of a decision: ``gpmpc quality``.

Every controller and propagation of the package flies the same flights: the quadrotor's
translational subsystem, the plant in the loop, the same seeds of its noise. A case is
named by what is typed after ``gpmpc run``. The cost is the stage cost that all of them
minimise, summed along the true flight,

    1/K  sum_{k=1..K} |x_k - r_k|^2_Q + sum_{k=0..K-1} |u_k - u_{k-1}|^2_R

divided by that of NMPC on the true model with the longest horizon. Nothing bounds a
state here, so what covariances buy does not show; what they take does. Cases take
turns, flight by flight. A decision's time is the processor time of its thread;
compiling and loading come before.
"""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gpmpc.exceptions import SettingError, check_number
from gpmpc.experiments.quality_figure import front_figure
from gpmpc.gaussian import Gaussian
from gpmpc.metrics import tracking_cost, tracking_error
from gpmpc.mpc import Controller, Decision, Reference
from gpmpc.plotting import png
from gpmpc.simulation import Rollout
from gpmpc.studies._document import MISSING, Document, Table, number
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.studies.study import (
    LostFlight,
    TrialSpec,
    fingerprint,
    is_failed,
    read_model,
    trained_model,
)
from gpmpc.trajectories import Trajectory

#: [m] from the reference, some hundred times what is usual: no costs to compare
LOST = 5.0
#: difference of two costs below which the seeds' noise hides it: it buys no time
SAME = 1e-3
LEGEND = (
    "cost: of the states and of the inputs' increments, over that of NMPC on the true "
    "model at the longest horizon, geometric mean over the trajectories. ms: processor "
    "time of a decision. front: no other controller on a learned model is as good, to "
    "0.1 %, in less time, or better in the same."
)


class Family(NamedTuple):
    """A choice of settings, flown at many horizons.

    Attributes:
        name: Kind of controller, for the reader.
        words: Settings that choose it, typed after ``gpmpc run``.
    """

    name: str
    words: str


TRUTH = Family("NMPC, true model", "controller=nmpc")
INCREMENTS = "increments (paper)"
STATES = "state form, Clarabel"
MEAN = "trajectory, mean only"
ZERO_ORDER = "trajectory, zero order"
SPREAD = "trajectory, diagonal or full"
CONVERGED = "trajectory, converged"
NONLINEAR = "nonlinear GP-MPC"
CONVEX = "controller=convex"
FULL = "controller.prediction.covariance=full"
DIAGONAL = "controller.prediction.covariance=diagonal"
NONE = "controller.prediction.covariance=none"
EXACT = "propagation=moment_matching"
POINTS = "propagation=unscented"
MORE = "controller.iterations=100 controller.tolerance=1e-6"
FIRST_ORDER = "propagation=linearization"
_FAILED = "failed: "  # before why a flight failed that was not lost
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


class Condition(NamedTuple):
    """A flight, and the file of the trained GPs; None where none are needed."""

    experiment: Experiment
    model: Path | None


@dataclass(frozen=True)
class Quality:
    """The flights of all cases.

    Attributes:
        experiments: Flights that the words of each family choose.
        trajectories: By name.
        settings: Of the flights and of the training, as plain data for the fingerprint.
        horizons: H of every family.
        steps: Of a flight.
        seeds: Of the noise: flights on each trajectory.
        workers: Processes; more than one disturb each other's times.

    Raises:
        SettingError: A number out of range, no trajectory, or no case.
    """

    experiments: Mapping[Family, Experiment]
    trajectories: Mapping[str, Trajectory]
    settings: Any
    horizons: Sequence[int] = (1, 5, 10, 20)
    steps: int = 50
    seeds: int = 3
    workers: int | None = 1

    name = "quality"
    trial_name = "flights"
    lost_is_result = True

    def __post_init__(self) -> None:
        if not isinstance(self.horizons, list | tuple) or not self.horizons:
            raise SettingError(
                "horizons",
                f"must be a list with something in it; got {self.horizons!r}",
            )
        for horizon in self.horizons:
            check_number("horizons", horizon, least=1, whole=True)
        check_number("steps", self.steps, least=1, whole=True)
        check_number("seeds", self.seeds, least=1, whole=True)
        if self.workers is not None:
            check_number("workers", self.workers, least=1, whole=True)
        if not self.trajectories:
            raise SettingError("trajectory", "choose at least one")
        if not self.experiments:
            raise SettingError("families", "choose at least one")

    @property
    def cases(self) -> list[tuple[Family, int]]:
        """Families and horizons, the reference of all costs first."""
        horizons = sorted(set(self.horizons))
        cases = [(TRUTH, horizons[-1])]
        for family in self.experiments:
            cases += [(family, horizon) for horizon in horizons]
        return list(dict.fromkeys(cases))

    def trials(self, folder: Path) -> list[TrialSpec]:
        """Returns every flight; cases take turns.

        GPs are trained once a trajectory and kept in ``folder``.
        """
        models = self._trained_models(folder)
        return [
            self._trial(family, horizon, trajectory, models.get(trajectory), seed)
            for seed, trajectory, (family, horizon) in product(
                range(self.seeds), self.trajectories, self.cases
            )
        ]

    def _trained_models(self, folder: Path) -> dict[str, Path]:
        """Returns the files of the GPs that learned on each trajectory.

        All families learn the same ones.
        """
        learning = [e for e in self.experiments.values() if e.learns]
        if not learning:
            return {}
        models = {}
        for name, trajectory in self.trajectories.items():
            experiment = replace(learning[0], trajectory=trajectory, name=name, seed=0)
            rows = experiment.training_rows()
            models[name] = trained_model(
                experiment.learn, self.settings, rows, 0, folder
            )
        return models

    def _trial(
        self,
        family: Family,
        horizon: int,
        trajectory_name: str,
        model: Path | None,
        seed: int,
    ) -> TrialSpec:
        """Returns one flight of a case; ``model`` is what learning controllers know."""
        experiment = self.experiments[family]
        trajectory = self.trajectories[trajectory_name]
        make_controller = experiment.controller
        controller: Callable[..., TimedController] = TimedOnModel(
            make_controller, horizon
        )
        if not experiment.learns:
            controller = TimedOnPlant(make_controller, horizon)
            model = None
        flight = replace(
            experiment,
            controller=controller,
            trajectory=trajectory,
            name=trajectory_name,
            seed=seed,
            steps=self.steps,
        )
        labels = {
            "family": family.name,
            "what": family.words,
            "H": horizon,
            "trajectory": trajectory_name,
        }
        settings = [
            labels,
            self.settings,
            repr(trajectory),
            seed,
            self.steps,
            None
            if model is None
            else model.name,  # names the rows that it learned from
        ]
        return TrialSpec(
            labels=labels,
            condition=Condition(flight, model),
            seed=seed,
            fingerprint=fingerprint(settings),
        )

    @staticmethod
    def run_trial(trial: TrialSpec) -> dict:
        """Flies one trial.

        Raises:
            LostFlight: The vehicle has left its path.
        """
        experiment, file = trial.condition
        model = None if file is None else read_model(file)
        flight = run_trial(replace(experiment, model=model))
        rollout = flight.rollout
        controller = flight.controller
        axes = experiment.system.tracked_indices
        _check_on_path(rollout, axes)
        cost = controller.problem.cost
        error = tracking_error(rollout.states, rollout.references, axes)
        return {
            "cost": tracking_cost(
                Q=cost.Q,
                R=cost.R,
                states=rollout.states,
                references=rollout.references,
                inputs=rollout.inputs,
                previous_input=controller.initial_input,
            ),
            "rmse": float(error.total),
            "seconds": controller.seconds[-len(rollout.inputs) :],
            "failed": len(rollout.failures),
        }

    def rows(self, records: Sequence[dict]) -> list[dict]:
        """Returns the cost and the times of every case.

        A row holds ``median`` and ``p99`` of a decision [ms]; ``cost``, the geometric
        mean over the trajectories of its ratio to NMPC's on the same flights, and
        ``cost ...`` by trajectory; ``rmse ...`` [m]; how many solves ``failed``;
        ``front``. A case that lost a flight has none of these numbers, and ``lost``
        says how.
        """
        flights: dict[tuple[str, int], dict[str, list[dict]]] = {}
        for record in records:
            case = flights.setdefault((record["what"], record["H"]), {})
            case.setdefault(record["trajectory"], []).append(record)
        truth = flights[TRUTH.words, max(self.horizons)]
        rows = [
            _row(family, horizon, flights[family.words, horizon], truth)
            for family, horizon in self.cases
            if family in self.experiments
        ]
        candidates = [
            row for row in rows if row["lost"] is None and row["family"] != TRUTH.name
        ]
        members = pareto_front(
            times=[row["median"] for row in candidates],
            costs=[row["cost"] for row in candidates],
            least=SAME,
        )
        for row, member in zip(candidates, members, strict=True):
            row["front"] = member
        return rows

    def summary(self, records: Sequence[dict]) -> tuple[list[Table], list[str]]:
        """Returns the table for a terminal, and the note below it."""
        return [_table(self.rows(records))], [LEGEND]

    def document(self, records: Sequence[dict]) -> Document:
        """Returns the table and the figure."""
        rows = self.rows(records)
        losses = [
            f"{row['what']} horizon={row['H']}: {row['lost']}"
            for row in rows
            if row["lost"]
        ]
        return Document(
            title="Quality over time",
            tables=[_table(rows)],
            data=pd.DataFrame(rows, dtype=object),
            notes=[LEGEND],
            lists={"Lost": losses},
            images={"quality.png": png(front_figure(rows), dpi=130)},
        )


def from_settings(
    objects: Mapping[str, Any],
    settings: Mapping[str, Any],
    flight: Callable[[str], tuple[Experiment, Any]],
) -> Quality:
    """Makes the flights that ``conf/quality.yaml`` describes.

    Args:
        objects: The settings, with objects in the place of what names a class.
        settings: The same as plain data.
        flight: From what is typed after ``gpmpc run`` to the flight and its settings.
    """
    deviations = ",".join([str(settings["noise"])] * 6)
    only = settings["only"]
    experiments = {}
    plain_settings = {}
    for family in FAMILIES:
        if family is TRUTH or only is None or str(only) in family.words:
            experiment, plain = flight(f"{family.words} noise.process=[{deviations}]")
            experiments[family] = experiment
            plain_settings[family.words] = plain
    return Quality(
        experiments=experiments,
        trajectories=objects["trajectory"],
        settings=plain_settings,
        horizons=settings["horizons"],
        steps=settings["steps"],
        seeds=settings["seeds"],
        workers=settings["workers"],
    )


class TimedController:
    """A controller whose decisions are timed.

    ``seconds`` are those of its thread's processor time, decision by decision.
    """

    def __init__(self, controller: Controller):
        self._controller = controller
        self.seconds: list[float] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Decides as the controller does."""
        start = time.thread_time_ns()
        decision = self._controller.control(belief, reference, previous)
        self.seconds.append(1e-9 * (time.thread_time_ns() - start))
        return decision


@dataclass(frozen=True)
class TimedOnModel:
    """Makes a controller on a learned model at another horizon, timed."""

    make: Callable[..., Controller]
    horizon: int

    def __call__(self, model: Any) -> TimedController:
        """Makes the controller."""
        return TimedController(self.make(model, horizon=self.horizon))


@dataclass(frozen=True)
class TimedOnPlant:
    """Makes a controller on the true model at another horizon, timed.

    ``Experiment`` hands the plant to what calls its first argument so.
    """

    make: Callable[..., Controller]
    horizon: int

    def __call__(self, plant: Any) -> TimedController:
        """Makes the controller."""
        return TimedController(self.make(plant, horizon=self.horizon))


def _check_on_path(rollout: Rollout, axes: Sequence[int]) -> None:
    """Raises ``LostFlight`` if a vehicle was farther off its path than ``LOST``."""
    errors = (rollout.states - rollout.references)[:, axes]
    near = np.linalg.norm(errors, axis=1) <= LOST  # not where it is NaN
    if not near.all():
        step = int(np.argmax(~near))
        raise LostFlight(f"{LOST:g} m off its path after {step} steps")


def pareto_front(
    times: Sequence[float], costs: Sequence[float], least: float = 0.0
) -> list[bool]:
    """Returns which cases are not dominated.

    No other case is at least as good in time and cost and better in one of them.

    Args:
        times: Less is better.
        costs: Less is better.
        least: Amount by which a case that takes more time has to cost less.
    """
    order = sorted(range(len(times)), key=lambda i: (times[i], costs[i]))
    members = [False] * len(order)
    best_cost = math.inf
    best_time = math.nan
    for i in order:
        if costs[i] < best_cost - least:
            members[i] = True
            best_cost = costs[i]
            best_time = times[i]
        elif (times[i], costs[i]) == (best_time, best_cost):  # not told apart
            members[i] = True
    return members


def _row(
    family: Family,
    horizon: int,
    flights: Mapping[str, list[dict]],
    truth: Mapping[str, list[dict]],
) -> dict:
    """Returns the row of a case, from records by trajectory."""
    records = _pooled(flights)
    reason = _first_error(records)
    if reason is None:
        error = _first_error(_pooled(truth))
        if error is not None:
            reason = f"nothing to compare with: NMPC on the true model, {error}"
    row = {
        "family": family.name,
        "what": family.words,
        "H": horizon,
        "lost": reason,
        "front": False,
        "flights": sum("error" not in record for record in records),
    }
    if reason is not None:
        return row
    seconds = [second for record in records for second in record["seconds"]]
    costs = _cost_ratios(flights, truth)
    row["median"] = 1e3 * float(np.median(seconds))
    row["p99"] = 1e3 * float(np.quantile(seconds, 0.99))
    row["cost"] = float(np.exp(np.mean(np.log(list(costs.values())))))
    for trajectory, cost in costs.items():
        row[f"cost {trajectory}"] = cost
    for trajectory, group in flights.items():
        squares = [record["rmse"] ** 2 for record in group]
        row[f"rmse {trajectory}"] = float(np.sqrt(np.mean(squares)))
    row["failed"] = sum(record["failed"] for record in records)
    row["samples"] = len(seconds)
    return row


def _pooled(flights: Mapping[str, list[dict]]) -> list[dict]:
    return [record for group in flights.values() for record in group]


def _first_error(records: Iterable[Mapping[str, Any]]) -> str | None:
    """Says which flight was the first that failed or was lost, and how, or None."""
    for record in records:
        if "error" in record:
            text = f"{record['trajectory']}, seed {record['seed']}: {record['error']}"
            return f"{_FAILED}{text}" if is_failed(record) else text
    return None


def _cost_ratios(
    flights: Mapping[str, list[dict]], truth: Mapping[str, list[dict]]
) -> dict[str, float]:
    """Returns the cost of a case over that of NMPC on the true model, by trajectory."""
    ratios = {}
    for trajectory, group in flights.items():
        cost = sum(record["cost"] for record in group)
        least_cost = sum(record["cost"] for record in truth[trajectory])
        ratios[trajectory] = float(cost / least_cost)
    return ratios


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    lines = []
    for row in rows:
        if row["lost"] is None:
            cells = [
                f"{row['cost']:.4f}",
                number(row["median"]),
                number(row["p99"]),
                str(row["failed"]),
            ]
        else:
            word = "failed" if _FAILED in row["lost"] else "lost"
            cells = [word, MISSING, MISSING, MISSING]
        mark = "●" if row["front"] else ""
        lines.append([row["what"], str(row["H"]), *cells, mark])
    header = ["gpmpc run", "H", "cost", "ms: median", "99 %", "failed", "front"]
    return Table(header, lines, "Quality over time")
