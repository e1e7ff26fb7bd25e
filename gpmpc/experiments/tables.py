"""Tables 1 and 2 of Cao, Lai and Alam (2017): how good the GP models are, by trajectory, subsystem and training size.

One *fit* is one draw of a training set: six GPs are trained on a random subset (sorted) of the 189 rows and predict the
subset and all rows, one step ahead each, by moment matching. The state that goes into the first prediction has
covariance 0.1^2 I, in the units of the model; every later one has the covariance predicted one sample earlier, while
its mean is the data's. Reported are

    MSE               squared error summed over the six outputs, averaged over the samples, in the units of the data
    average variance  of x, y, z (phi, theta, psi) in the covariance fed in, averaged over the samples, in model units

What the paper leaves open is added: the same errors of plain predictions, and whether those are calibrated.

Fits are independent; they run in worker processes of one thread each, and every finished one is appended to
``fits.jsonl`` under the fingerprint of all that it depends on, so a run that was killed goes on where it stopped.
"""

import hashlib
import json
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import gpmpc
from gpmpc.datasets import DataSource
from gpmpc.exceptions import DataError, GpmpcError, SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Scaling, Training, Transitions
from gpmpc.gp.posterior import GPPosterior
from gpmpc.metrics import interval_coverage, mean_squared_error, negative_log_predictive_density
from gpmpc.parallel import in_processes
from gpmpc.propagation import MomentMatching
from gpmpc.trajectories import Trajectory

SOURCES = ("gaussian.py", "metrics.py", "gp/*.py", "propagation/*.py", "experiments/tables.py")


@dataclass(frozen=True)
class Subsystem:
    """What the tables need to know of a subsystem.

    Attributes:
        columns: Names of the columns x (n), u (m), x+ (n) of its data.
        reported: The states whose variance is averaged.
        scaling: From columns (N, d) and their names to the scaling in whose units the model works.
    """

    columns: Sequence[str]
    reported: Sequence[str]
    scaling: Callable[[Tensor, Sequence[str]], Scaling]

    def __post_init__(self) -> None:
        for name in self.reported:
            if name not in self.columns:
                raise SettingError("reported", f"must be among {', '.join(self.columns)}; got {name!r}")


@dataclass(frozen=True)
class Cell:
    """One trajectory and one subsystem: the data in the units of the model, and the way back."""

    trajectory: str
    subsystem: str
    data: Transitions
    scaling: Scaling  # of the next states
    reported: tuple[int, ...]


@dataclass(frozen=True)
class Fit:
    """One draw; ``fingerprint`` names everything that its numbers depend on."""

    cell: Cell
    size: int
    draw: int
    seed: int
    fingerprint: str


@dataclass(frozen=True)
class Tables:
    """The whole experiment; one row of the tables is one cell and one size.

    Attributes:
        data: Where transitions come from.
        trajectories: By name.
        subsystems: By name.
        model: From transitions and a ``seed`` to a ``Training``.
        model_settings: The same as plain data, for the fingerprint.
        sizes: Training set sizes.
        draws: Training sets a row.
        seed: Every draw's own seed derives from it.
        state_std: Standard deviation of the state in the first prediction, in the units of the model.
        workers: Processes; None takes one a core.

    Raises:
        SettingError: A size, a draw count, a seed, a deviation or a worker count out of range.
    """

    data: DataSource
    trajectories: Mapping[str, Trajectory]
    subsystems: Mapping[str, Subsystem]
    model: Callable[..., Training]
    model_settings: Any
    sizes: Sequence[int] = (10, 50, 100, 189)
    draws: int = 5
    seed: int = 0
    state_std: float = 0.1
    workers: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "sizes", _whole_numbers("sizes", self.sizes))
        check_number("draws", self.draws, least=1, whole=True)
        check_number("seed", self.seed, least=0, whole=True)
        if self.workers is not None:
            check_number("workers", self.workers, least=1, whole=True)
        check_number("state_std", self.state_std, least=0)
        for key, chosen in (("trajectory", self.trajectories), ("subsystem", self.subsystems)):
            if not chosen:
                raise SettingError(key, "choose at least one")

    def fits(self) -> list[Fit]:
        """Every fit of the experiment, in the order of the tables.

        Raises:
            DataError: The data cannot be read.
            SettingError: A size is larger than the data.
        """
        fits = []
        for name, trajectory in self.trajectories.items():
            for part, subsystem in self.subsystems.items():
                cell = _cell(name, part, self.data.transitions(name, trajectory, part), subsystem)
                for size in self.sizes:
                    if size > len(cell.data):
                        rows = f"{len(cell.data)}, the rows of {name} {part}"
                        raise SettingError("sizes", f"must be at most {rows}; got {size}")
                    fits += [self._fit(cell, size, draw) for draw in range(self.draws)]
        return fits

    def _fit(self, cell: Cell, size: int, draw: int) -> Fit:
        names = [zlib.crc32(name.encode()) for name in (cell.trajectory, cell.subsystem)]
        seed = int(np.random.SeedSequence([self.seed, *names, size, draw]).generate_state(1)[0])
        settings = [self.model_settings, self.state_std, cell.reported, size, seed]
        arrays = (cell.data.features, cell.data.next_states, cell.scaling.factor)
        fingerprint = digest(
            _source(), json.dumps(settings, sort_keys=True).encode(), *(array.numpy().tobytes() for array in arrays)
        )
        return Fit(cell, size, draw, seed, fingerprint)

    def run(self, store: "FitStore", fits: Sequence[Fit], progress: Callable[[dict | None], None]) -> list[dict]:
        """Computes the fits that the store does not hold yet.

        Args:
            store: Where finished fits are kept.
            fits: From ``fits()``.
            progress: Called with every record, found or computed; a failed fit counts as well.

        Returns:
            One record a fit, in the order of ``fits``.
        """
        found = {}
        for fit in fits:
            if fit.fingerprint in store.records:
                found[fit.fingerprint] = store.records[fit.fingerprint]
                progress(found[fit.fingerprint])
        missing = [fit for fit in fits if fit.fingerprint not in found]
        if missing:
            evaluate = partial(_evaluate, model=self.model, state_std=float(self.state_std))
            # The largest first: the last fits to run are then short ones.
            order = sorted(missing, key=lambda fit: -fit.size)
            with closing(in_processes(evaluate, order, self.workers)) as finished:
                for index, record in finished:
                    store.append(order[index].fingerprint, record)
                    found[order[index].fingerprint] = record
                    progress(record)
        return [found[fit.fingerprint] | {"draw": fit.draw} for fit in fits]


class FitStore:
    """Finished fits in a file of one JSON object a line; a line that a crash cut short is passed over.

    Args:
        path: The file; it is made at the first ``append``.
    """

    def __init__(self, path: Path):
        self.path = path
        self.records: dict[str, dict] = {}
        if path.exists():
            text = path.read_text(encoding="utf-8", errors="replace")
            for line in text.splitlines():
                try:
                    entry = json.loads(line)
                    self.records[entry["fingerprint"]] = entry["record"]
                except (ValueError, KeyError, TypeError):
                    continue
            if text and not text.endswith("\n"):
                with path.open("a", encoding="utf-8") as file:
                    file.write("\n")

    def append(self, fingerprint: str, record: dict) -> None:
        """Keeps one record for good: it is on the disk when this returns."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"fingerprint": fingerprint, "record": record}) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self.records[fingerprint] = record


def predict_all(posterior: GPPosterior, data: Transitions, state_std: float) -> tuple[Tensor, Tensor, float]:
    """The tables' one-step predictions along the rows of ``data``.

    Returns:
        Predicted means (N, n), the variances of the states that were fed in (N, n), and the largest amount by which a
        predicted covariance had to be projected to be positive semidefinite.
    """
    propagator = MomentMatching()
    covariance = state_std**2 * torch.eye(data.state_dim, dtype=torch.float64)
    means, fed, projected = [], [], 0.0
    for state, control in zip(data.states, data.inputs, strict=True):
        belief = Gaussian(state, covariance)
        fed.append(belief.variance)
        step = propagator.propagate(posterior, belief, control)
        means.append(step.belief.mean)
        covariance = step.belief.covariance
        projected = max(projected, float(step.deficit))
    return torch.stack(means), torch.stack(fed), projected


def _evaluate(fit: Fit, model: Callable[..., Training], state_std: float) -> dict:
    """Trains and scores one draw, in a worker process."""
    torch.set_num_threads(1)
    cell = fit.cell
    subset = np.sort(np.random.default_rng(fit.seed).permutation(len(cell.data))[: fit.size])
    training_rows = cell.data[subset.tolist()]
    record = {
        "table": {"elliptical": 1, "lorenz": 2}.get(cell.trajectory),
        "trajectory": cell.trajectory,
        "subsystem": cell.subsystem,
        "size": fit.size,
        "draw": fit.draw,
        "seed": fit.seed,
    }
    try:
        training = model(training_rows, seed=fit.seed)
        posterior = training.posterior
        means, fed, projected = predict_all(posterior, cell.data, state_std)
        own = means if fit.size == len(cell.data) else predict_all(posterior, training_rows, state_std)[0]
    except (GpmpcError, torch.linalg.LinAlgError) as error:  # of this draw; the others go on
        return record | {"error": str(error)}

    restore = cell.scaling.restore
    plain = posterior.predict(cell.data.states, cell.data.inputs)
    mean, variance = restore(plain.mean), (plain.variance + posterior.noise_variance) * cell.scaling.factor**2
    observed = restore(cell.data.next_states)
    held_out = np.setdiff1d(np.arange(len(cell.data)), subset).tolist()
    return record | {
        "training_mse": mean_squared_error(restore(own), observed[subset.tolist()]),
        "test_mse": mean_squared_error(restore(means), observed),
        "average_variance": float(fed[:, list(cell.reported)].mean()),
        "training_seconds": training.seconds,
        "plain_training_mse": mean_squared_error(mean[subset.tolist()], observed[subset.tolist()]),
        "plain_test_mse": mean_squared_error(mean, observed),
        "nlpd": negative_log_predictive_density(mean, variance, observed),
        "coverage_95": interval_coverage(mean, variance, observed),
        "held_out_coverage_95": (
            interval_coverage(mean[held_out], variance[held_out], observed[held_out]) if held_out else None
        ),
        "largest_projection": projected,
        "negative_log_evidence": training.objective.tolist(),
        "likelihood_evaluations": training.evaluations,
    }


def _cell(name: str, part: str, raw: Transitions, subsystem: Subsystem) -> Cell:
    n, m = raw.state_dim, raw.input_dim
    if len(subsystem.columns) != 2 * n + m:
        raise DataError(
            f"{name} {part}: the data have {2 * n + m} columns; the subsystem names {len(subsystem.columns)}"
        )
    scaling = subsystem.scaling(torch.cat([raw.features, raw.next_states], dim=1), list(subsystem.columns))
    pieces = [slice(0, n), slice(n, n + m), slice(n + m, None)]
    states, inputs, next_states = (Scaling(scaling.offset[piece], scaling.factor[piece]) for piece in pieces)
    data = Transitions(states.scale(raw.states), inputs.scale(raw.inputs), next_states.scale(raw.next_states))
    return Cell(name, part, data, next_states, tuple(list(subsystem.columns).index(r) for r in subsystem.reported))


def _whole_numbers(key: str, values: Any) -> tuple[int, ...]:
    values = (values,) if isinstance(values, int) else values
    if not isinstance(values, list | tuple) or not values:
        raise SettingError(key, f"must be a list of whole numbers such as [10,50]; got {values!r}")
    for value in values:
        check_number(key, value, least=1, whole=True)
    return tuple(dict.fromkeys(values))


@cache
def _source() -> bytes:
    """The code that a fit's numbers come from: what other code computed is not taken for finished."""
    package = Path(gpmpc.__file__).parent
    return b"".join(path.read_bytes() for pattern in SOURCES for path in sorted(package.glob(pattern)))


def digest(*parts: bytes) -> str:
    """A fingerprint of bytes."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:32]
