"""Problem: the likelihood of one output has local optima that differ by a factor of a hundred in prediction error.

So the search explores a few iterations of L-BFGS (Byrd, Lu, Nocedal and Zhu, 1995; scipy's L-BFGS-B) from the paper's
starting point and from random ones, and goes on to convergence from the best two. (Measured on the paper's data: a
single start without exploration reached the best known optimum for about 75 % of the outputs; four starts and two
finalists for about 98 %, at two and a half times the evaluations.)

An evaluation costs O(N^3), and where the optimum lies a part of the points already knows. So of many points all of this
sees a random subset, and one more search goes on from what it found over all of them: some twenty evaluations instead
of the some hundred and fifty.

theta = (log length-scales, log sf, log(sf / sn)), in a wide box around the data's spread.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.optimize import minimize

from gpmpc.gp.evidence import LogEvidence
from gpmpc.gp.evidence_in_place import InPlaceEvidence
from gpmpc.gp.kernel import centred
from gpmpc.gp.model import BatchExactGP, GPyTorchEvidence
from gpmpc.gp.penalties import Penalty
from gpmpc.gp.posterior import IGNORED

if TYPE_CHECKING:
    from gpmpc.gp.training import Trainer

log = logging.getLogger(__name__)
Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]

EXPLORATION = 16  # L-BFGS iterations from every start, before ...
FINALISTS = 2  # ... this many of the best go on to convergence
ITERATIONS = 1000  # of the search to convergence, at most
LONGER = 1.0  # mean of log l over log std(x~) at the random starts: smooth dynamics prefer long length-scales
CONSTANT = 3e-9  # of its magnitude: a column that moves by no more holds a solver's residue (1e-9); 1e8 +- 0.5 moves
FAILED = 1e12  # objective where the kernel matrix is not positive definite: finite, so that a line search steps back
IN_PLACE = 400  # from as many points on one matrix for everything is the faster way as well
TOLD = 5.0  # seconds between two lines of the log


@dataclass(frozen=True)
class Task:
    """One output to be fitted; everything in scaled units.

    Attributes:
        name: For the log, such as "output 2 of 6".
        inputs: x~ (N, d).
        targets: (N,).
        first: theta of the first start (d + 2,); None takes l = std(x~), sf = std(y), sn = std(y) / 10.
        perturbations: Standard normal (restarts + 1, d + 2); the first row is not used.
        rows: The subset that the search begins with; None for all points from the start.
        spread: Of the inputs (d,), see ``spread``.
        constant: Which inputs are (d,).
    """

    name: str
    inputs: np.ndarray
    targets: np.ndarray
    first: np.ndarray | None
    perturbations: np.ndarray
    rows: np.ndarray | None
    spread: np.ndarray
    constant: np.ndarray


@dataclass(frozen=True)
class Found:
    """What the search for one output ended with; see ``gpmpc.gp.training.Training``."""

    theta: np.ndarray
    objective: float
    explored: list[float]
    evaluations: int
    seconds: float  # [s]


def find_hyperparameters(task: Task, trainer: "Trainer") -> Found:
    """Searches for one output with a trainer's settings; ``objective`` is ``FAILED`` or more where no start led on."""
    begin = time.perf_counter()
    inputs, targets = task.inputs, task.targets
    log_inputs, log_output = np.log(task.spread), np.log(spread(targets[:, None])[0])
    centre = np.append(log_inputs, [log_output, 0.0])
    reach = np.append(
        np.full(inputs.shape[1], np.log(trainer.lengthscale_limit)),
        [np.log(1e6), np.log(trainer.signal_to_noise_limit)],
    )

    def over(rows: np.ndarray | slice) -> _Search:
        x, y = inputs[rows], targets[rows]
        objective = _objective(trainer.likelihood, x, y, trainer.penalty, log_inputs)
        return _Search(f"{task.name}, {len(y)} points", objective, centre, reach, trainer.tolerance)

    first = np.append(log_inputs, [log_output, np.log(10.0)])
    longer = np.append(np.full(inputs.shape[1], LONGER), [0.0, 0.0])
    starts = [first if task.first is None else task.first]
    starts += [first + longer + shift for shift in task.perturbations[1:]]

    search = over(slice(None) if task.rows is None else task.rows)
    ends = [search(start, EXPLORATION) for start in starts]
    finalists = sorted(ends, key=lambda end: end[1])[:FINALISTS]
    theta, value = min((search(end, ITERATIONS) for end, _ in finalists), key=lambda end: end[1])
    evaluations = search.evaluations
    if task.rows is not None:
        search = over(slice(None))
        theta, value = search(theta, ITERATIONS)
        evaluations += search.evaluations
    # Nothing can be learned about an input that never moved, and nothing is: it drops out of the kernel.
    theta[:-2][task.constant] = log_inputs[task.constant] + np.log(IGNORED)
    return Found(theta, value, [end[1] for end in ends], evaluations, time.perf_counter() - begin)


class _Search:
    """L-BFGS in a box around ``centre``; counts the evaluations, and tells of them where they take long."""

    def __init__(self, name: str, objective: Objective, centre: np.ndarray, reach: np.ndarray, tolerance: float):
        self.name, self.objective, self.tolerance = name, objective, tolerance
        self.lower, self.upper = centre - reach, centre + reach
        self.evaluations, self.told = 0, time.perf_counter()

    def __call__(self, start: np.ndarray, iterations: int) -> tuple[np.ndarray, float]:
        """The end point and its objective."""
        outcome = minimize(
            self._evaluate,
            np.clip(start, self.lower, self.upper),
            jac=True,
            method="L-BFGS-B",
            bounds=np.column_stack([self.lower, self.upper]),
            options={"ftol": self.tolerance, "gtol": 1e-6, "maxiter": iterations, "maxfun": 5 * iterations},
        )
        return outcome.x, float(outcome.fun)

    def _evaluate(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = self.objective(theta)
        self.evaluations += 1
        if time.perf_counter() - self.told > TOLD:
            self.told = time.perf_counter()
            log.info("training: %s: evaluation %d, minus log evidence %.8g", self.name, self.evaluations, value)
        return value, gradient


def spread(columns: np.ndarray) -> np.ndarray:
    """The standard deviation (d,) of columns (N, d); of a constant column its magnitude, or 1 where that is 0."""
    away = columns - columns[0]
    reach, magnitude, constant = np.abs(away).max(axis=0), np.abs(columns).max(axis=0), constant_columns(columns)
    unit = np.where(constant, np.where(magnitude > 0, magnitude, 1.0), reach)
    return unit * np.where(constant, 1.0, (away / unit).std(axis=0, ddof=min(1, len(columns) - 1)))


def constant_columns(columns: np.ndarray) -> np.ndarray:
    """Which columns (d,) of (N, d) do not move by more than round-off."""
    return np.ptp(columns, axis=0) <= CONSTANT * np.abs(columns).max(axis=0)


def _objective(
    likelihood: str, inputs: np.ndarray, targets: np.ndarray, penalty: Penalty | None, log_spread: np.ndarray
) -> Objective:
    """Negative log marginal likelihood plus penalty of one output over theta."""
    if likelihood == "closed_form":
        evidence = (LogEvidence if len(targets) < IN_PLACE else InPlaceEvidence)(inputs, targets)
    else:
        batch = GPyTorchEvidence(BatchExactGP(torch.from_numpy(centred(inputs)), torch.from_numpy(targets)[:, None]))

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
