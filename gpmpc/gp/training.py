"""Problem: find every output's hyperparameters by maximum marginal likelihood, reliably, on nearly noise-free data.

Each output is fitted on its own by L-BFGS (Byrd, Lu, Nocedal and Zhu, 1995; scipy's L-BFGS-B) over
theta = (log length-scales, log sf, log(sf / sn)) inside a wide box. The likelihood has local optima that differ by a
factor of a hundred in prediction error, so the search explores a few iterations from the paper's starting point and
from random ones, and goes on to convergence from the best two. (Measured on the paper's data: a single start without
exploration reached the best known optimum for about 75 % of the outputs; four starts and two finalists for about 98 %,
at two and a half times the evaluations.)

Cao, Lai and Alam (2017), eq. (9); the penalty is the one of their experiment.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from scipy.optimize import minimize

from gpmpc.exceptions import SettingError, ShapeError, TrainingError, UnsupportedModel, check_number
from gpmpc.gp.evidence import LogEvidence
from gpmpc.gp.model import BatchExactGP, GPyTorchEvidence
from gpmpc.gp.penalties import Penalty
from gpmpc.gp.posterior import IGNORED, GPPosterior, Predicts
from gpmpc.gp.scaling import Scaling, identity
from gpmpc.gp.transitions import Transitions

Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]


EXPLORATION = 16  # L-BFGS iterations from every start, before ...
FINALISTS = 2  # ... this many of the best go on to convergence
LONGER = 1.0  # mean of log l over log std(x~) at the random starts: smooth dynamics prefer long length-scales
CONSTANT = 1e-8  # a column that moves by less than this part of its magnitude is constant
FAILED = 1e12  # objective where the kernel matrix is not positive definite: finite, so that a line search steps back


@dataclass(frozen=True)
class Training:
    """What training found.

    Attributes:
        posterior: The trained GPs, frozen.
        theta: Rows (log l, log sf, log(sf / sn)), one an output (n, d + 2), in the units of the data.
        objective: Negative log marginal likelihood plus penalty where the search ended (n,).
        explored: The same where the exploration from every start ended (n, restarts + 1); ``FAILED`` where none could.
        evaluations: Likelihood evaluations, all starts and outputs together.
        seconds: Wall time [s].
    """

    posterior: GPPosterior
    theta: np.ndarray
    objective: np.ndarray
    explored: np.ndarray
    evaluations: int
    seconds: float  # [s]

    def gpytorch_model(self) -> BatchExactGP:
        """The same GPs as a GPyTorch model, to go on with there."""
        model = BatchExactGP(self.posterior.features, self.posterior.targets - self.posterior.offset)
        model.set_hyperparameters(torch.from_numpy(self.theta))
        return model.eval()


@dataclass(frozen=True)
class Trainer:
    """Fits one SE-ARD GP per output to observed transitions.

    Attributes:
        predicts: What the GPs learn: the next state, or the difference to it.
        scaling: How features and targets are scaled for training, such as ``standardize``; what comes out is in the
            units of the data all the same. Without it the prior mean is zero in those units.
        penalty: Added to every output's negative log marginal likelihood; none by default.
        restarts: Random starts besides the first, which has l = std(x~), sf = std(y), sn = std(y) / 10.
        likelihood: How it is evaluated: in closed form, or by GPyTorch's automatic differentiation (slower; the same).
        tolerance: Relative decrease of the objective at which L-BFGS stops.
        lengthscale_limit: The box holds length-scales within this factor of their input's spread.
        signal_to_noise_limit: The box holds sf / sn within this factor of one. Moment matching needs sf2 / sn2 below
            about 1e10 in double precision.

    Raises:
        SettingError: Fewer than no restarts, an unknown ``likelihood`` or ``predicts``, a tolerance that is not
            positive, or a limit of 1 or less.
    """

    predicts: Predicts = "next_state"
    scaling: Callable[[torch.Tensor, Sequence[str]], Scaling] = identity
    penalty: Penalty | None = None
    restarts: int = 3
    likelihood: Literal["closed_form", "gpytorch"] = "closed_form"
    tolerance: float = 1e-8
    lengthscale_limit: float = 1e4
    signal_to_noise_limit: float = 1e4

    def __post_init__(self) -> None:
        if self.predicts not in ("next_state", "difference"):
            raise SettingError("predicts", f"must be 'next_state' or 'difference'; got {self.predicts!r}")
        check_number("restarts", self.restarts, least=0, whole=True)
        if self.likelihood not in ("closed_form", "gpytorch"):
            raise SettingError("likelihood", f"must be 'closed_form' or 'gpytorch'; got {self.likelihood!r}")
        for key, least in (("tolerance", 0), ("lengthscale_limit", 1), ("signal_to_noise_limit", 1)):
            check_number(key, getattr(self, key), above=least)

    def __call__(self, transitions: Transitions, seed: int = 0, start: GPPosterior | None = None) -> Training:
        """Trains on transitions; see ``fit``."""
        learned = transitions.next_states
        if self.predicts == "difference":
            learned = learned - transitions.states
        return self.fit(transitions.features, learned, transitions.input_dim, self.predicts, seed, start)

    def refit(self, posterior: GPPosterior, transitions: Transitions | None = None, seed: int = 0) -> Training:
        """Trains on the points a posterior holds, and on new ones, from its hyperparameters on.

        With ``restarts=0`` only from them on. The prior mean is that of this trainer's scaling, as in any training.

        Args:
            posterior: What was learned so far; what it predicts and its number of inputs stay.
            transitions: Seen besides, if given.
            seed: Of the random starts.

        Raises:
            UnsupportedModel: The posterior stands on a sparse model's pseudo-observations.
            ShapeError: The transitions have other dimensions.
            TrainingError: Every start failed for an output, which is named.
        """
        if not posterior.exact:
            raise UnsupportedModel(
                "the posterior holds a sparse model's pseudo-observations, no data: train again with SparseTrainer"
            )
        features, targets = (t.to("cpu", torch.float64) for t in (posterior.features, posterior.targets))
        if transitions is not None:
            features = torch.cat([features, transitions.features])
            targets = torch.cat([targets, posterior.learned(transitions)])
        return self.fit(features, targets, posterior.input_dim, posterior.predicts, seed, start=posterior)

    def fit(
        self,
        features: torch.Tensor,
        targets: torch.Tensor,
        input_dim: int,
        predicts: Predicts,
        seed: int = 0,
        start: GPPosterior | None = None,
    ) -> Training:
        """Trains on features and any targets.

        Args:
            features: x~ = (x, u) (N, n + m).
            targets: (N, k).
            input_dim: m.
            predicts: What the targets mean.
            seed: Of the random starts.
            start: Its hyperparameters are the first start instead; the random ones stay where they are.

        Raises:
            ShapeError: ``start`` has other dimensions.
            TrainingError: Every start failed for an output, which is named.
        """
        begin = time.perf_counter()
        names = [f"x{i + 1}" for i in range(features.shape[1] - input_dim)]
        names += [f"u{i + 1}" for i in range(input_dim)]
        feature_scaling = self.scaling(features, names)
        target_scaling = self.scaling(targets, [f"y{a + 1}" for a in range(targets.shape[1])])
        inputs, targets = feature_scaling.scale(features).numpy(), target_scaling.scale(targets).numpy()
        outputs, d = targets.shape[1], inputs.shape[1]
        rng = np.random.default_rng(seed)
        first: list[np.ndarray | None] = [None] * outputs
        if start is not None:
            first = list(log_hyperparameters(start, feature_scaling, target_scaling))
        perturbations = rng.normal(size=(outputs, self.restarts + 1, d + 2))
        fits = [self._fit(inputs, targets[:, a], perturbations[a], first[a]) for a in range(outputs)]
        failed = [a for a, fit in enumerate(fits) if fit.objective >= FAILED]
        if failed:
            raise TrainingError(
                failed,
                f"no start of {self.restarts + 1} led to a positive definite kernel matrix for output "
                f"{', '.join(str(a) for a in failed)}: lower signal_to_noise_limit, or remove duplicate rows",
            )
        theta = np.array([fit.theta for fit in fits])
        found = torch.from_numpy(theta)
        posterior = GPPosterior.from_hyperparameters(
            torch.from_numpy(inputs),
            torch.from_numpy(targets),
            lengthscales=found[:, :-2].exp(),
            signal_variance=(2 * found[:, -2]).exp(),
            noise_variance=(2 * (found[:, -2] - found[:, -1])).exp(),
            input_dim=input_dim,
            predicts=predicts,
        ).unscaled(feature_scaling, target_scaling)
        theta[:, :-2] += feature_scaling.factor.log().numpy()
        theta[:, -2] += target_scaling.factor.log().numpy()
        return Training(
            posterior,
            theta,
            objective=np.array([fit.objective for fit in fits]),
            explored=np.array([fit.explored for fit in fits]),
            evaluations=sum(fit.evaluations for fit in fits),
            seconds=time.perf_counter() - begin,
        )

    def _fit(
        self, inputs: np.ndarray, targets: np.ndarray, perturbations: np.ndarray, given: np.ndarray | None
    ) -> "_Fit":
        """Fits one output, targets (N,), from the first start and from perturbations (restarts + 1, d + 2) of it."""
        log_inputs, log_output = np.log(spread(inputs)), np.log(spread(targets[:, None])[0])
        centre = np.append(log_inputs, [log_output, 0.0])
        reach = np.append(
            np.full(inputs.shape[1], np.log(self.lengthscale_limit)), [np.log(1e6), np.log(self.signal_to_noise_limit)]
        )
        search = _Search(_objective(self.likelihood, inputs, targets, self.penalty, log_inputs), centre, reach)
        first = np.append(log_inputs, [log_output, np.log(10.0)])
        longer = np.append(np.full(inputs.shape[1], LONGER), [0.0, 0.0])
        starts = [first if given is None else given, *(first + longer + shift for shift in perturbations[1:])]

        ends = [search(start, EXPLORATION, self.tolerance) for start in starts]
        finalists = sorted(ends, key=lambda end: end[1])[:FINALISTS]
        theta, value = min((search(end, 1000, self.tolerance) for end, _ in finalists), key=lambda end: end[1])
        # Nothing can be learned about an input that never moved, and nothing is: it drops out of the kernel.
        constant = np.ptp(inputs, axis=0) <= CONSTANT * np.abs(inputs).max(axis=0)
        theta[:-2][constant] = log_inputs[constant] + np.log(IGNORED)
        return _Fit(theta, value, [end[1] for end in ends], search.evaluations)


def train(transitions: Transitions, seed: int = 0, **settings: Any) -> Training:
    """``Trainer(**settings)(transitions, seed)``: fits one GP per output in one call."""
    return Trainer(**settings)(transitions, seed)


@dataclass(frozen=True)
class _Fit:
    """What was found for one output."""

    theta: np.ndarray
    objective: float
    explored: list[float]
    evaluations: int


class _Search:
    """L-BFGS in a box around ``centre``; counts the evaluations."""

    def __init__(self, objective: Objective, centre: np.ndarray, reach: np.ndarray):
        self.objective, self.lower, self.upper = objective, centre - reach, centre + reach
        self.evaluations = 0

    def __call__(self, start: np.ndarray, iterations: int, tolerance: float) -> tuple[np.ndarray, float]:
        """The end point and its objective."""
        outcome = minimize(
            self.objective,
            np.clip(start, self.lower, self.upper),
            jac=True,
            method="L-BFGS-B",
            bounds=np.column_stack([self.lower, self.upper]),
            options={"ftol": tolerance, "gtol": 1e-6, "maxiter": iterations, "maxfun": 5 * iterations},
        )
        self.evaluations += outcome.nfev
        return outcome.x, float(outcome.fun)


def log_hyperparameters(posterior: GPPosterior, features: Scaling, targets: Scaling) -> np.ndarray:
    """Rows (log l, log sf, log(sf / sn)), one an output (k, d + 2), of a posterior, in scaled units.

    Raises:
        ShapeError: The scalings belong to other dimensions.
    """
    k, d = len(targets.factor), len(features.factor)
    if posterior.lengthscales.shape != (k, d):
        got = tuple(posterior.lengthscales.shape[::-1])
        raise ShapeError(
            f"the posterior to start from must have {d} features and {k} outputs; got {got[0]} and {got[1]}"
        )
    length, sf2, sn2 = (
        t.to("cpu", torch.float64)
        for t in (posterior.lengthscales, posterior.signal_variance, posterior.noise_variance)
    )
    columns = [
        (length / features.factor).log(),
        (sf2.sqrt() / targets.factor).log()[:, None],
        (sf2 / sn2).log()[:, None] / 2,
    ]
    return torch.cat(columns, dim=1).numpy()


def spread(columns: np.ndarray) -> np.ndarray:
    """The standard deviation (d,) of columns (N, d); of a constant column its magnitude, or 1 where that is 0."""
    magnitude = np.abs(columns).max(axis=0)
    magnitude = np.where(magnitude > 0, magnitude, 1.0)
    relative = (columns / magnitude).std(axis=0, ddof=1) if len(columns) > 1 else np.zeros_like(magnitude)
    return magnitude * np.where(relative > CONSTANT, relative, 1.0)


def _objective(
    likelihood: str, inputs: np.ndarray, targets: np.ndarray, penalty: Penalty | None, log_spread: np.ndarray
) -> Objective:
    """Negative log marginal likelihood plus penalty of one output over theta."""
    if likelihood == "closed_form":
        evidence = LogEvidence(inputs, targets)
    else:
        batch = GPyTorchEvidence(BatchExactGP(torch.from_numpy(inputs), torch.from_numpy(targets)[:, None]))

        def evidence(theta: np.ndarray) -> tuple[float, np.ndarray]:
            values, gradients = batch(theta[None])
            return values[0], gradients[0]

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        with np.errstate(over="ignore", invalid="ignore"):
            value, gradient = evidence(theta)
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            return FAILED, np.zeros_like(theta)
        if penalty is not None:
            wall, slope = penalty(theta, log_spread)
            value, gradient = value + wall, gradient + slope
        return value, gradient

    return objective
