"""Training of sparse GPs on thousands of transitions, hyperparameters and inducing points together.

The hyperparameters start where exact training on a random subset ends; the inducing points start greedily, each where
the outputs' conditional variances given those before it, in units of their noise, add up to the most (Burt, Rasmussen
and van der Wilk, 2020, section 4). What they leave unexplained, on average, is added to the noise. Then L-BFGS
maximises the collapsed bound over all of it, in O(N M^2) an output and evaluation.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gpmpc.exceptions import SettingError, TrainingError, check_choice, check_number
from gpmpc.gp._data_checks import (
    RESOLUTION,
    Columns,
    Constants,
    columns_of,
    warn_of_constants,
    warn_of_transitions,
)
from gpmpc.gp._kernel import Hyperparameters, Predicts, kernel_matrix
from gpmpc.gp._likelihood import FAILED
from gpmpc.gp._prior_scales import PriorLengthscale, PriorScales
from gpmpc.gp._scaling import Scaling, centre, identity
from gpmpc.gp._search import (
    TrainingData,
    column_std,
    log_hyperparameters,
    plain_theta,
    restored_theta,
    search_box,
    training_data,
)
from gpmpc.gp._sparse import (
    JITTER,
    Method,
    collapsed_bound,
    data_sums,
    inducing_factor,
    sparse_posterior,
)
from gpmpc.gp._training import Trainer, Training
from gpmpc.gp._transitions import Transitions, check_transitions
from gpmpc.gp._wrapped import warn_of_turns

_log = logging.getLogger(__name__)
_EVERY = 10  # iterations between two lines of the log
_TOLERANCE = 1e-7  # relative decrease of the objective at which L-BFGS stops
_SIGNAL_TO_NOISE = (
    1e4  # the box holds sf / sn within this factor of one, as that of ``Trainer``
)


@dataclass(frozen=True)
class SparseTrainer:
    """Fits one sparse SE-ARD GP per output, over inducing points that all share; progress is logged.

    Raises:
        SettingError: A setting is out of range.
    """

    inducing: int = 100  #: M; no more than there are distinct points
    #: ``"sgpr"`` (Titsias, 2009) never overfits and may overestimate the noise; ``"fitc"`` (Snelson and Ghahramani,
    #: 2006) has a noise of its own at every point and may underestimate it (Bauer, van der Wilk and Rasmussen, 2016)
    method: Method = "sgpr"
    predicts: Predicts = "next_state"  #: what the GPs learn, as in ``Trainer``
    #: how features and targets are scaled for training, as in ``Trainer``
    scaling: Callable[[Tensor, Sequence[str]], Scaling] = centre
    iterations: int = 100  #: of L-BFGS, at most
    subset: int = 200  #: number of random transitions in the first, exact, training
    restarts: int = 1  #: random starts of that one
    #: of features that never move in the data, and of outputs that never change; all
    #: three as in ``Trainer``
    prior_lengthscale: PriorLengthscale | Sequence[PriorLengthscale] | None = None
    prior_deviation: float | None = 1.0
    resolution: float = RESOLUTION

    def __post_init__(self) -> None:
        for key in ("inducing", "subset"):
            check_number(key, getattr(self, key), least=1, whole=True)
        check_number("iterations", self.iterations, least=0, whole=True)
        check_choice("method", self.method, get_args(Method))
        replace(self._exact(), scaling=self.scaling)  # which checks the others

    def __call__(self, transitions: Transitions, seed: int = 0) -> Training:
        """Trains on transitions; ``seed`` is that of the subset and of its random starts.

        Raises:
            TrainingError: No start of the subset's training succeeded for an output, which is named; or the inducing
                points learned nothing but noise of it where the subset's training learned more.
        """
        check_transitions(transitions)
        targets = transitions.targets(self.predicts)
        warn_of_transitions(transitions)
        warn_of_turns(transitions)
        training = self.fit(
            transitions.features,
            targets,
            transitions.input_dim,
            seed=seed,
            columns=columns_of(transitions, self.predicts),
        )
        return training.with_signals(transitions.signals)

    def fit(
        self,
        features: Tensor,
        targets: Tensor,
        input_dim: int,
        predicts: Predicts | None = None,
        seed: int = 0,
        columns: Columns | None = None,
    ) -> Training:
        """Trains on features x~ = (x, u) (N, n + m) and any targets (N, k).

        Arguments are those of ``Trainer.fit``.
        """
        begin = time.perf_counter()
        check_number("seed", seed, least=0, whole=True)
        predicts = predicts or self.predicts
        data = training_data(features, targets, input_dim, predicts, self.scaling)
        features, targets, feature_scaling, target_scaling = data
        if columns is None:
            columns = Columns.of(features, targets, input_dim, predicts)
        constants = Constants.of(features, targets, columns, self.resolution)
        prior = PriorScales.of(self, features.shape[1], columns.units)
        warn_of_constants(features, targets, columns, constants, prior, self.resolution)
        fixed = constants.outputs & (prior.deviations is not None)
        # A stationary kernel depends on differences; those from one of the points are exact, wherever the data lie.
        feature_scaling = Scaling(features[0], feature_scaling.factor)
        x = feature_scaling.scale(features)
        y = target_scaling.scale(targets)
        chosen = np.random.default_rng(seed).permutation(len(x))[: self.subset]
        unit = torch.from_numpy(column_std(features.numpy(), constants.features))
        unit = unit / feature_scaling.factor
        # Exact GPs of a subset, which may have seen at rest what moves elsewhere.
        part = TrainingData(
            features[chosen], y[chosen], identity(features), identity(y)
        )
        at_rest = Constants.of(
            features[chosen], targets[chosen], columns, self.resolution
        )
        exact = self._exact().fit_known(
            part,
            at_rest,
            prior.of_scaled_targets(target_scaling),
            input_dim,
            "value",
            seed,
        )
        theta = log_hyperparameters(exact.posterior, feature_scaling, identity(y))
        moving = at_rest.features & ~constants.features
        theta[:, :-2][:, moving] = np.log(unit.numpy())[moving]
        for a in np.flatnonzero(at_rest.outputs & ~constants.outputs):
            theta[a] = plain_theta(unit.numpy(), y[:, a].numpy())
        Z = x[
            informative_points(
                x, Hyperparameters.from_theta(torch.from_numpy(theta)), self.inducing
            )
        ]
        text = "sparse training: %d inducing points chosen among %d after %.1f s"
        _log.info(text, len(Z), len(x), time.perf_counter() - begin)
        theta = self._with_unexplained(theta, Z, x, y)
        unsearched = np.zeros(theta.shape, dtype=bool)
        unsearched[fixed] = True
        unsearched[:, :-2][:, constants.features] = True
        bound = _Bound(self, x, y, unit, theta, Z, unsearched)
        initial = bound.values()
        bound.maximize()
        if failed := np.flatnonzero(~np.isfinite(objective := bound.values())).tolist():
            raise TrainingError(
                failed,
                "the inducing points' kernel matrix is not positive definite: take fewer",
            )
        gains = _noise_alone(y) - objective
        gains[fixed] = np.inf  # there is nothing to learn of them
        self._check_learned(
            gains,
            _noise_alone(y[chosen]) - exact.objective,
            x.shape[1] + 2,
        )
        theta, Z = bound.parts(torch.from_numpy(bound.best))
        kernel = Hyperparameters.from_theta(theta)
        scaled = sparse_posterior(
            Z, x, y, kernel, input_dim, predicts, self.method, JITTER
        )
        posterior = scaled.unscaled(feature_scaling, target_scaling)
        theta = restored_theta(theta.numpy(), feature_scaling, target_scaling)
        return Training(
            posterior,
            theta,
            objective,
            initial[:, None],
            bound.evaluations,
            time.perf_counter() - begin,
        )

    def _with_unexplained(
        self, theta: np.ndarray, Z: Tensor, x: Tensor, y: Tensor
    ) -> np.ndarray:
        """Adds to the noise what the inducing points leave unexplained of the signal, on average.

        Else the bound is so low where the search begins that its first step leaves for a model of noise alone.
        """
        if self.method == "fitc":  # has that noise of its own
            return theta
        kernel = Hyperparameters.from_theta(torch.from_numpy(theta))
        _, sf2, sn2 = kernel
        with torch.no_grad():
            sums = data_sums(
                inducing_factor(Z, kernel, JITTER), Z, x, y, kernel, self.method
            )
        explained = sums.gram.diagonal(dim1=-2, dim2=-1).sum(-1)
        sn2 = sn2 + (sf2 - explained * sn2 / len(x)).clamp_min(0)
        return np.column_stack([theta[:, :-1], (sf2 / sn2).log().numpy() / 2])

    def _check_learned(
        self, gains: np.ndarray, exact_gains: np.ndarray, parameters: int
    ) -> None:
        """Raises, or warns in the log, where the GPs are no better than noise alone.

        Gains are log evidence over that of noise alone (k,), ``exact_gains`` those of the exact GPs of the subset; one
        below the number of an output's parameters is none (Akaike, 1974).
        """
        nothing = [a for a, gain in enumerate(gains) if -np.inf < gain < parameters]
        failed = [a for a in nothing if exact_gains[a] > parameters]
        if failed:
            raise TrainingError(
                failed,
                f"{self.inducing} inducing points learned nothing but noise of output {', '.join(map(str, failed))}, "
                f"where exact GPs of {self.subset} points learned more: raise inducing",
            )
        if nothing:
            _log.warning(
                "sparse training: nothing but noise was found in output %s",
                ", ".join(map(str, nothing)),
            )

    def _exact(self) -> Trainer:
        return Trainer(
            predicts=self.predicts,
            scaling=identity,
            restarts=self.restarts,
            tolerance=_TOLERANCE,
            prior_lengthscale=self.prior_lengthscale,
            prior_deviation=self.prior_deviation,
            resolution=self.resolution,
        )


def _noise_alone(targets: Tensor) -> np.ndarray:
    """The least negative log evidence (k,) of targets (N, k) as noise alone; minus infinity where all are zero."""
    return (
        len(targets) / 2 * (2 * math.pi * math.e * targets.square().mean(0)).log()
    ).numpy()


def informative_points(
    features: Tensor, hyperparameters: Sequence[Tensor], count: int
) -> list[int]:
    """Chooses rows of features (N, d): each where most is unexplained by those before it.

    A pivoted Cholesky factorisation of sum_a K_a / sn2_a's diagonal. Fewer than ``count`` come back where nothing is
    left to explain: less than round-off of every output's variance.
    """
    lengthscales, signal_variance, noise_variance = hyperparameters
    left = signal_variance[:, None].repeat(1, len(features))
    rows = features.new_zeros(
        len(lengthscales), min(count, len(features)), len(features)
    )
    chosen: list[int] = []
    for step in range(rows.shape[1]):
        i = int((left / noise_variance[:, None]).sum(0).argmax())
        if bool((left[:, i] <= 1e-10 * signal_variance).all()):
            break
        row = kernel_matrix(
            features[i : i + 1], features, lengthscales, signal_variance
        )[:, 0]
        row = row - (rows[:, :step, i][:, None, :] @ rows[:, :step])[:, 0]
        # An output to which this point is nothing new gives a row of round-off: none, rather.
        new = left[:, i] > 1e-10 * signal_variance
        rows[:, step] = torch.where(
            new[:, None], row / left[:, i].clamp_min(1e-300).sqrt()[:, None], 0.0
        )
        left = (left - rows[:, step].square()).clamp_min(0)
        left[:, i] = 0
        chosen.append(i)
    return chosen


class _Bound:
    """Minus the collapsed bound of all outputs over one vector: their theta, and Z in units of the features' spread."""

    def __init__(
        self,
        trainer: SparseTrainer,
        x: Tensor,
        y: Tensor,
        unit: Tensor,
        theta: np.ndarray,
        Z: Tensor,
        unsearched: np.ndarray,
    ):
        self._unsearched = unsearched  # entries of theta (k, d + 2) that stay
        self._trainer = trainer
        self._x = x
        self._y = y
        self._unit = unit
        self._shape = theta.shape
        self.best = np.append(
            theta.ravel(), (Z / unit).numpy().ravel()
        )  #: the start, or the best point evaluated since
        self.evaluations = 0
        self._least = np.inf
        self._iterations = 0

    def maximize(self) -> None:
        """Searches by L-BFGS in a box around the data that holds the start."""
        log_inputs = self._unit.log().numpy()
        trainer = self._trainer
        boxes = [
            search_box(log_inputs, own, _SIGNAL_TO_NOISE)
            for own in np.log(column_std(self._y.numpy()))
        ]
        smallest, largest = (
            (edge / self._unit).numpy() for edge in (self._x.amin(0), self._x.amax(0))
        )
        margin = 0.1 * (largest - smallest)
        count = (len(self.best) - self._shape[0] * self._shape[1]) // len(smallest)
        lower, upper = (np.concatenate(side) for side in zip(*boxes, strict=True))
        lower = np.minimum(
            np.append(lower, np.tile(smallest - margin, count)), self.best
        )
        upper = np.maximum(
            np.append(upper, np.tile(largest + margin, count)), self.best
        )
        stays = np.append(
            self._unsearched.ravel(),
            np.zeros(self.best.size - self._unsearched.size, dtype=bool),
        )
        lower[stays] = upper[stays] = self.best[stays]
        if self._trainer.iterations:  # of none L-BFGS-B makes one
            limits = {
                "maxiter": trainer.iterations,
                "maxfun": 3 * trainer.iterations + 1,
            }
            minimize(
                self,
                self.best,
                jac=True,
                method="L-BFGS-B",
                bounds=np.column_stack([lower, upper]),
                callback=self._report,
                options={"ftol": _TOLERANCE, "gtol": 1e-6, **limits},
            )

    def parts(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """Rows of theta (k, d + 2) and Z (M, d)."""
        split = self._shape[0] * self._shape[1]
        return vector[:split].reshape(self._shape), vector[split:].reshape(
            -1, len(self._unit)
        ) * self._unit

    def values(self) -> np.ndarray:
        """Minus the bound of every output (k,) at the best point; infinite where a matrix is not positive definite."""
        with torch.no_grad():
            return self._bounds(torch.from_numpy(self.best)).numpy()

    def __call__(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        """The sum over the outputs, and its gradient."""
        self.evaluations += 1
        variables = torch.from_numpy(vector.copy()).requires_grad_()
        with torch.enable_grad():
            total = self._bounds(variables).sum()
            value = float(total.detach())
            gradient = np.full_like(vector, np.nan)
            if math.isfinite(value):
                total.backward()
                gradient = torch.as_tensor(variables.grad).numpy()
        if not np.isfinite(gradient).all():
            return FAILED, np.zeros_like(vector)
        if value < self._least:
            self.best = vector.copy()
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

    def _bounds(self, vector: Tensor) -> Tensor:
        theta, Z = self.parts(vector)
        try:
            kernel = Hyperparameters.from_theta(theta)
            return -collapsed_bound(
                Z, self._x, self._y, kernel, self._trainer.method, JITTER
            )
        except (SettingError, torch.linalg.LinAlgError):  # pyright: ignore[reportPrivateImportUsage]
            return torch.full(self._shape[:1], torch.inf, dtype=torch.float64)
