"""Training of sparse GPs on thousands of transitions.

Hyperparameters and inducing points are trained together. The hyperparameters start
where exact training on a random subset ends; the inducing points start greedily, each
where the outputs' conditional variances given those before it, in units of their noise,
add up to the most (Burt, Rasmussen and van der Wilk, 2020, section 4). What they leave
unexplained, on average, is added to the noise. Then L-BFGS maximises the collapsed
bound over all of it, in O(N M^2) an output and evaluation.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, TrainingError, check_choice, check_number
from gpmpc.gp._data_checks import (
    RESOLUTION,
    ColumnDescriptions,
    ConstantColumns,
    checked_targets,
)
from gpmpc.gp._kernel import Hyperparameters, kernel_matrix
from gpmpc.gp._memory import check_sparse_memory
from gpmpc.gp._prior_scales import PriorLengthscales
from gpmpc.gp._scaling import Scaling, centre, identity
from gpmpc.gp._search import FAILED, output_std, plain_theta, search_box
from gpmpc.gp._sparse import (
    JITTER,
    Method,
    collapsed_bound,
    data_sums,
    inducing_factor,
    sparse_posterior,
)
from gpmpc.gp._tensor_checks import Predicts
from gpmpc.gp._training import Trainer, Training
from gpmpc.gp._training_data import (
    TrainingData,
    check_data_settings,
    read_training_data,
    restored_theta,
    scaled_theta,
)
from gpmpc.gp._transitions import Transitions

_LinAlgError = torch.linalg.LinAlgError  # pyright: ignore[reportPrivateImportUsage]

_log = logging.getLogger(__name__)
_EVERY = 10  # iterations between two lines of the log
_TOLERANCE = 1e-7  # relative decrease of the objective at which L-BFGS stops
# The box holds sf / sn within this factor of one, as that of ``Trainer``.
_SIGNAL_TO_NOISE = 1e4


@explains_arguments
@dataclass(frozen=True)
class SparseTrainer:
    """Fits one sparse SE-ARD GP per output, over inducing points that all share.

    Progress is logged.

    Raises:
        SettingError: A setting is out of range.

    See Also:
        ``Trainer`` for up to some thousand points; ``informative_points``.
    """

    inducing: int = 100  #: M; no more than there are distinct points
    #: ``"sgpr"`` (Titsias, 2009) never overfits and may overestimate the noise;
    #: ``"fitc"`` (Snelson and Ghahramani, 2006) has a noise of its own at every point
    #: and may underestimate it (Bauer, van der Wilk and Rasmussen, 2016)
    method: Method = "sgpr"
    predicts: Predicts | None = None  #: what the GPs learn, as in ``Trainer``
    #: how features and targets are scaled for training, as in ``Trainer``
    scaling: Callable[[Tensor, Sequence[str]], Scaling] = centre
    iterations: int = 100  #: of L-BFGS, at most
    subset: int = 200  #: number of random transitions in the first, exact, training
    restarts: int = 1  #: random starts of that one
    #: of features and outputs that are constant in the data; all
    #: three as in ``Trainer``
    prior_lengthscale: PriorLengthscales = None
    prior_deviation: float | None = 1.0
    resolution: float = RESOLUTION

    def __post_init__(self) -> None:
        for key in ("inducing", "subset"):
            check_number(key, getattr(self, key), least=1, whole=True)
        check_number("iterations", self.iterations, least=0, whole=True)
        check_choice("method", self.method, get_args(Method))
        check_data_settings(self)
        self._exact_trainer()  # checks ``predicts`` and ``restarts``

    def __call__(self, transitions: Transitions, seed: int = 0) -> Training:
        """Trains on transitions.

        Args:
            transitions: The data.
            seed: Of the subset and of its random starts.

        Raises:
            TrainingError: No start of the subset's training succeeded for an output,
                which is named; or the inducing points learned nothing but noise of it
                where the subset's training learned more.
        """
        predicts = self.predicts or "next_state"
        targets = checked_targets(transitions, predicts)
        training = self.fit(
            transitions.features,
            targets,
            transitions.input_dim,
            predicts=predicts,
            seed=seed,
            columns=ColumnDescriptions.of_transitions(transitions, predicts),
        )
        return training.with_signals(transitions.signals)

    def fit(
        self,
        features: Tensor,
        targets: Tensor,
        input_dim: int,
        predicts: Predicts | None = None,
        seed: int = 0,
        columns: ColumnDescriptions | None = None,
    ) -> Training:
        """Trains on features x~ = (x, u) (N, n + m) and any targets (N, k).

        Arguments are those of ``Trainer.fit``.
        """
        start_time = time.perf_counter()
        check_number("seed", seed, least=0, whole=True)
        data = read_training_data(
            features,
            targets,
            input_dim,
            predicts=predicts or self.predicts or "next_state",
            columns=columns,
            settings=self,
        )
        check_sparse_memory(len(data), data.targets.shape[1], self.inducing)
        # A stationary kernel depends on differences; those from one of the points are
        # exact, wherever the data lie, which those from ``data.feature_scaling``'s
        # mean are not.
        scaling = Scaling(data.features[0], data.feature_scaling.factor)
        x = scaling.scale(data.features)
        y = data.scaled_targets
        scales = torch.from_numpy(data.feature_scales) / scaling.factor

        rows = np.random.default_rng(seed).permutation(len(x))[: self.subset]
        subset = self._subset_with_scaled_targets(data, rows)
        exact = self._exact_trainer().fit_data(subset, seed)
        subset_theta = scaled_theta(exact.posterior, scaling, subset.target_scaling)
        start_theta = _with_plain_starts(
            subset_theta, data, subset, scales.numpy(), y.numpy()
        )
        kernel = Hyperparameters.from_theta(torch.from_numpy(start_theta))
        Z = x[informative_points(x, kernel, self.inducing)]
        _log.info(
            "sparse training: %d inducing points chosen among %d after %.1f s",
            len(Z),
            len(x),
            time.perf_counter() - start_time,
        )
        bound_theta = self._with_unexplained(start_theta, Z, x, y)

        bound = _NegativeBound(
            x, y, scales, method=self.method, iterations=self.iterations
        )
        start = bound.pack(bound_theta, Z)
        initial = bound.values(start)
        best_vector = bound.minimize(
            start, unsearched=_unsearched_entries(bound_theta, data)
        )
        objective = bound.values(best_vector)
        _check_finite(objective)
        gains = _noise_alone(y) - objective
        gains[data.unsearched_outputs] = np.inf  # there is nothing to learn of them
        self._check_learned(
            gains,
            exact_gains=_noise_alone(y[rows]) - exact.objective,
            parameters=x.shape[1] + 2,
            names=data.columns.outputs,
        )

        best = bound.unpack(torch.from_numpy(best_vector))
        # as the posterior holds them: far from zero, restoring them rounds
        inducing = scaling.scale(scaling.restore(best.inducing))
        scaled_posterior = sparse_posterior(
            inducing,
            x,
            y,
            Hyperparameters.from_theta(best.theta),
            input_dim=data.input_dim,
            predicts=data.predicts,
            method=self.method,
            jitter=JITTER,
        )
        return Training(
            posterior=scaled_posterior.unscaled(scaling, data.target_scaling),
            theta=restored_theta(best.theta.numpy(), scaling, data.target_scaling),
            objective=objective,
            explored=initial[:, None],
            evaluations=bound.evaluations,
            seconds=time.perf_counter() - start_time,
        )

    def _exact_trainer(self) -> Trainer:
        """The trainer of the subset."""
        return Trainer(
            predicts=self.predicts,
            restarts=self.restarts,
            tolerance=_TOLERANCE,
            prior_lengthscale=self.prior_lengthscale,
            prior_deviation=self.prior_deviation,
            resolution=self.resolution,
        )

    def _subset_with_scaled_targets(
        self, data: TrainingData, rows: np.ndarray
    ) -> TrainingData:
        """Some rows, as exact GPs learn them; columns may be constant there alone.

        Targets are scaled by all data, so that objectives of subset and bound compare.
        Features are not: the search scales its box by their deviations in the subset.
        """
        features = data.features[rows]
        scaled_targets = data.scaled_targets
        constant = ConstantColumns.find(
            features, data.targets[rows], data.columns, self.resolution
        )
        return TrainingData(
            features=features,
            targets=scaled_targets[rows],
            input_dim=data.input_dim,
            predicts="value",
            feature_scaling=identity(data.features),
            target_scaling=identity(scaled_targets),
            columns=data.columns,
            constant=constant,
            prior=data.prior.for_scaled_targets(data.target_scaling),
        )

    def _with_unexplained(
        self, theta: np.ndarray, Z: Tensor, x: Tensor, y: Tensor
    ) -> np.ndarray:
        """Adds to the noise what the inducing points leave unexplained, on average.

        Else the bound is so low where the search begins that its first step leaves for
        a model of noise alone.
        """
        if self.method == "fitc":  # has that noise of its own
            return theta
        kernel = Hyperparameters.from_theta(torch.from_numpy(theta))
        with torch.no_grad():
            Lz = inducing_factor(Z, kernel, JITTER)
            sums = data_sums(Lz, Z, x, y, kernel, self.method)
        explained = sums.gram.diagonal(dim1=-2, dim2=-1).sum(-1)
        signal = kernel.signal_variance
        noise = kernel.noise_variance
        noise = noise + (signal - explained * noise / len(x)).clamp_min(0)
        return np.column_stack([theta[:, :-1], (signal / noise).log().numpy() / 2])

    def _check_learned(
        self,
        gains: np.ndarray,
        exact_gains: np.ndarray,
        parameters: int,
        names: Sequence[str],
    ) -> None:
        """Raises, or warns in the log, where the GPs are no better than noise alone.

        A gain below the number of an output's parameters is none (Akaike, 1974).

        Args:
            gains: Log evidence over that of noise alone (k,).
            exact_gains: The same of the exact GPs of the subset (k,).
            parameters: Number of an output's parameters.
            names: Of the outputs.
        """
        nothing = [a for a, gain in enumerate(gains) if -np.inf < gain < parameters]
        failed = [a for a in nothing if exact_gains[a] > parameters]
        if failed:
            outputs = ", ".join(names[a] for a in failed)
            raise TrainingError(
                failed,
                f"{self.inducing} inducing points learned nothing but noise of "
                f"{outputs}, where exact GPs of {self.subset} points learned more: "
                "raise inducing",
            )
        if nothing:
            _log.warning(
                "sparse training: nothing but noise was found in %s",
                ", ".join(names[a] for a in nothing),
            )


def _with_plain_starts(
    theta: np.ndarray,
    data: TrainingData,
    subset: TrainingData,
    scales: np.ndarray,
    targets: np.ndarray,
) -> np.ndarray:
    """Returns theta (k, d + 2) with plain starts of what only the subset has constant.

    Args:
        theta: Rows that the subset's training has found.
        data: All data.
        subset: The subset.
        scales: Standard deviations of the scaled features (d,).
        targets: Scaled (N, k).
    """
    started = theta.copy()
    features = subset.constant.features & ~data.constant.features
    started[:, :-2][:, features] = np.log(scales)[features]
    outputs = subset.constant.outputs & ~data.constant.outputs
    for a in np.flatnonzero(outputs):
        started[a] = plain_theta(scales, targets[:, a])
    return started


def _unsearched_entries(theta: np.ndarray, data: TrainingData) -> np.ndarray:
    """Which entries of theta (k, d + 2) are not searched: those of constant columns."""
    unsearched = np.zeros(theta.shape, dtype=bool)
    unsearched[data.unsearched_outputs] = True
    unsearched[:, :-2][:, data.constant.features] = True
    return unsearched


def _check_finite(objective: np.ndarray) -> None:
    """Raises ``TrainingError`` where the bound of an output (k,) does not exist."""
    failed = np.flatnonzero(~np.isfinite(objective)).tolist()
    if failed:
        raise TrainingError(
            failed,
            "the inducing points' kernel matrix is not positive definite: take fewer",
        )


def _noise_alone(targets: Tensor) -> np.ndarray:
    """The least negative log evidence (k,) of targets (N, k) as noise alone.

    Minus infinity where all are zero.
    """
    variance = targets.square().mean(0)
    return (len(targets) / 2 * (2 * math.pi * math.e * variance).log()).numpy()


@explains_arguments
def informative_points(
    features: Tensor, hyperparameters: Sequence[Tensor], count: int
) -> list[int]:
    """Chooses rows of features (N, d): each where most is unexplained by those before.

    A pivoted Cholesky factorisation of sum_a K_a / sn2_a's diagonal. Fewer than
    ``count`` come back where nothing is left to explain: less than round-off of every
    output's variance.

    Raises:
        SettingError: ``count`` is no number of points.

    See Also:
        ``SparseTrainer``; ``SlidingWindow``.
    """
    check_number("count", count, least=0, whole=True)
    lengthscales, signal_variance, noise_variance = hyperparameters
    round_off = max(1e-10, 100 * torch.finfo(features.dtype).eps) * signal_variance
    unexplained = signal_variance[:, None].repeat(1, len(features))
    most = min(count, len(features))
    rows = features.new_zeros(len(lengthscales), most, len(features))
    chosen: list[int] = []
    for step in range(most):
        i = int((unexplained / noise_variance[:, None]).sum(0).argmax())
        if bool((unexplained[:, i] <= round_off).all()):
            break
        row = kernel_matrix(
            features[i : i + 1], features, lengthscales, signal_variance
        )[:, 0]
        row = row - (rows[:, :step, i][:, None, :] @ rows[:, :step])[:, 0]
        pivot = unexplained[:, i].clamp_min(1e-300).sqrt()
        # An output to which this point is nothing new gives a row of round-off: none,
        # rather.
        is_new = unexplained[:, i] > round_off
        rows[:, step] = torch.where(is_new[:, None], row / pivot[:, None], 0.0)
        unexplained = (unexplained - rows[:, step].square()).clamp_min(0)
        unexplained[:, i] = 0
        chosen.append(i)
    return chosen


class _Point(NamedTuple):
    """A point of the search: hyperparameters and inducing points."""

    theta: Tensor  #: (k, d + 2)
    inducing: Tensor  #: Z (M, d)


class _NegativeBound:
    """Minus the collapsed bound of all outputs, over one vector.

    The vector holds the outputs' theta, and Z in units of the features' standard
    deviations.
    """

    def __init__(
        self, x: Tensor, y: Tensor, scales: Tensor, method: Method, iterations: int
    ):
        self._x = x
        self._y = y
        self._scales = scales
        self._method: Method = method
        self._max_iterations = iterations
        self._outputs = y.shape[1]
        self._theta_size = y.shape[1] * (x.shape[1] + 2)
        self.evaluations = 0
        # Of the present search: the start, or the best point evaluated since.
        self._best = np.empty(0)
        self._least = np.inf
        self._iterations = 0

    def pack(self, theta: np.ndarray, Z: Tensor) -> np.ndarray:
        """Writes the rows of theta (k, d + 2) and Z (M, d) to a vector."""
        return np.append(theta.ravel(), (Z / self._scales).numpy().ravel())

    def minimize(self, start: np.ndarray, unsearched: np.ndarray) -> np.ndarray:
        """Returns the best vector of a search by L-BFGS, in a box around the data.

        The box holds the start.

        Args:
            start: The vector where it begins.
            unsearched: Which entries of theta stay (k, d + 2).
        """
        self._best = start
        if not self._max_iterations:  # of none L-BFGS-B makes one
            return start
        minimize(
            self,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=self._bounds(start, unsearched),
            callback=self._report,
            options={
                "ftol": _TOLERANCE,
                "gtol": 1e-6,
                "maxiter": self._max_iterations,
                "maxfun": 3 * self._max_iterations + 1,
            },
        )
        return self._best

    def _bounds(self, start: np.ndarray, unsearched: np.ndarray) -> np.ndarray:
        """Lower and upper bounds of the vector in two columns."""
        log_scales = self._scales.log().numpy()
        boxes = [
            search_box(log_scales, math.log(output_std(targets)), _SIGNAL_TO_NOISE)
            for targets in self._y.numpy().T
        ]
        smallest = (self._x.amin(0) / self._scales).numpy()
        largest = (self._x.amax(0) / self._scales).numpy()
        margin = 0.1 * (largest - smallest)
        inducing = (len(start) - self._theta_size) // len(smallest)
        lower = np.concatenate(
            [*(box.lower for box in boxes), np.tile(smallest - margin, inducing)]
        )
        upper = np.concatenate(
            [*(box.upper for box in boxes), np.tile(largest + margin, inducing)]
        )
        lower = np.minimum(lower, start)
        upper = np.maximum(upper, start)
        stays = np.zeros(len(start), dtype=bool)
        stays[: self._theta_size] = unsearched.ravel()
        lower[stays] = start[stays]
        upper[stays] = start[stays]
        return np.column_stack([lower, upper])

    def unpack(self, vector: Tensor) -> _Point:
        """Reads the rows of theta (k, d + 2) and Z (M, d)."""
        theta = vector[: self._theta_size].reshape(self._outputs, -1)
        scaled = vector[self._theta_size :].reshape(-1, len(self._scales))
        return _Point(theta=theta, inducing=scaled * self._scales)

    def values(self, vector: np.ndarray) -> np.ndarray:
        """Computes minus the bound of every output (k,) at a vector.

        Infinite where a matrix is not positive definite.
        """
        with torch.no_grad():
            return self._evaluate(torch.from_numpy(vector)).numpy()

    def __call__(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        """Computes the sum over the outputs, and its gradient."""
        self.evaluations += 1
        variables = torch.from_numpy(vector.copy()).requires_grad_()
        with torch.enable_grad():
            total = self._evaluate(variables).sum()
            value = float(total.detach())
            gradient = np.full_like(vector, np.nan)
            if math.isfinite(value):
                total.backward()
                gradient = torch.as_tensor(variables.grad).numpy()
        if not np.isfinite(gradient).all():
            return FAILED, np.zeros_like(vector)
        if value < self._least:
            self._best = vector.copy()
            self._least = value
        return value, gradient

    def _report(self, _: np.ndarray) -> None:
        self._iterations += 1
        if self._iterations % _EVERY == 0:
            _log.info(
                "sparse training: iteration %d, minus the bound %.6g",
                self._iterations,
                self._least,
            )

    def _evaluate(self, vector: Tensor) -> Tensor:
        """Minus the bound of every output (k,)."""
        point = self.unpack(vector)
        try:
            return -collapsed_bound(
                point.inducing,
                self._x,
                self._y,
                Hyperparameters.from_theta(point.theta),
                method=self._method,
                jitter=JITTER,
            )
        except (SettingError, _LinAlgError):
            return torch.full((self._outputs,), torch.inf, dtype=torch.float64)
