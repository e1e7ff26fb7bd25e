"""Measures of predictions and flights, and how far those numbers can be believed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from gpmpc._angles import state_difference
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import check_tensors


def mean_squared_error(
    predicted: Tensor, observed: Tensor, angles: Sequence[int] = ()
) -> float:
    """Computes the squared error summed over outputs, averaged over samples.

    Both are (N, n); ``angles`` are outputs whose errors are taken within half a turn
    [rad].
    """
    _check_alike(predicted=predicted, observed=observed)
    errors = state_difference(predicted, observed, angles)
    return float(errors.square().sum(dim=-1).mean())


def negative_log_predictive_density(
    mean: Tensor, variance: Tensor, observed: Tensor, angles: Sequence[int] = ()
) -> float:
    """Computes -log N(observed; mean, variance), averaged over samples and outputs.

    All are (N, n). Lower is better.

    ``angles`` are outputs whose errors are taken within half a turn [rad].

    Quinonero-Candela et al. (2006), "Evaluating predictive uncertainty challenge".
    """
    _check_alike(mean=mean, variance=variance, observed=observed)
    errors = state_difference(observed, mean, angles)
    densities = (2 * math.pi * variance).log() + errors.square() / variance
    return float(densities.mean() / 2)


def interval_coverage(
    mean: Tensor,
    variance: Tensor,
    observed: Tensor,
    level: float = 0.95,
    angles: Sequence[int] = (),
) -> float:
    """Computes the part of observations inside the central interval of a level.

    All are (N, n). Ideal is the level.

    ``angles`` are outputs whose errors are taken within half a turn [rad].
    """
    _check_alike(mean=mean, variance=variance, observed=observed)
    if not 0 < level < 1:
        raise SettingError("level", f"must lie between 0 and 1; got {level}")
    probability = torch.tensor((1 + level) / 2, dtype=variance.dtype)
    half_width = torch.special.ndtri(probability) * variance.sqrt()
    errors = state_difference(observed, mean, angles)
    return float((errors.abs() <= half_width).double().mean())


def _check_alike(**tensors: Tensor) -> None:
    """Raises ``ShapeError`` unless all tensors have one shape."""
    check_tensors(**tensors)
    if len({value.shape for value in tensors.values()}) > 1:
        got = ", ".join(f"{key} {tuple(value.shape)}" for key, value in tensors.items())
        raise ShapeError(f"all must have one shape (N, n); got {got}")


@dataclass(frozen=True)
class _TrackingError:
    """Root mean squared distance from the references."""

    axes: np.ndarray  #: of every state looked at, in its unit (j,)
    #: root of the mean of their summed squares: over x, y, z the distance [m]
    total: float


def tracking_error(
    states: np.ndarray,
    references: np.ndarray,
    axes: Sequence[int],
    angles: Sequence[int] = (),
) -> _TrackingError:
    """Computes how far a flight was from its references.

    The initial state is left out: nobody steered there.

    States and references are (K + 1, n), K of 1 or more; ``axes`` are the states to
    look at, all in one unit, and ``angles`` those of them whose errors are taken within
    half a turn [rad].
    """
    with np.errstate(over="ignore", invalid="ignore"):
        errors = _errors(states, references, axes, angles)
        squares = np.square(errors)[1:].mean(axis=0)
        return _TrackingError(
            axes=np.sqrt(squares), total=float(np.sqrt(squares.sum()))
        )


def _errors(
    states: np.ndarray,
    references: np.ndarray,
    axes: Sequence[int],
    angles: Sequence[int],
) -> np.ndarray:
    """Computes differences on some axes (K + 1, j); of angles, within half a turn."""
    same_shape = np.shape(states) == np.shape(references)
    if np.ndim(states) != 2 or not same_shape or len(states) < 2:
        got = f"{np.shape(states)} and {np.shape(references)}"
        raise ShapeError(
            f"states and references must both be (K + 1, n), K of 1 or more; got {got}"
        )
    n = np.shape(states)[1]
    if not all(-n <= axis < n for axis in axes):
        raise ShapeError(f"axes must be states from 0 to {n - 1}; got {tuple(axes)}")
    flown = np.asarray(states, dtype=float)
    errors = state_difference(flown, np.asarray(references, dtype=float), angles)
    return errors[:, list(axes)]


@dataclass(frozen=True)
class _Loss:
    """The step at which a flight was lost."""

    step: int  #: the first step k whose state is too far off
    distance: float  #: from its reference
    limit: float  #: how far it may be


def find_loss(
    states: np.ndarray,
    references: np.ndarray,
    axes: Sequence[int],
    least: float = 0.0,
    angles: Sequence[int] = (),
) -> _Loss | None:
    """Finds where a flight no longer follows its reference.

    It is farther from its reference than the reference ever goes from where the flight
    began: there the system would have been nearer had it never moved. That holds for
    any system and any units; a reference that hardly moves needs a ``least``, such as
    ``System.lost``: no flight is lost that is nearer. Arguments are those of
    ``tracking_error``. Returns the first such step, or None.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        errors = _errors(states, references, axes, angles)
        distances = np.linalg.norm(errors, axis=1)
        at_rest = np.broadcast_to(np.asarray(states)[0], np.shape(references))
        errors_at_rest = _errors(at_rest, references, axes, angles)
        farthest = float(np.linalg.norm(errors_at_rest, axis=1).max())
    limit = max(least, farthest)
    lost = ~(distances <= limit)  # what is no number is nowhere near
    k = int(np.argmax(lost))
    if not lost[k]:
        return None
    return _Loss(step=k, distance=float(distances[k]), limit=limit)


@dataclass(frozen=True)
class _ViolationRate:
    """The rate at which bounds were broken."""

    violations: int  #: steps at which any entry was outside
    steps: int  #: all of them
    worst: float  #: largest distance outside, in the entry's unit; 0 for none
    #: likewise of each entry; 0 within the tolerance
    worst_by_entry: tuple[float, ...]
    low: float  #: lower end of the interval for the probability of a violation
    high: float  #: its upper end

    @property
    def rate(self) -> float:
        """Part of the steps."""
        return self.violations / self.steps


def violation_rate(
    values: np.ndarray, lower: np.ndarray, upper: np.ndarray, tolerance: float = 1e-9
) -> _ViolationRate:
    """Counts how often states or inputs were outside their bounds.

    The rate has the 95 % interval of ``binomial_interval``. The interval takes steps
    for independent. Those of one flight are not: pool several seeds, and read it as a
    lower limit of the doubt. Values are (K, d), one row a step, and bounds (d,),
    infinite where there is none; a solver's round-off may be ``tolerance`` outside.
    """
    values = np.asarray(values, dtype=float)
    lower = np.asarray(lower, dtype=float)
    upper = np.asarray(upper, dtype=float)
    entries = values.shape[1:]
    have_bounds = lower.shape == entries and upper.shape == entries
    if values.ndim != 2 or not len(values) or not have_bounds:
        got = f"{values.shape}, {lower.shape}, {upper.shape}"
        raise ShapeError(
            f"values must be (K, d) with bounds (d,), K of 1 or more; got {got}"
        )
    if (lower > upper).any():
        j = int(np.argmax(lower > upper))
        raise SettingError(
            "lower, upper",
            f"must not cross; entry {j} has {lower[j]:g} above {upper[j]:g}",
        )
    # A value that is no number keeps no bound.
    inside = (values >= lower - tolerance) & (values <= upper + tolerance)
    violations = int((~inside.all(axis=1)).sum())
    distances = np.maximum(lower - values, values - upper)
    farthest = np.fmax.reduce(distances, axis=0, initial=0.0)
    low, high = binomial_interval(violations, len(values))
    return _ViolationRate(
        violations=violations,
        steps=len(values),
        worst=float(farthest.max(initial=0.0)),
        worst_by_entry=tuple(np.where(farthest > tolerance, farthest, 0.0).tolist()),
        low=low,
        high=high,
    )


def binomial_interval(
    successes: int, trials: int, level: float = 0.95
) -> tuple[float, float]:
    """Computes the exact interval for a probability from ``successes`` of ``trials``.

    Clopper and Pearson (1934).
    """
    if not 0 <= successes <= trials or trials < 1:
        raise SettingError(
            "successes",
            f"must lie between 0 and trials, 1 or more; got {successes} of {trials}",
        )
    low, high = stats.binomtest(successes, trials).proportion_ci(level, "exact")
    return float(low), float(high)


def time_quantiles(seconds: np.ndarray) -> dict[str, float]:
    """Computes quantiles of wall times (K,) [s].

    They are the "median", "p95" and "p99" (95 % and 99 %), and the "largest".
    """
    if np.ndim(seconds) != 1 or not len(seconds):
        raise ShapeError(
            f"seconds must be (K,), K of 1 or more; got {np.shape(seconds)}"
        )
    quantiles = np.quantile(seconds, [0.5, 0.95, 0.99, 1.0]).tolist()
    return dict(zip(("median", "p95", "p99", "largest"), quantiles, strict=True))


def tracking_cost(
    Q: np.ndarray,
    R: np.ndarray,
    states: np.ndarray,
    references: np.ndarray,
    inputs: np.ndarray,
    previous_input: Sequence[float] | np.ndarray,
    angles: Sequence[int] = (),
) -> float:
    """Computes the cost of a flight per step.

    1/K (sum_k |x_k - r_k|^2_Q + sum_k |u_k - u_{k-1}|^2_R).

    Q is (n, n) and R (m, m); states and references are (K + 1, n), of which the first
    cost nothing, inputs (K, m), and the previous input u_{-1} (m,). ``angles`` are
    states whose errors are taken within half a turn [rad].
    """
    errors = state_difference(states[1:], references[1:], angles)
    increments = np.diff(inputs, axis=0, prepend=np.atleast_2d(previous_input))
    tracking = np.einsum("ki,ij,kj", errors, Q, errors)
    control = np.einsum("ki,ij,kj", increments, R, increments)
    return float((tracking + control) / len(inputs))
