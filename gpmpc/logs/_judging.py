"""Judges what was learned on runs that it never saw, 1, 10 and 50 steps ahead, beside predictions that cost nothing.

For each group of states: mean and root mean squared error (Euclidean, of attitudes geodesic), how often 95 % intervals
hold, with the exact interval of that frequency (Clopper and Pearson, 1934), and how wide they are: the root mean
variance that is claimed over the root mean squared error. Coverage alone is cheap; a width of one is honest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from gpmpc.logs._baselines import Ridge, fit_least_squares, predict_still
from gpmpc.logs._learning import Learned
from gpmpc.logs._log import Log, Windows
from gpmpc.logs._noise import error_variances, follow_errors
from gpmpc.logs._rollouts import PAST, choose_stride, rollout_errors
from gpmpc.logs._state_space import Array
from gpmpc.metrics import binomial_interval

if TYPE_CHECKING:
    from pandas import DataFrame

STEPS = (1, 10, 50)
WINDOWS = 1000
CHUNK = 100  # windows linearised at once
NEEDED = ("constant state", "constant velocity", "least squares")  # a model must beat them


@dataclass(frozen=True)
class Judgement:
    """Errors of a model and of the baselines on held-out runs."""

    groups: tuple[str, ...]  #: names of the groups of states
    units: tuple[str, ...]  #: of their errors
    steps: tuple[int, ...]  #: k
    mean: dict[str, Array]  #: mean error (k, groups) by the name of the predictor; the model's is "model"
    rmse: dict[str, Array]  #: root mean squared error, likewise
    coverage: Array  #: share of the entries inside their interval (k, groups)
    coverage_interval: Array  #: exact interval of that share, from independent windows only (k, groups, 2)
    width: Array  #: claimed over actual root mean square (k, groups)
    windows: int  #: number of predictions
    level: float = 0.95  #: of the intervals

    @property
    def losses(self) -> tuple[str, ...]:
        """Where the model is worse than a baseline, in words; nothing if it never is."""
        found = []
        for name, errors in self.mean.items():
            for k, step in enumerate(self.steps):
                for g, group in enumerate(self.groups):
                    if name != "model" and self.mean["model"][k, g] > 1.001 * errors[k, g]:
                        found.append(
                            f"{group} {step} steps ahead: {self.mean['model'][k, g]:.3g} {self.units[g]}, "
                            f"{name} {errors[k, g]:.3g}"
                        )
        return tuple(found)

    def to_pandas(self) -> "DataFrame":
        """A row a predictor, step and group."""
        import pandas

        rows = []
        for name, mean in self.mean.items():
            for k, step in enumerate(self.steps):
                for g, group in enumerate(self.groups):
                    row = {"predictor": name, "step": step, "group": group, "unit": self.units[g]}
                    row |= {"mean_error": mean[k, g], "rmse": self.rmse[name][k, g]}
                    if name == "model":
                        low, high = self.coverage_interval[k, g]
                        row |= {"coverage": self.coverage[k, g], "coverage_low": low, "coverage_high": high}
                        row |= {"width": self.width[k, g]}
                    rows.append(row)
        return pandas.DataFrame(rows)


def judge(learned: Learned, held_out: Log, train: Log, steps: Sequence[int] = STEPS, level: float = 0.95) -> Judgement:
    """Judges a learned model on a log of other runs.

    Args:
        learned: From ``learn``.
        held_out: Runs that it never saw.
        train: The runs that it was learned from, to which the baselines are fitted.
        steps: k.
        level: Of the intervals.

    Raises:
        DataError: No piece of the held-out log is long enough.
    """
    model, space = learned.model, held_out.space
    past = max(model.past, PAST)
    stride = choose_stride(held_out, max(steps) + past, WINDOWS)
    cut = held_out.windows(max(steps), past, stride)
    errors = {"model": rollout_errors(cut, model.rollout(cut), steps)}
    kinematics = model.kinematics

    def direct(predicted: list[Array]) -> Array:
        return np.stack(
            [space.difference(x, cut.states[:, past + k]) for x, k in zip(predicted, steps, strict=True)], axis=1
        )

    start = predict_still(cut, 0)
    errors["constant state"] = direct([start for _ in steps])
    errors["constant velocity"] = direct([kinematics.coast(start, k * cut.time_step) for k in steps])
    with np.errstate(over="ignore", invalid="ignore"):
        affine = rollout_errors(cut, fit_least_squares(kinematics, train).rollout(cut), steps)
    errors["least squares"] = np.nan_to_num(affine, nan=np.inf, posinf=np.inf, neginf=np.inf)
    ridge = Ridge.fit(kinematics, train, steps)
    errors["ridge regression"] = direct([ridge.predict(cut, k) for k in steps])
    with np.errstate(invalid="ignore"):
        distances = {name: space.distances(e) for name, e in errors.items()}
    parts = [cut[i : i + CHUNK] for i in range(0, len(cut), CHUNK)]
    variances = np.concatenate([error_variances(model, part, learned.noise, steps) for part in parts])
    variances = follow_errors(cut, errors["model"], variances, steps)
    coverage, interval, width = _coverage(cut, errors["model"], variances, steps, stride, level)
    return Judgement(
        tuple(group.name for group in space.groups),
        tuple(group.error_unit for group in space.groups),
        tuple(steps),
        {name: d.mean(axis=0) for name, d in distances.items()},
        {name: np.sqrt(np.square(d).mean(axis=0)) for name, d in distances.items()},
        coverage,
        interval,
        width,
        len(cut),
        level,
    )


def _coverage(
    windows: Windows, errors: Array, variances: Array, steps: Sequence[int], stride: int, level: float
) -> tuple[Array, Array, Array]:
    """Share of entries inside their interval, its exact interval, and the width, by step and group."""
    inside = np.abs(errors) <= ndtri((1 + level) / 2) * np.sqrt(variances)
    shape = (len(steps), len(windows.space.groups))
    share, interval, width = np.empty(shape), np.empty((*shape, 2)), np.empty(shape)
    for g, columns in enumerate(windows.space.error_columns):
        for k, step in enumerate(steps):
            share[k, g] = inside[:, k, columns].mean()
            independent = max(len(windows) * stride // max(step, stride), 1)  # windows that do not overlap
            interval[k, g] = binomial_interval(round(share[k, g] * independent), independent, level)
            claimed, actual = variances[:, k, columns].mean(), np.square(errors[:, k, columns]).mean()
            width[k, g] = np.sqrt(claimed / max(actual, 1e-300))
    return share, interval, width
