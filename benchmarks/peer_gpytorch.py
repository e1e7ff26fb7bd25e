"""A GPyTorch model, autograd through its rollout, and SciPy's SLSQP.

The cost of a plan is rolled out through the model's own predictions, its gradient comes
from ``backward``, and SLSQP (Kraft, 1988) keeps the inputs in their box. Predictions of
the mean alone, from GPyTorch's cache, no parameter with a gradient: what such a user
would do after reading the manual.
"""

from typing import NamedTuple

import gpytorch
import numpy as np
import torch
from scipy.optimize import minimize

from benchmarks.kkt import Instance
from benchmarks.peer_casadi import check_problem
from gpmpc.gp import GPPosterior, exact_inference, to_gpytorch
from gpmpc.mpc import Problem


class Plan(NamedTuple):
    """A plan (H, m)."""

    inputs: np.ndarray


class GPyTorchSlsqp:
    """Solves one tracking problem after the other on the mean of GPs.

    Args:
        gp: The GPs, of next states or differences.
        problem: Weights of increments, and bounds of the inputs.
        horizon: H.
        tolerance: SLSQP's, of the cost.

    Raises: SettingError: The problem weighs something else than increments, or bounds
        more than inputs.
    """

    def __init__(
        self, gp: GPPosterior, problem: Problem, horizon: int, tolerance: float
    ):
        check_problem(problem)
        self._model = to_gpytorch(gp).requires_grad_(False)
        self._adds_state = gp.predicts == "difference"
        self._horizon = horizon
        self._tolerance = tolerance
        self._Q, self._R, self._terminal = map(
            torch.from_numpy, (problem.cost.Q, problem.cost.R, problem.cost.terminal)
        )
        self._bounds = (
            list(zip(problem.inputs.lower, problem.inputs.upper, strict=True)) * horizon
        )

    def __call__(self, instance: Instance, last: Plan | None) -> Plan:
        """Plans along a reference, started from the last plan, shifted."""
        start = np.tile(instance.last, (self._horizon, 1))
        if last is not None:
            start = np.concatenate([last.inputs[1:], last.inputs[-1:]])
        targets = torch.from_numpy(instance.targets)
        before = torch.from_numpy(np.array(instance.last))

        def cost(plan: np.ndarray) -> tuple[float, np.ndarray]:
            inputs = torch.tensor(plan.reshape(start.shape), requires_grad=True)
            total = self._cost(instance.belief.mean, before, inputs, targets)
            total.backward()
            return float(total.detach()), inputs.grad.numpy().ravel()

        options = {"maxiter": 200, "ftol": self._tolerance}
        with exact_inference(), gpytorch.settings.skip_posterior_variances():
            result = minimize(
                cost,
                start.ravel(),
                jac=True,
                method="SLSQP",
                bounds=self._bounds,
                options=options,
            )
        return Plan(result.x.reshape(start.shape))

    def _cost(
        self,
        x: torch.Tensor,
        last: torch.Tensor,
        inputs: torch.Tensor,
        targets: torch.Tensor,
    ) -> torch.Tensor:
        increments = torch.diff(inputs, dim=0, prepend=last[None])
        total = (increments @ self._R * increments).sum()
        for k, target in enumerate(targets):
            prediction = self._model(torch.cat([x, inputs[k]])[None]).mean[:, 0]
            x = x + prediction if self._adds_state else prediction
            total = total + (x - target) @ (
                self._terminal if k + 1 == len(targets) else self._Q
            ) @ (x - target)
        return total
