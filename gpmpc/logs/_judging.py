"""Judges learned models on runs that they never saw, beside baselines.

For each group of states and 1, 10 and 50 steps ahead: mean and root mean squared error
(Euclidean, of attitudes geodesic), how often 95 % intervals hold, with the exact
interval of that frequency (Clopper and Pearson, 1934), and how wide they are: the root
mean variance that is claimed over the root mean squared error. Coverage alone is cheap;
a width of one is honest.
"""

import bisect
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import ndtri

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError, SettingError, check_kind, check_number
from gpmpc.logs._baselines import CONSTANT_STATE, baseline_errors
from gpmpc.logs._comparison import (
    FEWEST_PREDICTIONS,
    Comparison,
    compare,
    effective_number,
    independent_predictions,
    predictions_of_pieces,
)
from gpmpc.logs._fitting import PAST, rows_before
from gpmpc.logs._learning import IdentifiedModel, fewest_rows
from gpmpc.logs._log import Log
from gpmpc.logs._noise import (
    as_flown,
    error_variances,
    follow_errors,
    tube_variances,
)
from gpmpc.metrics import binomial_interval
from gpmpc.models._state_space import StateSpace
from gpmpc.models._windows import Windows

STEPS = (1, 10, 50)
LOSING_RATIO = 1.02  # of a baseline's error, from which on a model loses to it
LEVEL = 0.95
MOST_OTHER_STEP = 0.05  # of a time step, by which a log's may differ by rounding
MODEL = "model"  # name of the judged model among the predictors
_WINDOWS = 1000
_ROUNDING_SHARE = 1e-9  # of a constant state's error: an error by rounding
_LINEARIZED = 100  # windows linearised at once
_TUBES = 200  # of the windows, from whose starts a controller's tube is judged
_LARGEST_SIZE = 10.0  # of an error, in half widths of its interval, that counts
_LEAST_SHORT_SHARE = 0.02  # of the rows in short pieces, that is told


@dataclass(frozen=True)
class Judgement:
    """Errors of a model and of the baselines on held-out runs.

    ``gpmpc.mpc.Judgement`` is something else: it judges a step of a flight.

    See Also:
        ``judge``, which returns it.
    """

    groups: tuple[str, ...]  #: names of the groups of states
    units: tuple[str, ...]  #: of their errors
    steps: tuple[int, ...]  #: k
    #: mean error (k, groups) by the name of the predictor; the model's is "model"
    mean: dict[str, Array]
    rmse: dict[str, Array]  #: root mean squared error, likewise
    coverage: Array  #: frequency of the entries inside their interval (k, groups)
    #: exact interval of that frequency, of as many predictions as are independent by
    #: the autocorrelation of their errors (k, groups, 2)
    coverage_interval: Array
    width: Array  #: claimed over actual root mean square (k, groups)
    windows: tuple[int, ...]  #: number of predictions by k
    level: float = LEVEL  #: of the intervals
    #: errors of the model over those of each baseline, with intervals
    comparisons: tuple[Comparison, ...] = ()
    runs: tuple[str, ...] = ()  #: names of the runs that were predicted
    #: of a controller's tube from every row, likewise (k, groups); empty without one
    tube_coverage: Array = field(default_factory=lambda: np.empty((0, 0)))
    tube_width: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def losses(self) -> tuple[str, ...]:
        """Sentences on the errors that are larger than those of a baseline.

        They are by more than 2 %, and by more than chance.
        """
        return self.losses_to([comparison.name for comparison in self.comparisons])

    @property
    def steps_not_told(self) -> tuple[int, ...]:
        """The steps ahead at which too few rows tell a loss from chance.

        Of them fewer than four predictions do not overlap.
        """
        return tuple(
            step
            for k, step in enumerate(self.steps)
            if any(np.isinf(one.high[k]).any() for one in self.comparisons)
        )

    def losses_to(self, baselines: Sequence[str]) -> tuple[str, ...]:
        """Returns sentences on the errors that are larger than those of some baselines.

        Baselines that are the same predictor, as a constant state and a constant
        velocity where no velocity is known, have one sentence.

        Args:
            baselines: Their names.
        """
        losses = []
        names = [one.name for one in self.comparisons if one.name in baselines]
        for one in self.comparisons:
            if one.name not in names:
                continue
            for k, g in np.argwhere((one.ratio > LOSING_RATIO) & (one.low > 1.0)):
                error = self.mean[one.name][k, g]
                equal = [name for name in names if self.mean[name][k, g] == error]
                if equal[0] != one.name:
                    continue
                losses.append(
                    f"{self.groups[g]} {self.steps[k]} steps ahead: "
                    f"{self.mean[MODEL][k, g]:.3g} {self.units[g]}, "
                    f"{' and '.join(equal)} {error:.3g} "
                    f"({one.ratio[k, g]:.2f} of it; "
                    f"{one.low[k, g]:.2f} to {one.high[k, g]:.2f})"
                )
        return tuple(losses)

    def to_pandas(self) -> pd.DataFrame:
        """Returns a table with a row for each predictor, step and group."""
        rows = []
        for name, mean in self.mean.items():
            for k, g in np.ndindex(mean.shape):
                row: dict[str, Any] = {
                    "predictor": name,
                    "step": self.steps[k],
                    "group": self.groups[g],
                    "unit": self.units[g],
                    "mean_error": mean[k, g],
                    "rmse": self.rmse[name][k, g],
                }
                if name == MODEL:
                    low, high = self.coverage_interval[k, g]
                    row["coverage"] = self.coverage[k, g]
                    row["coverage_low"] = low
                    row["coverage_high"] = high
                    row["width"] = self.width[k, g]
                    if self.tube_width.size:
                        row["tube_coverage"] = self.tube_coverage[k, g]
                        row["tube_width"] = self.tube_width[k, g]
                rows.append(row)
        return pd.DataFrame(rows)


@explains_arguments
def judge(
    learned: IdentifiedModel, held_out: Log, train: Log, steps: Sequence[int] = STEPS
) -> Judgement:
    """Judges a learned model on a log of other runs.

    Args:
        learned: From ``learn``.
        held_out: Runs that it never saw.
        train: The runs that it was learned from, to which the baselines are fitted.
        steps: k, each larger than the one before.

    Raises:
        SettingError: An argument is of another kind, a log has another time step or
            other signals than the model, or there is no step, or steps do not increase.
        DataError: No piece of the held-out log is long enough, or none of the train
            log, to which baselines are fitted as many steps ahead.

    See Also:
        ``learn``; ``Judgement``, its result.
    """
    check_kind("learned", learned, IdentifiedModel, "what learn returns")
    check_kind("held_out", held_out, Log, "a Log of read_log")
    check_kind("train", train, Log, "a Log of read_log")
    _check_steps(steps)
    for name, log in (("held_out", held_out), ("train", train)):
        _check_time_step(name, log, learned)
        _check_signals(name, log, learned)
    names = [run.name for run in held_out]
    parts = [
        _judge_windows(learned, train, windows, own_steps, names, longest=max(steps))
        for windows, own_steps in held_out.windows_by_step(
            steps, rows_before(learned.model), most=_WINDOWS
        )
    ]
    return _joined(parts)


def _judge_windows(
    learned: IdentifiedModel,
    train: Log,
    windows: Windows,
    steps: Sequence[int],
    names: Sequence[str],
    longest: int,
) -> Judgement:
    """Judges a learned model on windows.

    Args:
        learned: From ``learn``.
        train: To which the baselines are fitted.
        windows: Of held-out runs.
        steps: After the starts, increasing.
        names: Of the held-out runs.
        longest: Steps of the longest prediction, also of other windows.
    """
    model = learned.model
    space = windows.space
    model_errors = model.rollout_errors(windows, steps)
    errors = {MODEL: model_errors}
    errors |= baseline_errors(model.kinematics, train, windows, steps)
    distances = {name: space.distances(e) for name, e in errors.items()}
    variances = _claimed_variances(learned, windows, steps)
    variances = follow_errors(windows, model_errors, variances, steps, longest)
    half_width = ndtri((1 + LEVEL) / 2) * np.sqrt(variances)
    sizes = np.abs(model_errors) / np.maximum(half_width, 1e-300)
    coverage = _group_means(space, np.abs(model_errors) <= half_width)
    tube = _judge_tube(learned, windows, steps)
    return Judgement(
        groups=tuple(group.name for group in space.groups),
        units=_error_units(space),
        steps=tuple(steps),
        mean={name: d.mean(axis=0) for name, d in distances.items()},
        rmse={n: np.sqrt(np.square(d).mean(axis=0)) for n, d in distances.items()},
        coverage=coverage,
        coverage_interval=_coverage_intervals(coverage, sizes, windows, steps),
        width=_width(space, variances, model_errors),
        windows=(len(windows),) * len(steps),
        comparisons=_comparisons(distances, windows, steps, longest),
        runs=tuple(name for number, name in enumerate(names) if number in windows.runs),
        tube_coverage=tube.coverage,
        tube_width=tube.width,
    )


class _TubeJudgement(NamedTuple):
    """How well a controller's tube holds; (steps, groups), or empty without one."""

    coverage: Array
    width: Array


def _judge_tube(
    learned: IdentifiedModel, windows: Windows, steps: Sequence[int]
) -> _TubeJudgement:
    """Judges a controller's tube on some of the windows."""
    tube = learned.noise.tube
    if tube is None:
        return _TubeJudgement(np.empty((0, 0)), np.empty((0, 0)))
    fewer = windows[:: -(-len(windows) // _TUBES)]
    errors = as_flown(learned.model).rollout_errors(fewer, steps)
    variances = tube_variances(learned.model, fewer, tube, steps)
    half_width = ndtri((1 + LEVEL) / 2) * np.sqrt(variances)
    return _TubeJudgement(
        coverage=_group_means(windows.space, np.abs(errors) <= half_width),
        width=_width(windows.space, variances, errors),
    )


def _width(space: StateSpace, variances: Array, errors: Array) -> Array:
    """Returns claimed over actual root mean square (steps, groups)."""
    claimed = _group_means(space, variances)
    actual = _group_means(space, np.square(errors))
    return np.sqrt(claimed / np.maximum(actual, 1e-300))


def _joined(parts: Sequence[Judgement]) -> Judgement:
    """Joins judgements of some steps each."""
    first = parts[0]
    return replace(
        first,
        steps=tuple(step for part in parts for step in part.steps),
        mean=_by_name([part.mean for part in parts]),
        rmse=_by_name([part.rmse for part in parts]),
        coverage=np.concatenate([part.coverage for part in parts]),
        coverage_interval=np.concatenate([part.coverage_interval for part in parts]),
        width=np.concatenate([part.width for part in parts]),
        windows=tuple(number for part in parts for number in part.windows),
        comparisons=tuple(
            Comparison(
                name=own[0].name,
                ratio=np.concatenate([one.ratio for one in own]),
                low=np.concatenate([one.low for one in own]),
                high=np.concatenate([one.high for one in own]),
            )
            for own in zip(*(part.comparisons for part in parts), strict=True)
        ),
        runs=tuple(dict.fromkeys(name for part in parts for name in part.runs)),
        tube_coverage=np.concatenate([part.tube_coverage for part in parts]),
        tube_width=np.concatenate([part.tube_width for part in parts]),
    )


def _by_name(parts: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Joins arrays (k, groups) of some steps each, by their names."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def check_held_out(held_out: Log) -> None:
    """Raises ``DataError`` of a log on which no model can be judged.

    Args:
        held_out: Runs that are to be held out, with the past of the first rows.
    """
    needed = PAST + 2
    longest = held_out.longest_piece
    if longest < needed:
        names = ", ".join(run.name for run in held_out)
        raise DataError(
            f"{names}: judging a model needs {needed} rows without a gap; the longest "
            f"piece that is held out has {longest}: hold out longer runs"
        )


def check_train(train: Log) -> None:
    """Raises ``DataError`` of a log to which no baseline can be fitted.

    Args:
        train: Runs that are to be learned from.
    """
    needed = fewest_rows(len(train.runs))
    longest = train.longest_piece
    if longest < needed:
        remedies = ["log longer runs", "resample over gaps (rate and max_gap)"]
        kinds = {finding.kind for finding in train.findings}
        if "held value" in kinds:
            remedies.append("keep values that repeat (held: use)")
        if "at rest" in kinds:
            remedies.append("keep what is at rest (rest: use)")
        raise DataError(
            f"learning needs {needed} rows without a gap; the longest piece to learn "
            f"from has {longest}: {', or '.join(remedies)}"
        )


def most_steps(learned: IdentifiedModel, held_out: Log, train: Log) -> int:
    """Returns how many steps ahead a model can be judged; less than one for none.

    A model that looks back on many rows leaves fewer of the held-out ones ahead. The
    baselines beside it are fitted to as many steps of the rows that it was learned
    from.
    """
    # A window has the past, the start and the steps.
    judged = held_out.longest_piece - rows_before(learned.model) - 1
    fitted = train.longest_piece - PAST - 1
    return min(judged, fitted)


def most_told_steps(learned: IdentifiedModel, held_out: Log) -> int:
    """Returns how many steps ahead held-out rows tell a loss from chance.

    So many that four predictions do not overlap; less than one for none.
    """
    pieces = [end - begin for run in held_out for begin, end in run.pieces]
    rows = np.array(pieces) - rows_before(learned.model)

    def too_few(steps: int) -> bool:
        starts = rows[rows > steps] - steps
        (count,) = predictions_of_pieces(starts, np.array([steps]))
        return bool(count < FEWEST_PREDICTIONS)

    return bisect.bisect_left(range(1, max(rows.max(), 1)), True, key=too_few)


def short_pieces(
    learned: IdentifiedModel, judgement: Judgement, held_out: Log, train: Log
) -> tuple[str, ...]:
    """Returns sentences on the rows in pieces too short for the longest rollouts."""
    past = rows_before(learned.model)
    sentences = []
    steps = judgement.steps[-1]
    share = 1 - held_out.share_in_pieces(past + steps + 1)
    if share >= _LEAST_SHORT_SHARE:
        sentences.append(
            f"{share:.0%} of the held-out rows lie in pieces too short for predictions "
            f"{steps} steps ahead: they count at fewer steps, if at all"
        )
    steps = learned.judged_steps[-1]
    share = 1 - train.share_in_pieces(past + steps + 1)
    if share >= _LEAST_SHORT_SHARE:
        sentences.append(
            f"{share:.0%} of the rows to learn from lie in pieces too short for "
            f"rollouts of {steps} steps: on these, structures were not compared"
        )
    return tuple(sentences)


def check_learned(learned: IdentifiedModel, held_out: Log, train: Log) -> None:
    """Raises ``DataError`` of a log that is too short to judge a model on."""
    if most_steps(learned, held_out, train) >= 1:
        return
    looks_back = rows_before(learned.model)
    names = ", ".join(run.name for run in held_out)
    raise DataError(
        f"{names}: the model looks back on {looks_back} rows, so judging it needs "
        f"{looks_back + 2} rows without a gap; the longest piece that is held out has "
        f"{held_out.longest_piece}: hold out longer runs"
    )


def _check_time_step(name: str, log: Log, learned: IdentifiedModel) -> None:
    """Raises ``SettingError`` of a log of another time step than the model.

    Steps ahead, lags and noise are of the rows that it was learned from.
    """
    step = learned.time_step
    if abs(log.time_step - step) > MOST_OTHER_STEP * step:
        raise SettingError(
            name,
            f"must have the model's time step, {step:g} s; got {log.time_step:g} s "
            f"(rate: {1 / step:g} in the mapping resamples)",
        )


def _check_signals(name: str, log: Log, learned: IdentifiedModel) -> None:
    """Raises ``SettingError`` of a log of other signals than the model."""
    own = log.mapping.namings
    for role, of_log, of_model in (
        ("states", own.states, learned.namings.states),
        ("inputs", own.inputs, learned.namings.inputs),
    ):
        if of_model and not set(of_log) & set(of_model):
            raise SettingError(
                name,
                f"must have the {role} of the model, {', '.join(of_model[0])}; got "
                f"{', '.join(of_log[0]) if of_log else 'none'}",
            )
    units = _units(log.space)
    units_of_model = _units(learned.model.kinematics.space)
    if units != units_of_model:
        rule = f"must have states of the model's kinds and units, {units_of_model}"
        raise SettingError(name, f"{rule}; got {units}")
    contexts = len(log.mapping.column_names("context"))
    if contexts != len(learned.context_names):
        raise SettingError(
            name,
            f"must have the context of the model, {len(learned.context_names)} "
            f"columns; got {contexts}",
        )


def _units(space: StateSpace) -> str:
    """Lists the kind and the unit of each group of states."""
    return ", ".join(f"{group.kind} [{group.unit}]" for group in space.groups)


def _check_steps(steps: Sequence[int]) -> None:
    """Raises ``SettingError`` unless steps are numbers of one or more, and increase."""
    if np.ndim(steps) != 1 or not np.size(steps):
        raise SettingError("steps", f"must be a list of numbers; got {steps!r}")
    for step in steps:
        check_number("steps", step, least=1, whole=True)
    if any(later <= step for step, later in itertools.pairwise(steps)):
        raise SettingError("steps", f"must increase; got {list(steps)}")


def _comparisons(
    distances: Mapping[str, Array],
    windows: Windows,
    steps: Sequence[int],
    longest: int,
) -> tuple[Comparison, ...]:
    """Compares the errors of the model with those of each baseline.

    What is exact but for rounding is as good as anything that is.
    """
    rounding = _ROUNDING_SHARE * distances[CONSTANT_STATE].mean(axis=0)
    block = 2 * -(-longest // windows.stride)
    return tuple(
        compare(
            name=name,
            distances=distances[MODEL] + rounding,
            others=others + rounding,
            block=block,
            independent=independent_predictions(windows, steps),
            seed=0,
        )
        for name, others in distances.items()
        if name != MODEL
    )


def _claimed_variances(
    learned: IdentifiedModel, windows: Windows, steps: Sequence[int]
) -> Array:
    """Computes the variances (W, steps, e) that a model claims, batch by batch."""
    variances = []
    for first in range(0, len(windows), _LINEARIZED):
        batch = windows[first : first + _LINEARIZED]
        variances.append(error_variances(learned.model, batch, learned.noise, steps))
    return np.concatenate(variances)


def _group_means(space: StateSpace, values: Array) -> Array:
    """Averages values (W, steps, e) over windows and groups (steps, groups)."""
    means = [values[..., columns].mean(axis=(0, 2)) for columns in space.error_columns]
    return np.stack(means, axis=-1)


def _error_units(space: StateSpace) -> tuple[str, ...]:
    """Returns the units of the errors of each group."""
    units = []
    for group in space.groups:
        units.append("rad" if group.kind == "quaternion" else group.unit)
    return tuple(units)


def _coverage_intervals(
    coverage: Array, sizes: Array, windows: Windows, steps: Sequence[int]
) -> Array:
    """Computes exact intervals of frequencies (steps, groups, 2).

    Predictions that overlap are not independent, nor are those whose errors are alike
    for longer: as many are counted as the autocorrelation of the errors' sizes leaves.

    Args:
        coverage: The frequencies (steps, groups).
        sizes: Of errors, over half the widths of their intervals (W, steps, e).
        windows: W of them.
        steps: After the starts.
    """
    apart = independent_predictions(windows, steps)
    bounded = np.minimum(np.nan_to_num(sizes, nan=np.inf), _LARGEST_SIZE)
    intervals = np.empty((*coverage.shape, 2))
    for g, columns in enumerate(windows.space.error_columns):
        of_group = bounded[..., columns].mean(axis=-1)  # (W, steps)
        for k in range(len(steps)):
            effective = effective_number(of_group[:, k], windows.runs)
            count = max(int(min(apart[k], effective)), 1)
            covered = round(float(coverage[k, g]) * count)
            intervals[k, g] = binomial_interval(covered, count, LEVEL)
    return intervals
