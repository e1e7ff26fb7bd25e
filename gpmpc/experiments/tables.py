"""Tables 1 and 2 of Cao, Lai and Alam (2017): how well GP models predict, by trajectory, subsystem and training size.

One trial is one draw of a training set: six GPs are trained on a random subset (sorted) of the 189 rows and predict the
subset and all rows, one step ahead each, by moment matching. The state that goes into the first prediction has
covariance 0.1^2 I, in the units of the model; every later one has the covariance predicted one sample earlier, while
its mean is the data's. Reported are

    MSE               squared error summed over the six outputs, averaged over the samples, in the units of the data
    average variance  of x, y, z (phi, theta, psi) in the covariance fed in, averaged over the samples, in model units

What the paper leaves open is added: the same errors of plain predictions, and whether those are calibrated.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any
from zlib import crc32

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from torch import Tensor

from gpmpc.datasets import DataSource
from gpmpc.exceptions import DataError, SettingError, check_number
from gpmpc.experiments.subsystems import SCALINGS, SYSTEMS, check_subsystems
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, Scaling, Training, Transitions
from gpmpc.metrics import (
    interval_coverage,
    mean_squared_error,
    negative_log_predictive_density,
)
from gpmpc.plotting import Series, png
from gpmpc.plotting._style import VERMILION, legend_below, make_figure, styled
from gpmpc.plotting._sweeps import draw_quartiles
from gpmpc.propagation import MomentMatching
from gpmpc.studies._document import MISSING, Document, Table, number, with_range
from gpmpc.studies.study import TrialSpec, derived_seed, fingerprint, random_rows
from gpmpc.trajectories import Trajectory

MEASURES = {
    "training_mse": "training MSE",
    "test_mse": "test MSE",
    "average_variance": "average variance",
}
CALIBRATION = {
    "plain_training_mse": "training MSE",
    "plain_test_mse": "test MSE",
    "nlpd": "NLPD",
    "coverage_95": "95 % coverage, all rows",
    "held_out_coverage_95": "95 % coverage, held-out",
}
SYMBOLS = {"within": "●", "below": "▼", "above": "▲"}
LEGEND = (
    "ours: median [min, max] over the draws. The paper's figure lies: ● within that range, ▼ below it, ▲ above it.",
    "The paper's training times: 1.12 s with 10 points, 4.01 s with 189.",
)


@dataclass(frozen=True)
class Tables:
    """Both tables; a row is a trajectory, a subsystem and a size.

    Attributes:
        data: Where transitions come from.
        trajectories: By name.
        subsystems: Names, or one.
        model: From transitions and a ``seed`` to a ``Training``.
        model_settings: The same as plain data, for the fingerprint.
        sizes: Training set sizes.
        draws: Training sets a row.
        seed: Every draw's own seed derives from it.
        state_std: Standard deviation of the state in the first prediction, in the units of the model.
        workers: Processes; None takes one a core.

    Raises:
        SettingError: A size, a draw count, a seed, a deviation or a worker count out of range.
    """

    data: DataSource
    trajectories: Mapping[str, Trajectory]
    subsystems: Sequence[str]
    model: Callable[..., Training]
    model_settings: Any
    sizes: Sequence[int] = (10, 50, 100, 189)
    draws: int = 5
    seed: int = 0
    state_std: float = 0.1
    workers: int | None = None

    name = "tables"
    trial_name = "draws"
    lost_is_result = False

    def __post_init__(self) -> None:
        sizes = (self.sizes,) if isinstance(self.sizes, int) else self.sizes
        if not isinstance(sizes, list | tuple) or not sizes:
            raise SettingError(
                "sizes",
                f"must be a list of whole numbers such as [10,50]; got {sizes!r}",
            )
        for size in sizes:
            check_number("sizes", size, least=1, whole=True)
        object.__setattr__(self, "sizes", tuple(dict.fromkeys(sizes)))
        check_number("draws", self.draws, least=1, whole=True)
        check_number("seed", self.seed, least=0, whole=True)
        check_number(
            "workers", 1 if self.workers is None else self.workers, least=1, whole=True
        )
        check_number("state_std", self.state_std, least=0)
        object.__setattr__(
            self, "subsystems", check_subsystems("subsystem", self.subsystems)
        )
        if not self.trajectories:
            raise SettingError("trajectory", "choose at least one")

    def trials(self, folder: Path | None = None) -> list[TrialSpec]:
        """Returns every draw, in the order of the tables.

        Raises:
            DataError: The data cannot be read.
            SettingError: A size is larger than the data.
        """
        trials = []
        for trajectory in self.trajectories:
            for subsystem in self.subsystems:
                data, scaling, reported = self._scaled(trajectory, subsystem)
                for size in self.sizes:
                    if size > len(data):
                        rows = f"{len(data)}, the rows of {trajectory} {subsystem}"
                        raise SettingError(
                            "sizes", f"must be at most {rows}; got {size}"
                        )
                    fit = Fit(
                        data, scaling, reported, size, self.model, float(self.state_std)
                    )
                    for draw in range(self.draws):
                        seed = derived_seed(
                            self.seed,
                            *(crc32(n.encode()) for n in (trajectory, subsystem)),
                            size,
                            draw,
                        )
                        settings = [
                            self.model_settings,
                            self.state_std,
                            reported,
                            size,
                            seed,
                        ]
                        arrays = [data.features, data.next_states, scaling.factor]
                        table = {"elliptical": 1, "lorenz": 2}.get(trajectory)
                        labels = {
                            "table": table,
                            "trajectory": trajectory,
                            "subsystem": subsystem,
                            "size": size,
                        }
                        name = fingerprint(settings, arrays)
                        trials.append(
                            TrialSpec(labels | {"draw": draw}, fit, seed, name)
                        )
        return trials

    def _scaled(
        self, trajectory: str, name: str
    ) -> tuple[Transitions, Scaling, tuple[int, ...]]:
        """Returns the data in the units of the model, the scaling of the next states, the indices that are reported."""
        system = SYSTEMS[name]
        raw = self.data.transitions(
            SYSTEMS[name], self.trajectories[trajectory], trajectory
        )
        n = raw.state_dim
        m = raw.input_dim
        states = system.state_names
        columns = [*states, *system.input_names, *(f"{state}+" for state in states)]
        if len(columns) != 2 * n + m:
            named = (
                f"the data have {2 * n + m} columns; the subsystem names {len(columns)}"
            )
            raise DataError(f"{trajectory} {name}: {named}")
        scaling = SCALINGS[name](
            torch.cat([raw.features, raw.next_states], dim=1), columns
        )
        pieces = [slice(0, n), slice(n, n + m), slice(n + m, None)]
        states, inputs, next_states = (
            Scaling(scaling.offset[piece], scaling.factor[piece]) for piece in pieces
        )
        data = Transitions(
            states.scale(raw.states),
            inputs.scale(raw.inputs),
            next_states.scale(raw.next_states),
        )
        return data, next_states, tuple(system.tracked_indices)

    @staticmethod
    def run_trial(trial: TrialSpec) -> dict:
        """Trains and scores one draw."""
        fit = trial.condition
        data = trial.condition.data
        restore = trial.condition.scaling.restore
        subset = random_rows(len(data), fit.size, trial.seed)
        training_rows = data[subset]
        training = fit.model(training_rows, seed=trial.seed)
        posterior = training.posterior
        means, fed, projected = predict_all(posterior, data, fit.state_std)
        own = (
            means
            if fit.size == len(data)
            else predict_all(posterior, training_rows, fit.state_std)[0]
        )
        plain = posterior.predict(data.states, data.inputs)
        mean = restore(plain.mean)
        variance = (plain.variance + posterior.noise_variance) * fit.scaling.factor**2
        observed = restore(data.next_states)
        held_out = np.setdiff1d(np.arange(len(data)), subset).tolist()
        return {
            "training_mse": mean_squared_error(restore(own), observed[subset]),
            "test_mse": mean_squared_error(restore(means), observed),
            "average_variance": float(fed[:, list(fit.reported)].mean()),
            "training_seconds": training.seconds,
            "plain_training_mse": mean_squared_error(mean[subset], observed[subset]),
            "plain_test_mse": mean_squared_error(mean, observed),
            "nlpd": negative_log_predictive_density(mean, variance, observed),
            "coverage_95": interval_coverage(mean, variance, observed),
            "held_out_coverage_95": (
                interval_coverage(
                    mean[held_out], variance[held_out], observed[held_out]
                )
                if held_out
                else None
            ),
            "largest_projection": projected,
            "negative_log_evidence": training.objective.tolist(),
            "likelihood_evaluations": training.evaluations,
        }

    def summary(self, records: Sequence[dict]) -> tuple[list[Table], list[str]]:
        """Returns both tables, and the calibration of plain predictions, for a terminal of 80 columns."""
        rows = summarise(records)
        header = [
            "",
            "N",
            *(f"{label}\nours     paper" for label in MEASURES.values()),
            "time\n[s]",
        ]
        tables = [
            Table(
                header,
                [_compact(row) for row in rows if row.trajectory == name],
                _title(name),
                sections=True,
            )
            for name in dict.fromkeys(row.trajectory for row in rows)
        ]
        return [*tables, _calibration(rows, medians=True)], [*LEGEND, self.data.note]

    def document(self, records: Sequence[dict]) -> Document:
        """Returns the tables with the paper's figures in columns of their own, and what lies outside our range."""
        rows = summarise(records)
        header = [
            "subsystem",
            "N",
            *(name for label in MEASURES.values() for name in (label, "paper")),
            "time [s]",
        ]
        tables = [
            Table(
                header,
                [_full(row) for row in rows if row.trajectory == name],
                _title(name),
                sections=True,
            )
            for name in dict.fromkeys(row.trajectory for row in rows)
        ]
        return Document(
            "Tables 1 and 2",
            [*tables, _calibration(rows)],
            pd.DataFrame([_numbers(row) for row in rows], dtype=object),
            notes=[*LEGEND, self.data.note],
            lists={"Outside our range": differences(rows) or ["Nothing."]},
            images={"tables.png": png(_figure(records))},
            latex=tables,
        )


def from_settings(
    made: Mapping[str, Any], settings: Mapping[str, Any], flight: Any
) -> Tables:
    """Makes the tables that ``conf/tables.yaml`` describes.

    Args:
        made: The settings, with objects in the place of what names a class.
        settings: The same as plain data.
        flight: Not needed.
    """
    numbers = {
        key: settings[key] for key in ("sizes", "draws", "seed", "state_std", "workers")
    }
    objects = made["data"], made["trajectory"], made["subsystem"], made["model"]
    return Tables(*objects, model_settings=settings["model"], **numbers)


@dataclass(frozen=True)
class Fit:
    """What one draw needs: data in the units of the model, how they are scored, how the model is trained."""

    data: Transitions
    scaling: Scaling
    reported: tuple[int, ...]
    size: int
    model: Callable[..., Training]
    state_std: float


def predict_all(
    posterior: GPPosterior, data: Transitions, state_std: float
) -> tuple[Tensor, Tensor, float]:
    """Predicts one step ahead along the rows of ``data``, as the tables do.

    Returns:
        Predicted means (N, n), the variances of the states that were fed in (N, n), and the largest amount by which a
        predicted covariance had to be projected to be positive semidefinite.
    """
    propagator = MomentMatching(process_noise=False)  # as in the paper
    covariance = state_std**2 * torch.eye(data.state_dim, dtype=torch.float64)
    means = []
    fed = []
    projected = 0.0
    for state, control in zip(data.states, data.inputs, strict=True):
        belief = Gaussian(state, covariance)
        fed.append(belief.variance)
        step = propagator.propagate(posterior, belief, control)
        means.append(step.belief.mean)
        covariance = step.belief.covariance
        projected = max(projected, float(step.deficit))
    return torch.stack(means), torch.stack(fed), projected


@dataclass(frozen=True)
class Statistic:
    """Median and range of one measure over the draws of a row, beside the paper's figure where there is one."""

    values: tuple[float, ...]
    paper: Decimal | None = None

    @property
    def range(self) -> tuple[float, float, float]:
        """Smallest, median and largest."""
        return min(self.values), median(self.values), max(self.values)

    @property
    def position(self) -> str | None:
        """Where the paper's figure lies: "within" our range, "below" or "above"; its last digit may be rounded."""
        if self.paper is None:
            return None
        half_a_digit = float(Decimal(5).scaleb(int(self.paper.as_tuple().exponent) - 1))
        if float(self.paper) + half_a_digit < min(self.values):
            return "below"
        return (
            "above" if float(self.paper) - half_a_digit > max(self.values) else "within"
        )

    @property
    def printed(self) -> str:
        """The paper's figure with the digits that it prints, and its position."""
        if self.paper is None:
            return MISSING
        return f"{_digits(self.paper)} {SYMBOLS[self.position]}"


@dataclass(frozen=True)
class Row:
    """A trajectory, a subsystem and a size, over all draws that did not fail."""

    trajectory: str
    subsystem: str
    size: int
    statistics: dict[str, Statistic]
    seconds: float | None
    failed: int


@cache
def paper_figures() -> dict[tuple[str, str, int], dict[str, Decimal]]:
    """Returns the figures printed in the paper's Tables 1 and 2, digit by digit."""
    with Path(__file__).with_name("paper_tables.csv").open(encoding="utf-8") as file:
        return {
            (line["trajectory"], line["subsystem"], int(line["size"])): {
                name: Decimal(line[name]) for name in MEASURES
            }
            for line in csv.DictReader(file)
        }


def summarise(records: Sequence[dict]) -> list[Row]:
    """Returns one row a trajectory, subsystem and size, in the order in which they come."""
    groups: dict[tuple[str, str, int], list[dict]] = {}
    for record in records:
        groups.setdefault(
            (record["trajectory"], record["subsystem"], record["size"]), []
        ).append(record)
    rows = []
    for key, group in groups.items():
        good = [record for record in group if "error" not in record]
        printed = paper_figures().get(key, {})
        values = {
            name: tuple(r[name] for r in good if r[name] is not None)
            for name in [*MEASURES, *CALIBRATION]
        }
        statistics = {
            name: Statistic(numbers, printed.get(name))
            for name, numbers in values.items()
            if numbers
        }
        seconds = (
            median(record["training_seconds"] for record in good) if good else None
        )
        rows.append(Row(*key, statistics, seconds, len(group) - len(good)))
    return rows


def differences(rows: Sequence[Row]) -> list[str]:
    """Returns one line for every figure of the paper that lies outside our range."""
    lines = []
    for row, (name, label) in (
        (row, measure) for row in rows for measure in MEASURES.items()
    ):
        statistic = row.statistics.get(name)
        if statistic and statistic.position in ("below", "above"):
            low, _, high = statistic.range
            end, nearest = (
                ("low", low) if statistic.position == "below" else ("high", high)
            )
            ratio = float(statistic.paper) / nearest
            distance = f"a factor {number(max(ratio, 1 / ratio))}"
            if 0.9 < ratio < 1.1:
                distance = f"{100 * abs(ratio - 1):.2g} %"
            lines.append(
                f"{row.trajectory} {row.subsystem} {row.size}, {label}: the paper prints {_digits(statistic.paper)}, "
                f"{distance} {statistic.position} the {end} end of our range, {number(nearest)}"
            )
    return lines


def _title(trajectory: str) -> str:
    in_paper = {"elliptical": "Table 1: elliptical", "lorenz": "Table 2: Lorenz"}
    return f"{in_paper.get(trajectory, trajectory)} trajectory"


def _compact(row: Row) -> list[str]:
    """Returns median and the paper's figure above the range, for every measure; then the time."""
    cells = []
    for statistic in map(row.statistics.get, MEASURES):
        if statistic is None:
            cells.append(MISSING)
            continue
        low, middle, high = map(number, statistic.range)
        cells.append(
            f"{middle:8} {statistic.printed if statistic.paper else ''}".rstrip()
            + f"\n[{low}, {high}]"
        )
    return [row.subsystem, str(row.size), *cells, _seconds(row)]


def _full(row: Row) -> list[str]:
    found = [row.statistics.get(name) for name in MEASURES]
    cells = [
        cell
        for s in found
        for cell in ((with_range(*s.range), s.printed) if s else (MISSING, MISSING))
    ]
    return [row.subsystem, str(row.size), *cells, _seconds(row)]


def _calibration(rows: Sequence[Row], medians: bool = False) -> Table:
    """Returns the table of plain predictions, with the ranges or with medians alone."""
    header = [
        "",
        "N",
        *(
            label.replace(", ", "\n") if medians else label
            for label in CALIBRATION.values()
        ),
    ]
    lines = []
    for row in rows:
        found = [
            row.statistics[name].range if name in row.statistics else None
            for name in CALIBRATION
        ]
        texts = [
            MISSING if of is None else number(of[1]) if medians else with_range(*of)
            for of in found
        ]
        lines.append([f"{row.trajectory} {row.subsystem}", str(row.size), *texts])
    over = ": medians over the draws" if medians else ""
    return Table(
        header, lines, f"Plain predictions (no input covariance){over}", sections=True
    )


def _numbers(row: Row) -> dict[str, Any]:
    """Returns median, min, max, the paper's figure and its position for every measure."""
    done = max((len(s.values) for s in row.statistics.values()), default=0)
    numbers = {
        "trajectory": row.trajectory,
        "subsystem": row.subsystem,
        "size": row.size,
        "draws": done,
    }
    numbers |= {"failed": row.failed, "training_seconds_median": row.seconds}
    for name in [*MEASURES, *CALIBRATION]:
        s = row.statistics.get(name)
        low, middle, high = s.range if s else (None, None, None)
        numbers |= {f"{name}_median": middle, f"{name}_min": low, f"{name}_max": high}
        if name in MEASURES:
            numbers |= {
                f"{name}_paper": s and s.paper,
                f"{name}_paper_is": s and s.position,
            }
    return numbers


@styled
def _figure(records: Sequence[dict]) -> Figure:
    """Draws the test MSE over the training size beside the paper's, a panel a trajectory and subsystem."""
    panels: dict[str, tuple[dict, dict]] = {}  # our errors and the paper's, by size
    for record in records:
        name = record["trajectory"], record["subsystem"]
        ours, paper = panels.setdefault(", ".join(name), ({}, {}))
        if "error" not in record:
            ours.setdefault(record["size"], []).append(record["test_mse"])
        if printed := paper_figures().get((*name, record["size"])):
            paper[record["size"]] = float(printed["test_mse"])
    columns = min(2, len(panels))
    rows = -(-len(panels) // 2)
    title = "Tables 1 and 2: error of held-out predictions"
    height = 3.4 * rows + 0.8 * (rows > 1)
    figure, axes = make_figure(4.6 * columns, height, rows, columns, title)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (heading, (errors, paper)) in zip(
        axes.flat, panels.items(), strict=False
    ):
        sizes = sorted(errors)
        axis.set(title=heading, xlabel="training points N")
        if not sizes:  # every fit failed
            axis.set_axis_off()
            continue
        draws = Series(
            "our draws, with their quartiles", [errors[size] for size in sizes]
        )
        draw_quartiles(axis, [draws], [str(size) for size in sizes])
        if known := {size: paper[size] for size in sizes if size in paper}:
            axis.plot(
                [*known],
                [*known.values()],
                "o",
                color=VERMILION,
                markersize=6,
                zorder=3,
                label="paper",
            )
        axis.set_yscale("log")
        axis.yaxis.set_minor_locator(NullLocator())
    legend_below(figure, axes.flat)
    figure.supylabel("test MSE")
    return figure


def _digits(value: Decimal) -> str:
    if value >= Decimal("1e-3"):
        return f"{value:f}"
    mantissa, exponent = f"{value:e}".lower().split("e")
    return f"{mantissa}e{int(exponent)}"


def _seconds(row: Row) -> str:
    text = MISSING if row.seconds is None else f"{row.seconds:.2f}"
    return text if not row.failed else f"{text} ({row.failed} failed)"
