"""The search for one output's hyperparameters by maximum marginal likelihood, which has many local optima.

They differ by a factor of a hundred in prediction error. So the search explores a few iterations of L-BFGS (Byrd, Lu,
Nocedal and Zhu, 1995) from the paper's starting point and from random ones, and goes on to convergence from the best
two. (On the paper's data a single start reached the best known optimum for about 75 % of the outputs; four starts and
two finalists for about 98 %, at two and a half times the evaluations.) Of many points a random subset is searched
first; one more search goes on from what it found over all of them.

theta = (log length-scales, log sf, log(sf / sn)), in a wide box around the data's standard deviations.
"""

import logging
import math
import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.gaussian import check_tensors
from gpmpc.gp._data_checks import RESOLUTION, constant_columns
from gpmpc.gp._kernel import IGNORED, check_posterior
from gpmpc.gp._likelihood import FAILED, NegativeLogMarginalLikelihood
from gpmpc.gp._posterior import GPPosterior
from gpmpc.gp._scaling import Scaling

_log = logging.getLogger(__name__)
_EXPLORATION = 16  # L-BFGS iterations from every start, before ...
_FINALISTS = 2  # ... this many of the best go on to convergence
_ITERATIONS = 1000  # of the search to convergence, at most
_PLAIN_RATIO = 10.0  # sf / sn where the search begins
_LONGER = 1.0  # mean of log l over log std(x~) at the random starts: smooth dynamics prefer long length-scales
_SMOOTH = 5.0  # length-scale of an output that never changes, in spreads of its inputs
_REPEATED = 1e4  # sf / sn of such an output, at most: the data repeat themselves
_SMALL = (
    3e-9  # part of its magnitude: targets that vary by less vary as their magnitude
)
_LENGTHSCALE_LIMIT = 1e4  # the box holds length-scales within this factor of their input's standard deviation
_LOG_INTERVAL = 5.0  # [s]


@dataclass(frozen=True)
class SoftLimits:
    """Soft walls around length-scales and signal-to-noise ratio, where the data leave them open.

    ((log l_d - log std(x~_d)) / log r)^p summed over d, and (log(sf / sn) / log s)^p; the penalties of PILCO
    (Deisenroth, 2010) and of the experiment of Cao, Lai and Alam (2017). Nearly flat inside, steep outside.
    """

    lengthscale_factor: float = (
        100.0  #: r, how far a length-scale may be from its input's standard deviation
    )
    signal_to_noise: float = 1000.0  #: s, how large sf / sn may be
    power: int = 30  #: p, even

    def __post_init__(self) -> None:
        for key in ("lengthscale_factor", "signal_to_noise"):
            check_number(key, getattr(self, key), above=1)
        check_number("power", self.power, least=2, whole=True)
        if self.power % 2:
            raise SettingError("power", f"must be even; got {self.power}")

    def __call__(
        self, theta: np.ndarray, log_std: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """Value and gradient (d + 2,) at theta, given the logarithms of the inputs' standard deviations (d,)."""
        width = np.full(len(theta), np.log(self.lengthscale_factor))
        width[-1] = np.log(self.signal_to_noise)
        position = np.append(theta[:-2] - log_std, [0.0, theta[-1]]) / width
        return (position**self.power).sum(), self.power * position ** (
            self.power - 1
        ) / width


class OutputSearch:
    """The search for one output's hyperparameters, in scaled units, with a ``Trainer``'s settings.

    ``std`` (d,) is of the inputs (N, d), see ``column_std``; ``constant`` (d,) which of
    them are, and ``prior`` (d,) the length-scales of those. From the deadline on, by
    the clock of ``time.perf_counter`` [s], the best found so far is taken.
    """

    def __init__(
        self,
        name: str,
        inputs: np.ndarray,
        targets: np.ndarray,
        std: np.ndarray,
        constant: np.ndarray,
        prior: np.ndarray,
        settings: Any,
        deadline: float,
    ):
        self._name = name
        self._inputs = inputs
        self._targets = targets
        self._settings = settings
        self._deadline = deadline
        # An input that is known to have no effect drops out of the kernel.
        ignored = constant & np.isinf(prior)
        self._log_prior = np.log(np.where(ignored, IGNORED * std, prior))
        self._constant = constant
        self._log_std = np.log(np.where(constant & ~ignored, prior, std))
        self._log_output = np.log(_output_std(targets))
        self._box = search_box(
            self._log_std, self._log_output, settings.signal_to_noise_limit
        )
        self.evaluations = 0
        self._last_log = time.perf_counter()

    def __call__(
        self,
        first: np.ndarray | None,
        perturbations: np.ndarray,
        rows: np.ndarray | None,
    ) -> tuple[np.ndarray, float, list[float]]:
        """Gives theta, its objective (FAILED or more where every start failed), and those where the exploration ended.

        Args:
            first: theta of the first start (d + 2,); None takes l = std(x~), sf = std(y), sn = std(y) / 10.
            perturbations: Standard normal (restarts + 1, d + 2); the first row is not used.
            rows: The subset that the search begins with; None for all points from the start.
        """
        plain = np.append(self._log_std, [self._log_output, np.log(_PLAIN_RATIO)])
        longer = np.append(np.full(len(self._log_std), _LONGER), [0.0, 0.0])
        starts = [
            plain if first is None else first,
            *(plain + longer + shift for shift in perturbations[1:]),
        ]
        self._see(slice(None) if rows is None else rows)
        ends: list[tuple[np.ndarray, float]] = []
        for start in starts:
            ends.append(self._minimize(start, _EXPLORATION))
            if self._is_late() and min(value for _, value in ends) < FAILED:
                break
        best = sorted(ends, key=lambda end: end[1])[:_FINALISTS]
        if not self._is_late():
            best = [self._minimize(theta, _ITERATIONS) for theta, _ in best]
        theta, value = min(best, key=lambda end: end[1])
        if rows is not None:
            self._see(slice(None))
            theta, value = self._minimize(theta, _ITERATIONS)
        if self._is_late():
            _log.info(
                "training: %s: its share of time_limit=%g s is over",
                self._name,
                self._settings.time_limit,
            )
        # The likelihood says nothing of an input that never moved: the prior does.
        theta[:-2][self._constant] = self._log_prior[self._constant]
        return (
            theta,
            value,
            [end[1] for end in ends] + [math.nan] * (len(starts) - len(ends)),
        )

    def unsearched(self, deviation: float) -> tuple[np.ndarray, float, list[float]]:
        """What is supposed of an output that never changes, in the place of a search.

        The likelihood only ever asks for less signal and longer length-scales: for
        certainty everywhere, from data that have not seen the output vary. So the
        signal has the prior's ``deviation``, and the length-scales are some spreads of
        the inputs: among the data the output is known, far from them it is not. A
        single row leaves the noise open as well: that of the plain start.
        """
        lengths = self._log_std + np.log(_SMOOTH)
        lengths[self._constant] = self._log_prior[self._constant]
        signal = max(deviation, np.abs(self._targets).max())
        ratio = min(_REPEATED, self._settings.signal_to_noise_limit)
        if len(self._targets) == 1:
            ratio = min(_PLAIN_RATIO, ratio)
        theta = np.append(lengths, [np.log(signal), np.log(ratio)])
        self._see(slice(None))
        value = self._likelihood(theta)[0]
        self.evaluations += 1
        value = float(value) if np.isfinite(value) else FAILED
        return theta, value, [value] + [math.nan] * self._settings.restarts

    def _see(self, rows: Any) -> None:
        """Takes the likelihood of some of the points."""
        self._likelihood = NegativeLogMarginalLikelihood(
            self._inputs[rows], self._targets[rows]
        )
        self._size = len(self._targets[rows])

    def _minimize(self, start: np.ndarray, iterations: int) -> tuple[np.ndarray, float]:
        """The end point of L-BFGS and its objective."""
        outcome = minimize(
            self._objective,
            np.clip(start, *self._box),
            jac=True,
            method="L-BFGS-B",
            bounds=np.column_stack(self._box),
            callback=self._look_at_clock,
            options={
                "ftol": self._settings.tolerance,
                "gtol": 1e-6,
                "maxiter": iterations,
                "maxfun": 5 * iterations,
            },
        )
        return outcome.x, float(outcome.fun)

    def _is_late(self) -> bool:
        return time.perf_counter() >= self._deadline

    def _look_at_clock(self, _: np.ndarray) -> None:
        if self._is_late():
            raise StopIteration  # which ends scipy's search where it is

    def _objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative log marginal likelihood plus penalty, and the gradient."""
        with np.errstate(over="ignore", invalid="ignore"):
            value, gradient = self._likelihood(theta)
        self.evaluations += 1
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            value = FAILED
            gradient = np.zeros_like(theta)
        elif self._settings.penalty is not None:
            wall, slope = self._settings.penalty(theta, self._log_std)
            value = value + wall
            gradient = gradient + slope
        if time.perf_counter() - self._last_log > _LOG_INTERVAL:
            self._last_log = time.perf_counter()
            text = "training: %s, %d points: evaluation %d, minus log evidence %.8g"
            _log.info(text, self._name, self._size, self.evaluations, value)
        return value, gradient


def search_box(
    log_inputs: np.ndarray, log_output: float, signal_to_noise_limit: float
) -> tuple[np.ndarray, ...]:
    """The least and the largest theta (d + 2,), around the logarithms of the data's standard deviations."""
    reach = np.full(len(log_inputs) + 2, np.log(_LENGTHSCALE_LIMIT))
    reach[-2:] = np.log(1e6), np.log(signal_to_noise_limit)
    centre = np.append(log_inputs, [log_output, 0.0])
    return centre - reach, centre + reach


def column_std(columns: np.ndarray, constant: np.ndarray | None = None) -> np.ndarray:
    """The standard deviation (d,) of columns (N, d).

    Of a constant column its magnitude, or 1 where that is none; ``constant`` (d,) says
    which are, by default those of ``constant_columns``.
    """
    constant = constant_columns(columns) if constant is None else constant
    away = columns - columns[0]
    reach = np.abs(away).max(axis=0)
    magnitude = np.abs(columns).max(axis=0)
    unit = np.where(constant, np.where(magnitude > RESOLUTION, magnitude, 1.0), reach)
    return unit * np.where(
        constant, 1.0, (away / unit).std(axis=0, ddof=min(1, len(columns) - 1))
    )


def plain_theta(std: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Where the search begins (d + 2,): l = std(x~), sf = std(y), sn = std(y) / 10."""
    return np.append(np.log(std), np.log([_output_std(targets), _PLAIN_RATIO]))


def _output_std(targets: np.ndarray) -> float:
    """The standard deviation of scaled targets (N,), or their magnitude.

    Where the prior mean is far from them, signals are of their magnitude.
    """
    small = np.ptp(targets) <= _SMALL * np.abs(targets).max()
    return float(column_std(targets[:, None], np.array([small]))[0])


class TrainingData(NamedTuple):
    """What a training learns from, in the units of the data, and how it is scaled."""

    features: Tensor  #: (N, d)
    targets: Tensor  #: (N, k)
    feature_scaling: Scaling
    target_scaling: Scaling


def training_data(
    features: Tensor, targets: Tensor, input_dim: int, predicts: str, scaling: Any
) -> TrainingData:
    """Features and targets apart from any graph, and the scalings of both; errors are those of ``Trainer.fit``."""
    given = {"features": features, "targets": targets}
    check_tensors(**given)
    for name, value in given.items():
        if value.device.type != "cpu":
            raise SettingError(
                name,
                f"must be in host memory for training ({name}.cpu()); got {value.device}",
            )
    check_posterior(given, input_dim, predicts)
    features = features.detach()
    targets = targets.detach()
    n = features.shape[1] - input_dim
    names = [f"x{i + 1}" for i in range(n)] + [f"u{i + 1}" for i in range(input_dim)]
    outputs = [f"y{a + 1}" for a in range(targets.shape[1])]
    return TrainingData(
        features=features,
        targets=targets,
        feature_scaling=scaling(features, names),
        target_scaling=scaling(targets, outputs),
    )


def restored_theta(
    theta: np.ndarray, features: Scaling, targets: Scaling
) -> np.ndarray:
    """Rows (log l, log sf, log(sf / sn)) in the units of the data, from those in scaled units."""
    shift = np.tile(
        np.append(features.factor.log().numpy(), [0.0, 0.0]), (len(theta), 1)
    )
    shift[:, -2] = targets.factor.log().numpy()
    return theta + shift


def log_hyperparameters(
    posterior: GPPosterior, features: Scaling, targets: Scaling
) -> np.ndarray:
    """Rows (log l, log sf, log(sf / sn)), one an output (k, d + 2), of a posterior, in scaled units."""
    k = len(targets.factor)
    d = len(features.factor)
    if posterior.lengthscales.shape != (k, d):
        got = tuple(posterior.lengthscales.shape[::-1])
        rule = f"the posterior to start from must have {d} features and {k} outputs"
        raise ShapeError(f"{rule}; got {got[0]} and {got[1]}")
    parts = posterior.lengthscales, posterior.signal_variance, posterior.noise_variance
    length, sf2, sn2 = (part.to("cpu", torch.float64) for part in parts)
    deviation = (sf2.sqrt() / targets.factor).log()
    ratio = (sf2 / sn2).log() / 2
    return torch.column_stack(
        [(length / features.factor).log(), deviation, ratio]
    ).numpy()
