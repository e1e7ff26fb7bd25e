"""Closed-loop cost over the time of a decision, for every controller and propagation of the package: ``gpmpc quality``.

Every case flies the same flights: the quadrotor's translational subsystem, the plant in the loop, the same seeds of its
noise. Its name is what is typed after ``gpmpc run``. The cost is the stage cost that all of them minimise, summed along
the true flight,

    1/K  sum_{k=1..K} |x_k - r_k|^2_Q + sum_{k=0..K-1} |u_k - u_{k-1}|^2_R

divided by that of NMPC on the true model with the longest horizon. Nothing bounds a state here, so what covariances buy
does not show; what they take does. Cases take turns, flight by flight. A decision's time is the processor time of its
thread; compiling and loading come before.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.metrics import tracking_cost, tracking_error
from gpmpc.mpc import Controller, Decision, Reference
from gpmpc.plotting import png
from gpmpc.plotting._style import (
    BLACK,
    COLOURS,
    DASHED,
    make_figure,
    plain_numbers,
    styled,
)
from gpmpc.studies._document import MISSING, Document, Table, number
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.studies.study import TrialSpec, fingerprint, read_model, trained_model
from gpmpc.trajectories import Trajectory

LOST = 5.0  # [m] from the reference, some hundred times what is usual: nothing to compare costs with
SAME = 1e-3  # difference of two costs below which the seeds' noise hides it: it buys no time
CURVES = 5  # in the figure
MARKERS = ("o", "^", "s", "D", "v", "P", "X")
# greys
OTHERS = "0.75"
FRONT = "0.35"
TICKS = (-1, 0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # [%]
LINEAR = 1.0  # [%] of cost up to which the axis is linear
LEGEND = (
    "cost: of the states and of the inputs' increments, over that of NMPC on the true model at the longest horizon, "
    "geometric mean over the trajectories. ms: processor time of a decision. front: no other controller on a learned "
    "model is as good, to 0.1 %, in less time, or better in the same."
)


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
    """What a trial needs: its flight, and the file of the trained GPs; None where none are needed."""

    experiment: Experiment
    model: Path | None


@dataclass(frozen=True)
class Quality:
    """The flights of all cases.

    Attributes:
        experiments: By family: the flight that its words mean after ``gpmpc run``.
        trajectories: By name.
        settings: Of the flights and of the training, as plain data for the fingerprint.
        horizons: H of every family, up to its longest.
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
        check_number(
            "workers", 1 if self.workers is None else self.workers, least=1, whole=True
        )
        for key, chosen in (
            ("trajectory", self.trajectories),
            ("families", self.experiments),
        ):
            if not chosen:
                raise SettingError(key, "choose at least one")

    @property
    def cases(self) -> list[tuple[Family, int]]:
        """Families and horizons, the reference of all costs first."""
        horizons = sorted(set(self.horizons))
        found = [(f, H) for f in self.experiments for H in horizons if f.longest >= H]
        return list(dict.fromkeys([(TRUTH, horizons[-1]), *found]))

    def trials(self, folder: Path) -> list[TrialSpec]:
        """Returns every flight; cases take turns. GPs are trained once a trajectory and kept in ``folder``."""
        models = {}
        for name, trajectory in self.trajectories.items():
            learning = next((e for e in self.experiments.values() if e.learns), None)
            if learning is not None:
                learning = replace(learning, trajectory=trajectory, name=name, seed=0)
                models[name] = trained_model(
                    learning.learn, self.settings, learning.training_rows(), 0, folder
                )
        trials = []
        for seed, (name, trajectory), (family, horizon) in product(
            range(self.seeds), self.trajectories.items(), self.cases
        ):
            experiment = self.experiments[family]
            make = experiment.controller
            flown = replace(
                experiment,
                trajectory=trajectory,
                name=name,
                seed=seed,
                steps=self.steps,
            )
            flown = replace(
                flown,
                controller=At(make, horizon)
                if experiment.learns
                else AtPlant(make, horizon),
            )
            labels = {
                "family": family.name,
                "what": family.words,
                "H": horizon,
                "trajectory": name,
            }
            model = models[name] if experiment.learns else None
            condition = Condition(flown, model)
            named = fingerprint(
                [
                    labels,
                    self.settings,
                    repr(trajectory),
                    seed,
                    self.steps,
                    model and model.name,  # names the rows that it learned from
                ]
            )
            trials.append(TrialSpec(labels, condition, seed, named))
        return trials

    @staticmethod
    def run_trial(trial: TrialSpec) -> dict:
        """Flies one trial.

        Raises:
            GpmpcError: The vehicle has left its path.
        """
        experiment, model = trial.condition
        flown = run_trial(
            replace(experiment, model=None if model is None else read_model(model))
        )
        rollout = flown.rollout
        controller = flown.controller
        distance = np.linalg.norm(
            (rollout.states - rollout.references)[:, experiment.system.tracked_indices],
            axis=1,
        )
        if not distance.max() <= LOST:
            raise GpmpcError(
                f"{LOST:g} m off its path after {int(np.argmax(~(distance <= LOST)))} steps"
            )
        before = controller.initial_input
        return {
            "cost": tracking_cost(
                controller.problem.cost.Q,
                controller.problem.cost.R,
                rollout.states,
                rollout.references,
                rollout.inputs,
                before,
            ),
            "rmse": float(
                tracking_error(
                    rollout.states,
                    rollout.references,
                    experiment.system.tracked_indices,
                ).total
            ),
            "seconds": controller.seconds[-len(rollout.inputs) :],
            "failed": len(rollout.failures),
        }

    def rows(self, records: Sequence[dict]) -> list[dict]:
        """Returns the cost and the times of every case.

        A row holds ``median`` and ``p99`` of a decision [ms]; ``cost``, the geometric mean over the trajectories of its
        ratio to NMPC's on the same flights, and ``cost ...`` by trajectory; ``rmse ...`` [m]; how many solves
        ``failed``; ``front``. A case that lost a flight has none of these numbers, and ``lost`` says how.
        """
        flown: dict[tuple, dict[str, list[dict]]] = {}
        for record in records:
            case = flown.setdefault((record["what"], record["H"]), {})
            case.setdefault(record["trajectory"], []).append(record)
        truth = flown[TRUTH.words, max(self.horizons)]
        cases = [
            case
            for case in self.cases
            if case[0] in self.experiments and case[1] in self.horizons
        ]
        rows = [_row(family, H, flown[family.words, H], truth) for family, H in cases]
        candidates = [
            row for row in rows if row["lost"] is None and row["family"] != TRUTH.name
        ]
        members = pareto_front(
            [row["median"] for row in candidates],
            [row["cost"] for row in candidates],
            SAME,
        )
        for row, member in zip(candidates, members, strict=True):
            row["front"] = member
        return rows

    def summary(self, records: Sequence[dict]) -> tuple[list[Table], list[str]]:
        """Returns the table for a terminal."""
        return [_table(self.rows(records))], [LEGEND]

    def document(self, records: Sequence[dict]) -> Document:
        """Returns the table and the figure."""
        rows = self.rows(records)
        lost = [
            f"{row['what']} horizon={row['H']}: {row['lost']}"
            for row in rows
            if row["lost"]
        ]
        return Document(
            "Quality over time",
            [_table(rows)],
            pd.DataFrame(rows, dtype=object),
            notes=[LEGEND],
            lists={"Lost": lost},
            images={"quality.png": png(front_figure(rows), dpi=130)},
        )


def from_settings(
    made: Mapping[str, Any],
    settings: Mapping[str, Any],
    flight: Callable[[str], tuple[Experiment, Any]],
) -> Quality:
    """Makes the flights that ``conf/quality.yaml`` describes; arguments as in ``gpmpc.experiments.tables``.

    Args:
        made: See there.
        settings: See there.
        flight: From what is typed after ``gpmpc run`` to the flight and its settings.
    """
    noise = f"noise.process=[{','.join([str(settings['noise'])] * 6)}]"
    only = settings["only"]
    chosen = [
        family
        for family in FAMILIES
        if family is TRUTH or only is None or str(only) in family.words
    ]
    flown = {family: flight(f"{family.words} {noise}") for family in chosen}
    experiments = {family: experiment for family, (experiment, _) in flown.items()}
    numbers = {key: settings[key] for key in ("horizons", "steps", "seeds", "workers")}
    return Quality(
        experiments,
        made["trajectory"],
        {f.words: plain for f, (_, plain) in flown.items()},
        **numbers,
    )


class Clocked:
    """A controller whose decisions are timed, in seconds of its thread's processor time."""

    def __init__(self, controller: Controller):
        self._controller = controller
        self.seconds = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Decides as the controller does."""
        began = time.thread_time_ns()
        decision = self._controller.control(belief, reference, previous)
        self.seconds.append(1e-9 * (time.thread_time_ns() - began))
        return decision


class At(NamedTuple):
    """A controller on a learned model at another horizon, timed."""

    make: Any
    horizon: int

    def __call__(self, model: Any) -> Clocked:
        """Makes the controller."""
        return Clocked(self.make(model, horizon=self.horizon))


class AtPlant(NamedTuple):
    """A controller on the true model at another horizon, timed."""

    make: Any
    horizon: int

    def __call__(self, plant: Any) -> Clocked:
        """Makes the controller."""
        return Clocked(self.make(plant, horizon=self.horizon))


def pareto_front(
    times: Sequence[float], costs: Sequence[float], least: float = 0.0
) -> list[bool]:
    """Returns which cases are not dominated: none is at least as good in both and better in one.

    Args:
        times: Less is better.
        costs: Less is better.
        least: What takes more time has to cost less by more than this.
    """
    order = sorted(range(len(times)), key=lambda i: (times[i], costs[i]))
    members = [False] * len(order)
    best = np.inf
    at = np.nan
    for i in order:
        if costs[i] < best - least:
            members[i], best, at = True, costs[i], times[i]
        elif (times[i], costs[i]) == (at, best):  # not told apart
            members[i] = True
    return members


def _row(
    family: Family,
    horizon: int,
    flown: Mapping[str, list[dict]],
    truth: Mapping[str, list[dict]],
) -> dict:
    """Returns the row of a case, from records by trajectory."""
    records = [record for of in flown.values() for record in of]
    lost = next((_why(record) for record in records if "error" in record), None)
    if lost is None and (
        astray := next((r for of in truth.values() for r in of if "error" in r), None)
    ):
        lost = f"nothing to compare with: NMPC on the true model, {_why(astray)}"
    row = {
        "family": family.name,
        "what": family.words,
        "H": horizon,
        "lost": lost,
        "front": False,
    }
    row["flights"] = sum("error" not in record for record in records)
    if lost is not None:
        return row
    sums = [
        {name: sum(r["cost"] for r in group) for name, group in of.items()}
        for of in (flown, truth)
    ]
    costs = {name: cost / sums[1][name] for name, cost in sums[0].items()}
    seconds = [second for record in records for second in record["seconds"]]
    row |= {
        "median": 1e3 * float(np.median(seconds)),
        "p99": 1e3 * float(np.quantile(seconds, 0.99)),
    }
    row |= {"cost": float(np.exp(np.mean(np.log(list(costs.values())))))}
    row |= {f"cost {name}": float(ratio) for name, ratio in costs.items()}
    row |= {
        f"rmse {name}": float(np.sqrt(np.mean([r["rmse"] ** 2 for r in of])))
        for name, of in flown.items()
    }
    return row | {
        "failed": sum(record["failed"] for record in records),
        "samples": len(seconds),
    }


def _why(record: Mapping[str, Any]) -> str:
    return f"{record['trajectory']}, seed {record['seed']}: {record['error']}"


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    lines = []
    for row in rows:
        if row["lost"] is None:
            figures = [
                f"{row['cost']:.4f}",
                number(row["median"]),
                number(row["p99"]),
                str(row["failed"]),
            ]
        else:
            figures = ["lost", *[MISSING] * 3]
        lines.append(
            [row["what"], str(row["H"]), *figures, "●" if row["front"] else ""]
        )
    return Table(
        ["gpmpc run", "H", "cost", "ms: median", "99 %", "failed", "front"],
        lines,
        "Quality over time",
    )


@styled
def front_figure(rows: Sequence[Mapping]) -> Figure:
    """Cost above NMPC on the true model over milliseconds a decision, with the front of the best.

    A curve is one choice of settings at growing horizons: of each controller the one of least cost, of at most five
    controllers. All others are grey dots. The members of the front are numbered, and named by what is typed after
    ``gpmpc run``.

    Args:
        rows: Of the quality study; lost ones are counted in the corner.
    """
    flown = [
        {**row, "excess": 100 * (row["cost"] - 1)}
        for row in rows
        if row["lost"] is None
    ]
    markers = {
        horizon: MARKERS[i % len(MARKERS)]
        for i, horizon in enumerate(sorted({row["H"] for row in rows}))
    }
    figure, ((axis,),) = make_figure(
        9.0, 6.2
    )  # at 100 dots an inch as wide as a README
    axis.set_title(
        f"gpmpc quality: {len({row['what'] for row in rows})} choices of settings over the horizon"
    )
    axis.axhline(0, color=BLACK, linewidth=0.8, linestyle=DASHED, zorder=1)
    for row in flown:
        axis.plot(
            row["median"],
            row["excess"],
            markers[row["H"]],
            color=OTHERS,
            markersize=4,
            zorder=2,
        )
    plain: dict[str, Any] = {"linestyle": "none", "markersize": 5.5}
    handles = []
    for (what, line), colour in zip(_curves(flown).items(), COLOURS, strict=False):
        axis.plot(
            [row["median"] for row in line],
            [row["excess"] for row in line],
            color=colour,
            zorder=3,
        )
        for row in line:
            axis.plot(
                row["median"],
                row["excess"],
                markers[row["H"]],
                color=colour,
                markersize=6,
                zorder=3,
            )
        handles.append(
            Line2D([], [], color=colour, marker="o", markersize=5.5, label=what)
        )
    handles.append(
        Line2D([], [], color=OTHERS, marker="o", **plain, label="other settings")
    )
    handles.append(
        Line2D(
            [], [], color=FRONT, linewidth=1.4, label="front: none is better and faster"
        )
    )
    handles += [
        Line2D([], [], color="0.4", marker=kind, **plain, label=f"H = {H}")
        for H, kind in markers.items()
    ]
    _scales(axis, flown)
    _front(
        axis,
        sorted(
            (row for row in flown if row["front"]),
            key=lambda row: (row["median"], -row["cost"]),
        ),
    )
    figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=8.5)
    if lost := len(rows) - len(flown):
        axis.text(
            0.99,
            0.98,
            f"lost: {lost}",
            transform=axis.transAxes,
            ha="right",
            va="top",
            color=FRONT,
        )
    return figure


def _curves(rows: Sequence[Mapping]) -> dict[str, list[Mapping]]:
    """Of each controller the settings of least cost, the fastest of those equal to 0.1 %; at most ``CURVES``."""
    lines: dict[str, list[Mapping]] = {}
    for row in sorted(rows, key=lambda row: row["H"]):
        lines.setdefault(row["what"], []).append(row)

    def merit(what: str) -> tuple[float, float]:
        cost = min(round(row["cost"], 3) for row in lines[what])
        return cost, min(
            row["median"] for row in lines[what] if round(row["cost"], 3) == cost
        )

    best: dict[str, str] = {}
    for what in sorted(lines, key=merit):
        best.setdefault(what.split()[0], what)
    return {what: lines[what] for what in list(best.values())[:CURVES]}


def _scales(axis: Axes, rows: Sequence[Mapping]) -> None:
    axis.set_xscale("log")
    axis.set_yscale("symlog", linthresh=LINEAR, linscale=0.4)
    axis.set_xlabel("median time of a decision [ms], one thread")
    axis.set_ylabel("closed-loop cost above NMPC on the true model")
    plain_numbers(axis.xaxis, few=True)
    values = [row["excess"] for row in rows] or [0.0]
    times = [row["median"] for row in rows] or [1.0]
    low = min(values)
    high = max(values)
    reach = [tick for tick in TICKS if low * 1.5 - 1 <= tick <= high * 1.5 + 1]
    axis.set_yticks(reach, [f"{tick:+d} %" if tick else "0" for tick in reach])
    axis.yaxis.set_minor_locator(NullLocator())
    axis.set_ylim(min(1.5 * low, 0) - 0.4, 1.7 * max(high, LINEAR))
    axis.set_xlim(min(times) / 1.7, max(times) * 1.6)


def _front(axis: Axes, members: Sequence[Mapping]) -> None:
    """Draws a stair that nobody is below of; its members are numbered, and named under the axis."""
    if not members:
        return
    x = [row["median"] for row in members]
    y = [row["excess"] for row in members]
    right = axis.get_xlim()[1]
    top = axis.get_ylim()[1]
    stair: Any = {
        "color": FRONT,
        "linewidth": 1.4,
        "zorder": 1.5,
        "drawstyle": "steps-post",
    }
    axis.plot([x[0], *x, right], [top, *y, y[-1]], **stair)
    axis.set_xlim(right=right)
    axis.set_ylim(top=top)
    for i, place in enumerate(zip(x, y, strict=True), 1):
        axis.plot(
            *place,
            "o",
            markersize=11,
            markerfacecolor="none",
            markeredgecolor=FRONT,
            markeredgewidth=1.2,
        )
        beside: Any = {
            "textcoords": "offset points",
            "ha": "right",
            "va": "center",
            "weight": "bold",
        }
        axis.annotate(
            str(i), place, (-9 - 9 * (i % 2), -9), **beside
        )  # nobody is below and left of it
    names = [
        f"{i}  {row['what']} horizon={row['H']}" for i, row in enumerate(members, 1)
    ]
    handles = [Line2D([], [], linestyle="none", label=name) for name in names]
    font: Any = {"family": "monospace", "size": 8.5}
    axis.figure.legend(
        handles=handles, loc="outside lower left", handlelength=0, prop=font
    )
