"""Judges what was learned on runs that it never saw, 1, 10 and 50 steps ahead, beside predictions that cost nothing.

For each group of states: mean and root mean squared error (Euclidean, of attitudes geodesic), how often 95 % intervals
hold, with the exact interval of that frequency (Clopper and Pearson, 1934), and how wide they are: the root mean
variance that is claimed over the root mean squared error. Coverage alone is cheap; a width of one is honest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import ndtri

from gpmpc.logs._fitting import error_variances, fit_least_squares, follow_errors
from gpmpc.logs._kinematics import Array, Kinematics
from gpmpc.logs._learning import Learned
from gpmpc.logs._log import Log, Windows
from gpmpc.logs._rollouts import PAST, rollout_errors
from gpmpc.metrics import binomial_interval

STEPS = (1, 10, 50)
LEVEL = 0.95
WINDOWS = 1000
RIDGE_WINDOWS = 3000  # to which the ridge regression is fitted
LAGS = (1, 2, 3, 5, 8, 12, 20)  # rows of the past that it sees
BINS = 5  # means of the future inputs that it sees
PENALTY = 0.01  # of its squared coefficients of standardised columns, per row
CHUNK = 100  # windows linearised at once


@dataclass(frozen=True)
class Judgement:
    """Errors of a model and of the baselines on held-out runs."""

    groups: tuple[str, ...]  #: names of the groups of states
    units: tuple[str, ...]  #: of their errors
    steps: tuple[int, ...]  #: k
    mean: dict[
        str, Array
    ]  #: mean error (k, groups) by the name of the predictor; the model's is "model"
    rmse: dict[str, Array]  #: root mean squared error, likewise
    coverage: Array  #: share of the entries inside their interval (k, groups)
    coverage_interval: Array  #: exact interval of that share, from independent windows only (k, groups, 2)
    width: Array  #: claimed over actual root mean square (k, groups)
    windows: int  #: number of predictions
    level: float = LEVEL  #: of the intervals

    @property
    def losses(self) -> tuple[str, ...]:
        """Where the model is worse than a baseline, in words; nothing if it never is."""
        own = self.mean["model"]
        return tuple(
            f"{self.groups[g]} {self.steps[k]} steps ahead: {own[k, g]:.3g} {self.units[g]}, {name} {errors[k, g]:.3g}"
            for name, errors in self.mean.items()
            for k, g in np.argwhere(own > 1.001 * errors)
        )

    def to_pandas(self) -> pd.DataFrame:
        """A row a predictor, step and group."""
        low, high = np.moveaxis(self.coverage_interval, -1, 0)
        own = {
            "coverage": self.coverage,
            "coverage_low": low,
            "coverage_high": high,
            "width": self.width,
        }
        rows = []
        for name, mean in self.mean.items():
            numbers = {"mean_error": mean, "rmse": self.rmse[name]} | (
                own if name == "model" else {}
            )
            for k, g in np.ndindex(mean.shape):
                row = {
                    "predictor": name,
                    "step": self.steps[k],
                    "group": self.groups[g],
                    "unit": self.units[g],
                }
                rows.append(
                    row | {key: values[k, g] for key, values in numbers.items()}
                )
        return pd.DataFrame(rows)


def judge(
    learned: Learned, held_out: Log, train: Log, steps: Sequence[int] = STEPS
) -> Judgement:
    """Judges a learned model on a log of other runs.

    Args:
        learned: From ``learn``.
        held_out: Runs that it never saw.
        train: The runs that it was learned from, to which the baselines are fitted.
        steps: k.

    Raises:
        DataError: No piece of the held-out log is long enough.
    """
    model = learned.model
    space = held_out.space
    kinematics = learned.model.kinematics
    past = max(model.past, PAST)
    longest = max(steps)
    cut = held_out.windows(longest, past, most=WINDOWS)
    start = cut.states[:, past]
    seen = train.windows(longest, PAST, most=RIDGE_WINDOWS)
    own = rollout_errors(cut, model.rollout(cut), steps)
    with np.errstate(over="ignore", invalid="ignore"):
        affine = rollout_errors(
            cut, fit_least_squares(kinematics, train).rollout(cut), steps
        )

    def direct(predict: Callable[[int], Array]) -> Array:
        return np.stack(
            [space.difference(predict(k), cut.states[:, past + k]) for k in steps],
            axis=1,
        )

    errors = {
        "model": own,
        "constant state": direct(lambda k: start),
        "constant velocity": direct(
            lambda k: kinematics.coast(start, k * cut.time_step)
        ),
        "least squares": np.nan_to_num(
            affine, nan=np.inf, posinf=np.inf, neginf=np.inf
        ),
        "ridge regression": direct(
            lambda k: _predict_by_ridge(kinematics, seen, cut, k)
        ),
    }
    distances = {name: space.distances(e) for name, e in errors.items()}
    parts = [cut[i : i + CHUNK] for i in range(0, len(cut), CHUNK)]
    variances = np.concatenate(
        [error_variances(model, part, learned.noise, steps) for part in parts]
    )
    variances = follow_errors(cut, own, variances, steps)

    def of_groups(values: Array) -> Array:  # (W, steps, e) -> (steps, groups)
        return np.stack(
            [values[..., at].mean(axis=(0, 2)) for at in space.error_columns], axis=-1
        )

    coverage = of_groups(np.abs(own) <= ndtri((1 + LEVEL) / 2) * np.sqrt(variances))
    independent = [
        max(len(cut) * cut.stride // max(step, cut.stride), 1) for step in steps
    ]  # do not overlap
    pairs = zip(coverage, independent, strict=True)
    intervals = [
        [binomial_interval(round(share * n), n, LEVEL) for share in row]
        for row, n in pairs
    ]
    return Judgement(
        groups=tuple(group.name for group in space.groups),
        units=tuple(
            "rad" if group.kind == "quaternion" else group.unit
            for group in space.groups
        ),
        steps=tuple(steps),
        mean={name: d.mean(axis=0) for name, d in distances.items()},
        rmse={
            name: np.sqrt(np.square(d).mean(axis=0)) for name, d in distances.items()
        },
        coverage=coverage,
        coverage_interval=np.array(intervals),
        width=np.sqrt(
            of_groups(variances) / np.maximum(of_groups(np.square(own)), 1e-300)
        ),
        windows=len(cut),
    )


def _predict_by_ridge(
    kinematics: Kinematics, seen: Windows, windows: Windows, step: int
) -> Array:
    """Predicts states (W, n) at a step straight from past states, past and coming inputs, by a fit to ``seen``."""

    def regressors(cut: Windows) -> Array:
        start = cut.states[:, cut.past]
        past = cut.past
        u = cut.inputs
        columns = [kinematics.features(start, u[:, past], cut.context[:, past])]
        columns += [
            cut.space.difference(start, cut.states[:, past - lag]) for lag in LAGS
        ]
        columns += [u[:, past - lag] for lag in LAGS]
        columns += [
            u[:, past + rows].mean(axis=1)
            for rows in np.array_split(np.arange(step), min(BINS, step))
        ]
        return np.concatenate(columns, axis=1)

    z = regressors(seen)
    mean = z.mean(axis=0)
    factor = np.maximum(z.std(axis=0), 1e-12)
    z, new = (
        np.column_stack([np.ones(len(a)), (a - mean) / factor])
        for a in (z, regressors(windows))
    )
    y = seen.space.difference(
        seen.states[:, seen.past + step], seen.states[:, seen.past]
    )
    penalty = PENALTY * len(z) * np.diag(np.r_[0.0, np.ones(z.shape[1] - 1)])
    weights = np.linalg.solve(z.T @ z + penalty, z.T @ y)
    return windows.space.displace(windows.states[:, windows.past], new @ weights)
