"""The search for one output's hyperparameters by maximum marginal likelihood.

The likelihood has many local optima, which differ by a factor of a hundred in
prediction error. So the search explores a few iterations of L-BFGS (Byrd, Lu, Nocedal
and Zhu, 1995) from the paper's starting point and from random ones, and goes on to
convergence from the best two. (On the paper's data a single start reached the best
known optimum for about 75 % of the outputs; four starts and two finalists for about
98 %, at two and a half times the evaluations.) Of many points a random subset is
searched first; one more search over all of them goes on from its optimum.

theta = (log length-scales, log sf, log(sf / sn)), in a wide box around the data's
standard deviations.
"""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import minimize

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gp._data_checks import column_scales
from gpmpc.gp._kernel import IGNORED
from gpmpc.gp._likelihood import NegativeLogMarginalLikelihood

_log = logging.getLogger(__name__)
# What a line search takes for an infinite objective, where a kernel matrix is not
# positive definite: finite, so that it steps back.
FAILED = 1e12
_EXPLORATION = 16  # L-BFGS iterations from every start, before ...
_FINALISTS = 2  # ... this many of the best go on to convergence
_ITERATIONS = 1000  # of the search to convergence, at most
_PLAIN_RATIO = 10.0  # sf / sn where the search begins
# Mean of log l over log std(x~) at the random starts: smooth dynamics prefer long
# length-scales.
_LONGER = 1.0
# Length-scale of a constant output, in standard deviations of its features.
_SMOOTH = 5.0
_REPEATED = 1e4  # sf / sn of such an output, at most: the data repeat themselves
# Part of its magnitude: targets that vary by less vary as their magnitude.
_SMALL = 3e-9
# The box holds length-scales within this factor of their feature's standard deviation.
_LENGTHSCALE_LIMIT = 1e4
_LOG_INTERVAL = 5.0  # [s]
ALL_ROWS = slice(None)

Penalty = Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]]


@explains_arguments
@dataclass(frozen=True)
class SoftLimits:
    """Soft walls around length-scales and signal-to-noise ratio.

    ((log l_d - log std(x~_d)) / log r)^p summed over d, and (log(sf / sn) / log s)^p;
    the penalties of PILCO (Deisenroth, 2010) and of the experiment of Cao, Lai and Alam
    (2017). Nearly flat inside, steep outside, for where the data leave them open.

    >>> import numpy as np
    >>> value, _ = SoftLimits(lengthscale_factor=10.0)(np.zeros(3), log_std=np.zeros(1))
    >>> float(value)
    0.0

    See Also:
        ``Trainer(penalty=...)``, which adds it.
    """

    #: r, how far a length-scale may be from its feature's standard deviation
    lengthscale_factor: float = 100.0
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
        """Computes value and gradient (d + 2,) at theta.

        Args:
            theta: (log l, log sf, log(sf / sn)) (d + 2,).
            log_std: Logarithms of the features' standard deviations (d,); of a
                constant one, of its prior length-scale.
        """
        width = np.full(len(theta), np.log(self.lengthscale_factor))
        width[-1] = np.log(self.signal_to_noise)
        position = np.append(theta[:-2] - log_std, [0.0, theta[-1]]) / width
        value = (position**self.power).sum()
        gradient = self.power * position ** (self.power - 1) / width
        return value, gradient


class SearchSettings(Protocol):
    """The settings of ``Trainer`` and ``SparseTrainer`` that searches use."""

    @property
    def penalty(self) -> Penalty | None: ...
    @property
    def restarts(self) -> int: ...
    @property
    def tolerance(self) -> float: ...
    @property
    def signal_to_noise_limit(self) -> float: ...
    @property
    def time_limit(self) -> float | None: ...


class SearchFeatures(NamedTuple):
    """The features of all GPs in scaled units."""

    points: np.ndarray  #: x~ (N, d)
    #: their units: standard deviations, or magnitudes of constant ones (d,); see
    #: ``column_scales``
    scales: np.ndarray
    constant: np.ndarray  #: which features are constant (d,)
    prior_lengthscales: np.ndarray  #: of the constant ones (d,)


def _prior_lengthscales(features: SearchFeatures) -> np.ndarray:
    """Returns the length-scales (d,) that constant features get.

    One that is known to have no effect drops out of the kernel.
    """
    prior = features.prior_lengthscales
    return np.where(np.isinf(prior), IGNORED * features.scales, prior)


def _search_lengthscales(features: SearchFeatures) -> np.ndarray:
    """Returns the length-scales (d,) that the box of the search is around.

    They are the features' standard deviations, and the prior length-scales of constant
    ones, unless these are infinite: no box holds them.
    """
    prior = features.prior_lengthscales
    has_prior = features.constant & np.isfinite(prior)
    return np.where(has_prior, prior, features.scales)


class SearchResult(NamedTuple):
    """Where the search for an output's hyperparameters ended."""

    theta: np.ndarray  #: (d + 2,), in scaled units
    objective: float  #: FAILED or more where every start failed
    #: objectives where the exploration from each start ended (restarts + 1,); NaN for
    #: starts that the time limit left out
    explored: list[float]


class Optimum(NamedTuple):
    """Where one run of L-BFGS ended."""

    theta: np.ndarray
    objective: float


class OutputSearch:
    """The search for one output's hyperparameters, in scaled units.

    Args:
        name: What the log calls the output.
        features: Those of the GP.
        targets: (N,).
        settings: A ``Trainer``.
        deadline: Time from which on the best theta so far is taken, by the clock of
            ``time.perf_counter`` [s].
    """

    def __init__(
        self,
        name: str,
        features: SearchFeatures,
        targets: np.ndarray,
        settings: SearchSettings,
        deadline: float,
    ):
        self._name = name
        self._points = features.points
        self._targets = targets
        self._settings = settings
        self._deadline = deadline
        self._constant = features.constant
        self._log_constant_lengthscales = np.log(_prior_lengthscales(features))
        self._log_lengthscales = np.log(_search_lengthscales(features))
        self._log_output = np.log(output_std(targets))
        self._box = search_box(
            self._log_lengthscales, self._log_output, settings.signal_to_noise_limit
        )
        # Of the points of the present search; ``_use_points`` sets both.
        self._likelihood: NegativeLogMarginalLikelihood
        self._size: int
        self.evaluations = 0
        self._last_log = time.perf_counter()

    def __call__(
        self,
        first: np.ndarray | None,
        perturbations: np.ndarray,
        rows: np.ndarray | slice,
    ) -> SearchResult:
        """Searches from all starts.

        Args:
            first: theta of the first start (d + 2,); None takes l = std(x~),
                sf = std(y), sn = std(y) / 10.
            perturbations: Standard normal, of the further starts (restarts, d + 2).
            rows: The subset that the search begins with, or ``ALL_ROWS``.
        """
        starts = self._starts(first, perturbations)
        self._use_points(rows)
        optima = self._explore(starts)
        finalists = sorted(optima, key=lambda optimum: optimum.objective)[:_FINALISTS]
        if not self._is_late():
            finalists = [self._minimize(f.theta, _ITERATIONS) for f in finalists]
        best = min(finalists, key=lambda optimum: optimum.objective)
        if rows is not ALL_ROWS:
            self._use_points(ALL_ROWS)
            best = self._minimize(best.theta, _ITERATIONS)
        if self._is_late():
            _log.info(
                "training: %s: its share of time_limit=%g s is over",
                self._name,
                self._settings.time_limit,
            )
        theta = best.theta.copy()
        # The likelihood says nothing of a constant feature: the prior does.
        theta[:-2][self._constant] = self._log_constant_lengthscales[self._constant]
        explored = [optimum.objective for optimum in optima]
        explored += [math.nan] * (len(starts) - len(optima))
        return SearchResult(theta, best.objective, explored)

    def result_of_constant(self, deviation: float) -> SearchResult:
        """Returns hyperparameters of a constant output, without a search.

        The likelihood only ever asks for less signal and longer length-scales: for
        certainty everywhere, from data that have not seen the output vary. So the
        signal has the prior's ``deviation``, and the length-scales are some standard
        deviations of the features: among the data the output is known, far from them it
        is not. A single row leaves the noise open as well: that of the plain start.
        """
        log_lengthscales = self._log_lengthscales + np.log(_SMOOTH)
        log_lengthscales[self._constant] = self._log_constant_lengthscales[
            self._constant
        ]
        signal = max(deviation, np.abs(self._targets).max())
        ratio = min(_REPEATED, self._settings.signal_to_noise_limit)
        if len(self._targets) == 1:
            ratio = min(_PLAIN_RATIO, ratio)
        theta = np.append(log_lengthscales, [np.log(signal), np.log(ratio)])
        self._use_points(ALL_ROWS)
        value = self._likelihood(theta)[0]
        self.evaluations += 1
        objective = float(value) if np.isfinite(value) else FAILED
        explored = [objective] + [math.nan] * self._settings.restarts
        return SearchResult(theta, objective, explored)

    def _starts(
        self, first: np.ndarray | None, perturbations: np.ndarray
    ) -> list[np.ndarray]:
        """The points where the exploration begins."""
        plain = np.append(
            self._log_lengthscales, [self._log_output, np.log(_PLAIN_RATIO)]
        )
        longer = np.append(np.full(len(self._log_lengthscales), _LONGER), [0.0, 0.0])
        starts = [plain if first is None else first]
        starts += [plain + longer + shift for shift in perturbations]
        return starts

    def _explore(self, starts: list[np.ndarray]) -> list[Optimum]:
        """Minimises for some iterations from every start, or until it is late."""
        optima: list[Optimum] = []
        for start in starts:
            optima.append(self._minimize(start, _EXPLORATION))
            one_succeeded = any(optimum.objective < FAILED for optimum in optima)
            if self._is_late() and one_succeeded:
                break
        return optima

    def _use_points(self, rows: np.ndarray | slice) -> None:
        """Takes the likelihood of some of the points."""
        targets = self._targets[rows]
        self._likelihood = NegativeLogMarginalLikelihood(self._points[rows], targets)
        self._size = len(targets)

    def _minimize(self, start: np.ndarray, iterations: int) -> Optimum:
        """Minimises the objective by L-BFGS in the box."""
        lower, upper = self._box
        result = minimize(
            self._objective,
            np.clip(start, lower, upper),
            jac=True,
            method="L-BFGS-B",
            bounds=np.column_stack([lower, upper]),
            callback=self._stop_at_deadline,
            options={
                "ftol": self._settings.tolerance,
                "gtol": 1e-6,
                "maxiter": iterations,
                "maxfun": 5 * iterations,
            },
        )
        return Optimum(result.x, float(result.fun))

    def _is_late(self) -> bool:
        return time.perf_counter() >= self._deadline

    def _stop_at_deadline(self, _: np.ndarray) -> None:
        if self._is_late():
            raise StopIteration  # which ends scipy's search where it is

    def _objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Computes the negative log marginal likelihood plus penalty, and gradient."""
        with np.errstate(over="ignore", invalid="ignore"):
            value, gradient = self._likelihood(theta)
            if self._settings.penalty is not None:
                penalty, slope = self._settings.penalty(theta, self._log_lengthscales)
                value = value + penalty
                gradient = gradient + slope
        self.evaluations += 1
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            value = FAILED
            gradient = np.zeros_like(theta)
        if time.perf_counter() - self._last_log > _LOG_INTERVAL:
            self._last_log = time.perf_counter()
            _log.info(
                "training: %s, %d points: evaluation %d, minus log evidence %.8g",
                self._name,
                self._size,
                self.evaluations,
                value,
            )
        return value, gradient


class SearchBox(NamedTuple):
    """Bounds of theta (d + 2,)."""

    lower: np.ndarray
    upper: np.ndarray


def search_box(
    log_features: np.ndarray, log_output: float, signal_to_noise_limit: float
) -> SearchBox:
    """Returns bounds of theta around the logarithms of the data's standard deviations.

    Args:
        log_features: Those of the features (d,).
        log_output: That of the output.
        signal_to_noise_limit: Largest sf / sn, and the inverse of the least.
    """
    half_width = np.full(len(log_features) + 2, np.log(_LENGTHSCALE_LIMIT))
    half_width[-2] = np.log(1e6)
    half_width[-1] = np.log(signal_to_noise_limit)
    middle = np.append(log_features, [log_output, 0.0])
    return SearchBox(lower=middle - half_width, upper=middle + half_width)


def plain_theta(scales: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Returns theta (d + 2,) where the search begins.

    l = std(x~), sf = std(y), sn = std(y) / 10.

    Args:
        scales: std(x~) (d,).
        targets: y (N,).
    """
    return np.append(np.log(scales), np.log([output_std(targets), _PLAIN_RATIO]))


def output_std(targets: np.ndarray) -> float:
    """Computes the standard deviation of scaled targets (N,), or their magnitude.

    Where the prior mean is far from them, signals are of their magnitude.
    """
    small = np.ptp(targets) <= _SMALL * np.abs(targets).max()
    return float(column_scales(targets[:, None], np.array([small]))[0])
