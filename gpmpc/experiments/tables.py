"""Tables 1 and 2 of Cao, Lai and Alam (2017): how well GP models predict.

A row is a trajectory, a subsystem and a training size. One trial is one draw of a
training set: six GPs are trained on a random subset (sorted) of the 189 rows and
predict the subset and all rows, one step ahead each, by moment matching. The state that
goes into the first prediction has covariance 0.1^2 I, in the units of the model; every
later one has the covariance predicted one sample earlier, while its mean is the data's.
Reported are

    MSE               squared error summed over the six outputs, averaged over the
                      samples, in the units of the data
    average variance  of x, y, z (phi, theta, psi) in the covariance fed in, averaged
                      over the samples, in the units of the model

The errors of plain predictions, and whether those are calibrated, are added: the paper
leaves them open.
"""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple
from zlib import crc32

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
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
    "ours: median [min, max] over the draws. The paper's figure lies: "
    "● within that range, ▼ below it, ▲ above it.",
    "The paper's training times: 1.12 s with 10 points, 4.01 s with 189.",
)
TABLE_NUMBERS = {"elliptical": 1, "lorenz": 2}  # in the paper
TITLES = {"elliptical": "Table 1: elliptical", "lorenz": "Table 2: Lorenz"}

Position = Literal["within", "below", "above"]


@dataclass(frozen=True)
class Tables:
    """Both tables; a row is a trajectory, a subsystem and a size.

    Attributes:
        data: Source of the transitions.
        trajectories: By name.
        subsystems: Names, or one.
        model: Trains: from transitions and a ``seed`` to a ``Training``.
        model_settings: The same as plain data, for the fingerprint.
        sizes: Training set sizes.
        draws: Training sets a row.
        seed: Every draw's own seed derives from it.
        state_std: Standard deviation of the state in the first prediction, in the units
            of the model.
        workers: Processes; None takes one a core.

    Raises:
        SettingError: A size, a draw count, a seed, a deviation or a worker count out of
            range.
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
        if self.workers is not None:
            check_number("workers", self.workers, least=1, whole=True)
        check_number("state_std", self.state_std, least=0)
        subsystems = check_subsystems("subsystem", self.subsystems)
        object.__setattr__(self, "subsystems", subsystems)
        if not self.trajectories:
            raise SettingError("trajectory", "choose at least one")

    def trials(self, folder: Path | None = None) -> list[TrialSpec]:
        """Returns every draw, in the order of the tables.

        Raises:
            DataError: The data cannot be read.
            SettingError: A size is larger than the data.
        """
        trials: list[TrialSpec] = []
        for trajectory in self.trajectories:
            for subsystem in self.subsystems:
                scaled = self._scaled_data(trajectory, subsystem)
                for size in self.sizes:
                    trials += self._draws(trajectory, subsystem, scaled, size)
        return trials

    def _draws(
        self, trajectory: str, subsystem: str, scaled: "ScaledData", size: int
    ) -> Iterator[TrialSpec]:
        """Yields the draws of one row of the tables."""
        data = scaled.transitions
        if size > len(data):
            limit = f"{len(data)}, the rows of {trajectory} {subsystem}"
            raise SettingError("sizes", f"must be at most {limit}; got {size}")
        fit = Fit(
            data=data,
            scaling=scaled.scaling,
            reported=scaled.reported,
            size=size,
            model=self.model,
            state_std=float(self.state_std),
        )
        names = (trajectory, subsystem)
        checksums = [crc32(name.encode()) for name in names]
        arrays = [data.features, data.next_states, scaled.scaling.factor]
        for draw in range(self.draws):
            seed = derived_seed(self.seed, *checksums, size, draw)
            settings = [
                self.model_settings,
                self.state_std,
                scaled.reported,
                size,
                seed,
            ]
            labels = {
                "table": TABLE_NUMBERS.get(trajectory),
                "trajectory": trajectory,
                "subsystem": subsystem,
                "size": size,
                "draw": draw,
            }
            yield TrialSpec(
                labels=labels,
                condition=fit,
                seed=seed,
                fingerprint=fingerprint(settings, arrays),
            )

    def _scaled_data(self, trajectory: str, subsystem: str) -> "ScaledData":
        """Returns the data of a trajectory in the units of the model."""
        system = SYSTEMS[subsystem]
        data = self.data.transitions(system, self.trajectories[trajectory], trajectory)
        n = data.state_dim
        m = data.input_dim
        next_names = [f"{state}+" for state in system.state_names]
        columns = [*system.state_names, *system.input_names, *next_names]
        if len(columns) != 2 * n + m:
            raise DataError(
                f"{trajectory} {subsystem}: the data have {2 * n + m} columns; "
                f"the subsystem names {len(columns)}"
            )
        values = torch.cat([data.features, data.next_states], dim=1)
        scaling = SCALINGS[subsystem](values, columns)
        states = _part(scaling, slice(0, n))
        inputs = _part(scaling, slice(n, n + m))
        next_states = _part(scaling, slice(n + m, None))
        return ScaledData(
            transitions=Transitions(
                states.scale(data.states),
                inputs.scale(data.inputs),
                next_states.scale(data.next_states),
            ),
            scaling=next_states,
            reported=tuple(system.tracked_indices),
        )

    @staticmethod
    def run_trial(trial: TrialSpec) -> dict:
        """Trains and scores one draw."""
        fit: Fit = trial.condition
        data = fit.data
        subset = random_rows(len(data), fit.size, trial.seed)
        training_rows = data[subset]
        training = fit.model(training_rows, seed=trial.seed)
        posterior = training.posterior
        fed_on = predict_all(posterior, data, fit.state_std)
        of_subset = fed_on
        if fit.size != len(data):
            of_subset = predict_all(posterior, training_rows, fit.state_std)
        restore = fit.scaling.restore
        observed = restore(data.next_states)
        reported = list(fit.reported)
        return {
            "training_mse": mean_squared_error(
                restore(of_subset.means), observed[subset]
            ),
            "test_mse": mean_squared_error(restore(fed_on.means), observed),
            "average_variance": float(fed_on.variances[:, reported].mean()),
            "training_seconds": training.seconds,
            **_plain_scores(posterior, fit, subset),
            "largest_projection": fed_on.largest_projection,
            "negative_log_evidence": training.objective.tolist(),
            "likelihood_evaluations": training.evaluations,
        }

    def summary(self, records: Sequence[dict]) -> tuple[list[Table], list[str]]:
        """Returns the tables for a terminal of 80 columns, and the notes below them.

        The last table is that of plain predictions.
        """
        rows = summarise(records)
        measures = [f"{label}\nours     paper" for label in MEASURES.values()]
        header = ["", "N", *measures, "time\n[s]"]
        tables = _by_trajectory(rows, header, _compact)
        return [*tables, _calibration(rows, medians=True)], [*LEGEND, self.data.note]

    def document(self, records: Sequence[dict]) -> Document:
        """Returns the tables, and what of the paper lies outside our range.

        The paper's figures stand in columns of their own.
        """
        rows = summarise(records)
        header = ["subsystem", "N"]
        for label in MEASURES.values():
            header += [label, "paper"]
        header.append("time [s]")
        tables = _by_trajectory(rows, header, _full)
        return Document(
            title="Tables 1 and 2",
            tables=[*tables, _calibration(rows)],
            data=pd.DataFrame([_numbers(row) for row in rows], dtype=object),
            notes=[*LEGEND, self.data.note],
            lists={"Outside our range": differences(rows) or ["Nothing."]},
            images={"tables.png": png(_figure(records))},
            latex=tables,
        )


def from_settings(
    objects: Mapping[str, Any], settings: Mapping[str, Any], flight: Any
) -> Tables:
    """Makes the tables that ``conf/tables.yaml`` describes.

    Args:
        objects: The settings, with objects in the place of what names a class.
        settings: The same as plain data.
        flight: Not needed.
    """
    return Tables(
        data=objects["data"],
        trajectories=objects["trajectory"],
        subsystems=objects["subsystem"],
        model=objects["model"],
        model_settings=settings["model"],
        sizes=settings["sizes"],
        draws=settings["draws"],
        seed=settings["seed"],
        state_std=settings["state_std"],
        workers=settings["workers"],
    )


class ScaledData(NamedTuple):
    """Data of one trajectory and subsystem in the units of the model."""

    transitions: Transitions
    scaling: Scaling  # of the next states
    reported: tuple[int, ...]  # indices of the states whose variance is reported


@dataclass(frozen=True)
class Fit:
    """One row of the tables as its draws need it."""

    data: Transitions  #: in the units of the model
    scaling: Scaling  #: of the next states, to the units of the data
    reported: tuple[int, ...]  #: indices of the states whose variance is reported
    size: int  #: of the training set
    model: Callable[..., Training]
    state_std: float  #: of the state in the first prediction


def _part(scaling: Scaling, columns: slice) -> Scaling:
    return Scaling(scaling.offset[columns], scaling.factor[columns])


class FedPredictions(NamedTuple):
    """Predictions one step ahead, each fed with the covariance of the one before."""

    means: Tensor  # of the next states (N, n)
    variances: Tensor  # of the states that were fed in (N, n)
    #: by which a predicted covariance was moved to be positive semidefinite
    largest_projection: float


def predict_all(
    posterior: GPPosterior, data: Transitions, state_std: float
) -> FedPredictions:
    """Predicts one step ahead along the rows of ``data``, as the tables do."""
    propagator = MomentMatching(process_noise=False)  # as in the paper
    covariance = state_std**2 * torch.eye(data.state_dim, dtype=torch.float64)
    means = []
    variances = []
    largest_projection = 0.0
    for state, control in zip(data.states, data.inputs, strict=True):
        belief = Gaussian(state, covariance)
        variances.append(belief.variance)
        step = propagator.propagate(posterior, belief, control)
        means.append(step.belief.mean)
        covariance = step.belief.covariance
        largest_projection = max(largest_projection, float(step.deficit))
    return FedPredictions(
        torch.stack(means), torch.stack(variances), largest_projection
    )


def _plain_scores(
    posterior: GPPosterior, fit: Fit, subset: Sequence[int]
) -> dict[str, float | None]:
    """Scores predictions from certain states, in the units of the data."""
    data = fit.data
    observed = fit.scaling.restore(data.next_states)
    prediction = posterior.predict(data.states, data.inputs)
    mean = fit.scaling.restore(prediction.mean)
    variance = prediction.variance + posterior.noise_variance
    variance = variance * fit.scaling.factor**2
    held_out = np.setdiff1d(np.arange(len(data)), subset).tolist()
    held_out_coverage = None
    if held_out:
        held_out_coverage = interval_coverage(
            mean[held_out], variance[held_out], observed[held_out]
        )
    return {
        "plain_training_mse": mean_squared_error(mean[subset], observed[subset]),
        "plain_test_mse": mean_squared_error(mean, observed),
        "nlpd": negative_log_predictive_density(mean, variance, observed),
        "coverage_95": interval_coverage(mean, variance, observed),
        "held_out_coverage_95": held_out_coverage,
    }


@dataclass(frozen=True)
class Statistic:
    """One measure over the draws of a row, and the paper's figure if there is one."""

    values: tuple[float, ...]
    paper: Decimal | None = None

    @property
    def range(self) -> tuple[float, float, float]:
        """Smallest, median and largest."""
        return min(self.values), median(self.values), max(self.values)

    @property
    def position(self) -> Position | None:
        """Place of the paper's figure; its last digit may be rounded."""
        if self.paper is None:
            return None
        half_a_digit = float(Decimal(5).scaleb(int(self.paper.as_tuple().exponent) - 1))
        if float(self.paper) + half_a_digit < min(self.values):
            return "below"
        if float(self.paper) - half_a_digit > max(self.values):
            return "above"
        return "within"

    @property
    def printed(self) -> str:
        """The paper's figure with the digits that it prints, and its position."""
        if self.paper is None or self.position is None:
            return MISSING
        return f"{_digits(self.paper)} {SYMBOLS[self.position]}"


@dataclass(frozen=True)
class Row:
    """A trajectory, a subsystem and a size, over all draws that did not fail."""

    trajectory: str
    subsystem: str
    size: int
    statistics: dict[str, Statistic]
    seconds: float | None  #: median time of a training; None if all failed
    failed: int  #: number of draws


@cache
def paper_figures() -> dict[tuple[str, str, int], dict[str, Decimal]]:
    """Returns the figures printed in the paper's Tables 1 and 2, digit by digit.

    Keys are trajectory, subsystem and size.
    """
    figures = {}
    with Path(__file__).with_name("paper_tables.csv").open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            row = line["trajectory"], line["subsystem"], int(line["size"])
            figures[row] = {name: Decimal(line[name]) for name in MEASURES}
    return figures


def summarise(records: Sequence[dict]) -> list[Row]:
    """Returns one row for each trajectory, subsystem and size, in their order."""
    groups: dict[tuple[str, str, int], list[dict]] = {}
    for record in records:
        key = record["trajectory"], record["subsystem"], record["size"]
        groups.setdefault(key, []).append(record)
    rows = []
    for (trajectory, subsystem, size), group in groups.items():
        good = [record for record in group if "error" not in record]
        seconds = None
        if good:
            seconds = median(record["training_seconds"] for record in good)
        row = Row(
            trajectory=trajectory,
            subsystem=subsystem,
            size=size,
            statistics=_statistics(
                good, paper_figures().get((trajectory, subsystem, size), {})
            ),
            seconds=seconds,
            failed=len(group) - len(good),
        )
        rows.append(row)
    return rows


def _statistics(
    records: Sequence[dict], printed: Mapping[str, Decimal]
) -> dict[str, Statistic]:
    """Returns every measure that has a value, by name."""
    statistics = {}
    for name in (*MEASURES, *CALIBRATION):
        values = [record[name] for record in records if record[name] is not None]
        if values:
            statistics[name] = Statistic(tuple(values), printed.get(name))
    return statistics


def differences(rows: Sequence[Row]) -> list[str]:
    """Returns one line for every figure of the paper that lies outside our range."""
    lines = []
    for row in rows:
        for name, label in MEASURES.items():
            statistic = row.statistics.get(name)
            difference = None if statistic is None else _difference(statistic)
            if difference is not None:
                title = f"{row.trajectory} {row.subsystem} {row.size}, {label}"
                lines.append(f"{title}: {difference}")
    return lines


def _difference(statistic: Statistic) -> str | None:
    """Says how far outside our range the paper's figure lies; None if it is inside."""
    paper = statistic.paper
    position = statistic.position
    if paper is None or position not in ("below", "above"):
        return None
    low, _, high = statistic.range
    end = "low" if position == "below" else "high"
    nearest = low if position == "below" else high
    ratio = float(paper) / nearest
    distance = f"a factor {number(max(ratio, 1 / ratio))}"
    if 0.9 < ratio < 1.1:
        distance = f"{100 * abs(ratio - 1):.2g} %"
    return (
        f"the paper prints {_digits(paper)}, {distance} {position} "
        f"the {end} end of our range, {number(nearest)}"
    )


def _by_trajectory(
    rows: Sequence[Row], header: Sequence[str], cells: Callable[[Row], list[str]]
) -> list[Table]:
    """Returns one table for each trajectory."""
    tables = []
    for trajectory in dict.fromkeys(row.trajectory for row in rows):
        lines = [cells(row) for row in rows if row.trajectory == trajectory]
        title = f"{TITLES.get(trajectory, trajectory)} trajectory"
        tables.append(Table(header, lines, title, sections=True))
    return tables


def _compact(row: Row) -> list[str]:
    """Returns the cells of a row, with every range below its median.

    The paper's figure stands behind the median; the time comes last.
    """
    cells = []
    for name in MEASURES:
        statistic = row.statistics.get(name)
        if statistic is None:
            cells.append(MISSING)
            continue
        low, middle, high = map(number, statistic.range)
        printed = "" if statistic.paper is None else statistic.printed
        first_line = f"{middle:8} {printed}".rstrip()
        cells.append(f"{first_line}\n[{low}, {high}]")
    return [row.subsystem, str(row.size), *cells, _seconds(row)]


def _full(row: Row) -> list[str]:
    """Returns the cells of a row, with the paper's figures in cells of their own."""
    cells = []
    for name in MEASURES:
        statistic = row.statistics.get(name)
        if statistic is None:
            cells += [MISSING, MISSING]
        else:
            low, middle, high = statistic.range
            cells += [with_range(low, middle, high), statistic.printed]
    return [row.subsystem, str(row.size), *cells, _seconds(row)]


def _calibration(rows: Sequence[Row], medians: bool = False) -> Table:
    """Returns the table of plain predictions, with the ranges or with medians alone."""
    labels = list(CALIBRATION.values())
    title = "Plain predictions (no input covariance)"
    if medians:
        labels = [label.replace(", ", "\n") for label in labels]
        title = f"{title}: medians over the draws"
    lines = []
    for row in rows:
        cells = [f"{row.trajectory} {row.subsystem}", str(row.size)]
        for name in CALIBRATION:
            cells.append(_calibration_cell(row.statistics.get(name), medians))
        lines.append(cells)
    return Table(["", "N", *labels], lines, title, sections=True)


def _calibration_cell(statistic: Statistic | None, medians: bool) -> str:
    if statistic is None:
        return MISSING
    low, middle, high = statistic.range
    return number(middle) if medians else with_range(low, middle, high)


def _numbers(row: Row) -> dict[str, Any]:
    """Returns the columns of the CSV file.

    For every measure: median, min, max, the paper's figure and its position.
    """
    counts = [len(statistic.values) for statistic in row.statistics.values()]
    numbers = {
        "trajectory": row.trajectory,
        "subsystem": row.subsystem,
        "size": row.size,
        "draws": max(counts, default=0),
        "failed": row.failed,
        "training_seconds_median": row.seconds,
    }
    for name in (*MEASURES, *CALIBRATION):
        statistic = row.statistics.get(name)
        low = middle = high = None
        if statistic is not None:
            low, middle, high = statistic.range
        numbers[f"{name}_median"] = middle
        numbers[f"{name}_min"] = low
        numbers[f"{name}_max"] = high
        if name in MEASURES:
            paper = None if statistic is None else statistic.paper
            position = None if statistic is None else statistic.position
            numbers[f"{name}_paper"] = paper
            numbers[f"{name}_paper_is"] = position
    return numbers


@dataclass(frozen=True)
class _Panel:
    """Test errors of one trajectory and subsystem, by training size."""

    ours: dict[int, list[float]] = field(default_factory=dict)
    paper: dict[int, float] = field(default_factory=dict)


def _panels(records: Sequence[dict]) -> dict[str, _Panel]:
    """Returns the panels of the figure by their titles."""
    panels: dict[str, _Panel] = {}
    for record in records:
        trajectory = record["trajectory"]
        subsystem = record["subsystem"]
        size = record["size"]
        panel = panels.setdefault(f"{trajectory}, {subsystem}", _Panel())
        if "error" not in record:
            panel.ours.setdefault(size, []).append(record["test_mse"])
        printed = paper_figures().get((trajectory, subsystem, size))
        if printed is not None:
            panel.paper[size] = float(printed["test_mse"])
    return panels


@styled
def _figure(records: Sequence[dict]) -> Figure:
    """Draws the test MSE over the training size beside the paper's.

    Each trajectory and subsystem has its panel.
    """
    panels = _panels(records)
    columns = min(2, len(panels))
    rows = -(-len(panels) // 2)
    figure, axes = make_figure(
        width=4.6 * columns,
        height=3.4 * rows + 0.8 * (rows > 1),
        rows=rows,
        columns=columns,
        title="Tables 1 and 2: error of held-out predictions",
    )
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (heading, panel) in zip(axes.flat, panels.items(), strict=False):
        axis.set(title=heading, xlabel="training points N")
        _draw_panel(axis, panel)
    legend_below(figure, axes.flat)
    figure.supylabel("test MSE")
    return figure


def _draw_panel(axis: Axes, panel: _Panel) -> None:
    sizes = sorted(panel.ours)
    if not sizes:  # every fit failed
        axis.set_axis_off()
        return
    errors = [panel.ours[size] for size in sizes]
    draws = Series("our draws, with their quartiles", errors)
    draw_quartiles(axis, [draws], [str(size) for size in sizes])
    printed_sizes = [size for size in sizes if size in panel.paper]
    if printed_sizes:
        axis.plot(
            printed_sizes,
            [panel.paper[size] for size in printed_sizes],
            "o",
            color=VERMILION,
            markersize=6,
            zorder=3,
            label="paper",
        )
    axis.set_yscale("log")
    axis.yaxis.set_minor_locator(NullLocator())


def _digits(value: Decimal) -> str:
    """Writes a figure with the digits that it has."""
    if value >= Decimal("1e-3"):
        return f"{value:f}"
    mantissa, exponent = f"{value:e}".lower().split("e")
    return f"{mantissa}e{int(exponent)}"


def _seconds(row: Row) -> str:
    text = MISSING if row.seconds is None else f"{row.seconds:.2f}"
    return f"{text} ({row.failed} failed)" if row.failed else text
