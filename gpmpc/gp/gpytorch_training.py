"""Problem: train a GPyTorch ExactGP of any kernel without meeting its traps.

The exact marginal likelihood (Rasmussen and Williams, 2006, eq. (2.30); with the priors of the model's parameters, if
it has any) is maximised over all parameters that require a gradient by scipy's L-BFGS-B. Left alone, GPyTorch turns to
stochastic estimates above 800 points, adds jitter without a word, and torch's own L-BFGS may walk into NaN; here a
failed evaluation is a wall from which the line search steps back.
"""

import time
from dataclasses import dataclass
from typing import Any

import gpytorch
import numpy as np
import torch
from scipy.optimize import minimize

from gpmpc.exceptions import TrainingError, check_number
from gpmpc.gp.hyperparameter_search import FAILED
from gpmpc.gp.model import exact_inference, members


@dataclass(frozen=True)
class Fit:
    """What ``fit`` found, one entry a model.

    Attributes:
        objective: Negative log marginal likelihood, all outputs of a batch together, minus log priors.
        explored: The same from every start; ``FAILED`` where there was none.
        evaluations: All starts and models together.
        seconds: Wall time [s].
    """

    objective: np.ndarray
    explored: np.ndarray
    evaluations: int
    seconds: float  # [s]


def fit(
    model: Any,
    likelihood: Any = None,
    *,
    restarts: int = 0,
    iterations: int = 500,
    tolerance: float = 1e-8,
    seed: int = 0,
) -> Fit:
    """Trains models in place, from their present parameters, and leaves them in evaluation mode.

    Args:
        model: An ``ExactGP`` in float64 (single or batch), an ``IndependentModelList``, or a sequence of models.
        likelihood: Its ``GaussianLikelihood``, or a list of them; the models' own by default.
        restarts: Random starts besides the present one: normal steps of one from it in the raw parameters.
        iterations: Of L-BFGS from every start, at most.
        tolerance: Relative decrease of the objective at which L-BFGS stops.
        seed: Of the random starts.

    Raises:
        TrainingError: Every start failed for a model; its outputs are named, and its parameters are as they were.
        SettingError: A setting is out of range, or a model is not in float64.
        UnsupportedModel: It is no single-task ``ExactGP`` with a ``GaussianLikelihood``.
    """
    check_number("restarts", restarts, least=0, whole=True)
    check_number("iterations", iterations, least=1, whole=True)
    check_number("tolerance", tolerance, above=0)
    begin, rng, first = time.perf_counter(), np.random.default_rng(seed), 0
    explored, evaluations = [], 0
    for one, own in members(model, likelihood):
        objective = _Objective(one, own)
        outputs = one.train_targets.shape[0] if one.train_targets.dim() > 1 else 1
        present = objective.vector()
        starts = [present, *(present + rng.normal(size=(restarts, len(present))))]
        options = {"ftol": tolerance, "gtol": 1e-6, "maxiter": iterations, "maxfun": 5 * iterations}
        ends = [minimize(objective, start, jac=True, method="L-BFGS-B", options=options) for start in starts]
        best = min(ends, key=lambda end: end.fun)
        evaluations += sum(end.nfev for end in ends)
        if best.fun >= FAILED:
            objective.write(present)
            names = ", ".join(str(a) for a in range(first, first + outputs))
            raise TrainingError(
                list(range(first, first + outputs)),
                f"no start of {restarts + 1} led to a positive definite kernel matrix for output {names}: "
                "raise the noise or its lower limit, remove duplicate rows, or scale the data",
            )
        objective.write(best.x)
        one.eval()
        own.eval()
        explored.append([end.fun for end in ends])
        first += outputs
    found = np.array(explored)
    return Fit(found.min(axis=1), found, evaluations, time.perf_counter() - begin)


class _Objective:
    """The negative log marginal likelihood over the vector of all raw parameters."""

    def __init__(self, model: Any, likelihood: Any):
        self.model = model
        model.train()
        likelihood.train()
        self.likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
        # A likelihood that is not the model's own has parameters of its own; nothing twice.
        both = [*model.parameters(), *likelihood.parameters()]
        self.parameters = list({id(p): p for p in both if p.requires_grad}.values())
        self.size = model.train_targets.shape[-1]

    def vector(self) -> np.ndarray:
        return torch.cat([p.detach().reshape(-1) for p in self.parameters]).to("cpu", torch.float64).numpy().copy()

    def write(self, vector: np.ndarray) -> None:
        pieces = torch.from_numpy(vector).split([p.numel() for p in self.parameters])
        with torch.no_grad():
            for parameter, piece in zip(self.parameters, pieces, strict=True):
                parameter.copy_(piece.reshape(parameter.shape))

    def __call__(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        self.write(vector)
        for parameter in self.parameters:
            parameter.grad = None
        try:
            with exact_inference(), torch.enable_grad():
                # GPyTorch divides by the number of points.
                value = (
                    -self.likelihood(self.model(*self.model.train_inputs), self.model.train_targets).sum() * self.size
                )
                value.backward()
        except (gpytorch.utils.errors.NotPSDError, gpytorch.utils.errors.NanError, torch.linalg.LinAlgError):
            return FAILED, np.zeros_like(vector)
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.parameters]
        gradient = torch.cat([g.reshape(-1) for g in gradients]).to("cpu", torch.float64).numpy()
        total = float(value.detach())
        if not (np.isfinite(total) and np.isfinite(gradient).all()):
            return FAILED, np.zeros_like(vector)
        return total, gradient
