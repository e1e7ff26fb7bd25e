"""Training of one exact GP per output by maximum marginal likelihood (Cao, Lai and Alam, 2017, eq. (9)).

Each output is fitted on its own; see ``gpmpc.gp._search``. What cannot fit the memory is refused before the work.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from gpmpc.exceptions import (
    DataError,
    SettingError,
    TrainingError,
    UnsupportedModel,
    check_choice,
    check_number,
)
from gpmpc.gp._data_checks import (
    RESOLUTION,
    Columns,
    Constants,
    columns_of,
    constant_columns,
    warn_of_constants,
    warn_of_transitions,
)
from gpmpc.gp._kernel import PREDICTS, Hyperparameters, Predicts
from gpmpc.gp._likelihood import FAILED
from gpmpc.gp._online import targets_of
from gpmpc.gp._posterior import GPPosterior
from gpmpc.gp._prior_scales import PriorLengthscale, PriorScales, check_prior_scales
from gpmpc.gp._scaling import Scaling, centre
from gpmpc.gp._search import (
    OutputSearch,
    TrainingData,
    column_std,
    log_hyperparameters,
    restored_theta,
    training_data,
)
from gpmpc.gp._transitions import Transitions, check_transitions
from gpmpc.gp._wrapped import warn_of_turns
from gpmpc.signals import Signals

_ONE_THREAD = 1000  # points below which LAPACK's threads wait for each other longer than they work
_GIB = 2**30


@dataclass(frozen=True)
class Training:
    """The result of a training."""

    #: the trained GPs, frozen; of a sparse training, to M pseudo-observations at the inducing points
    posterior: GPPosterior
    theta: np.ndarray  #: rows (log l, log sf, log(sf / sn)), one an output (k, d + 2), in the units of the data
    #: negative log marginal likelihood plus penalty where the search ended (k,); of a sparse training minus the bound
    #: on the log marginal likelihood, in scaled units
    objective: np.ndarray
    #: of an exact training, the objective where the exploration from every start ended (k, restarts + 1), over the
    #: subset if there is one, NaN for starts that a time limit left out; of a sparse training, where the search over
    #: the bound began (k, 1)
    explored: np.ndarray
    evaluations: (
        int  #: of the likelihood or of the bound, all starts and outputs together
    )
    seconds: float  #: wall time [s]

    def with_signals(self, signals: Signals) -> "Training":
        """The training whose posterior carries the names and time step of its data."""
        return replace(self, posterior=replace(self.posterior, signals=signals))


@dataclass(frozen=True)
class Trainer:
    """Fits one SE-ARD GP per output to observed transitions.

    Raises:
        SettingError: A setting is out of range.
    """

    #: what the GPs learn: the next state, the difference to it, or any values, which ``fit`` takes
    predicts: Predicts = "next_state"
    #: how features and targets are scaled for training; what comes out is in the units of the data all the same. The
    #: prior mean is what it maps to zero: the targets' mean by default and with ``standardize``, zero with ``identity``
    scaling: Callable[[Tensor, Sequence[str]], Scaling] = centre
    #: added to every output's negative log marginal likelihood, such as ``SoftLimits()``; none by default
    penalty: Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]] | None = None
    restarts: int = 3  #: random starts besides the first, which has l = std(x~), sf = std(y), sn = std(y) / 10
    #: of more points than this a random subset of as many is searched first, from all starts; the search over all
    #: points goes on from its best. None searches over all of them from every start
    subset: int | None = 1000
    tolerance: float = 1e-8  #: relative decrease of the objective at which L-BFGS stops
    #: the box holds sf / sn within this factor of one. Moment matching needs sf2 / sn2 below about 1e10 in double
    #: precision
    signal_to_noise_limit: float = 1e4
    #: wall time of a training [s], in equal parts for the outputs, after which the best found so far is taken: what
    #: that is depends on the machine. One iteration over all points is made in any case. None: no limit
    time_limit: float | None = None
    #: of features that never move in the data, for all or one each, in their units:
    #: how far from the value that they have predictions hold. None: one unit;
    #: ``"no_effect"``: it is known that they have none
    prior_lengthscale: PriorLengthscale | Sequence[PriorLengthscale] | None = None
    #: of outputs that never change in the data: the standard deviation that they are
    #: supposed to have elsewhere, in their units; of a residual, in units of what a
    #: step changes. None: what the search finds, which is nearly none
    prior_deviation: float | None = 1.0
    #: a feature or a target that moves by no more than this, in its unit, or by
    #: round-off, never moves
    resolution: float = RESOLUTION

    def __post_init__(self) -> None:
        check_choice("predicts", self.predicts, PREDICTS)
        check_number("restarts", self.restarts, least=0, whole=True)
        if self.subset is not None:
            check_number("subset", self.subset, least=1, whole=True)
        for key, example in (("scaling", "standardize"), ("penalty", "SoftLimits()")):
            if not (
                callable(value := getattr(self, key))
                or (key == "penalty" and value is None)
            ):
                raise SettingError(
                    key,
                    f"must be a function such as {example} of gpmpc.gp; got {value!r}",
                )
        check_prior_scales(self)
        check_number("tolerance", self.tolerance, above=0)
        check_number("signal_to_noise_limit", self.signal_to_noise_limit, above=1)
        if self.time_limit is not None:
            check_number("time_limit", self.time_limit, above=0, unit="[s]")

    def __call__(
        self, transitions: Transitions, seed: int = 0, start: GPPosterior | None = None
    ) -> Training:
        """Trains on transitions; see ``fit``."""
        check_transitions(transitions)
        warn_of_turns(transitions)
        targets = transitions.targets(self.predicts)
        warn_of_transitions(transitions)
        training = self.fit(
            transitions.features,
            targets,
            transitions.input_dim,
            seed=seed,
            start=start,
            columns=columns_of(transitions, self.predicts),
        )
        return training.with_signals(transitions.signals)

    def refit(
        self,
        posterior: GPPosterior,
        transitions: Transitions | None = None,
        seed: int = 0,
    ) -> Training:
        """Trains on the points a posterior holds, and on new ones, from its hyperparameters on.

        With ``restarts=0`` only from them on. The prior mean is that of this trainer's scaling, as in any training.
        Errors are as of ``fit``; ``UnsupportedModel`` of a sparse model's pseudo-observations, too.
        """
        _check_start("posterior", posterior)
        if not posterior.has_observation_noise:
            raise UnsupportedModel(
                "the posterior holds a sparse model's pseudo-observations, no data: train again with SparseTrainer"
            )
        features, targets = (
            t.to("cpu", torch.float64) for t in (posterior.features, posterior.targets)
        )
        if transitions is not None:
            targets = torch.cat([targets, targets_of(posterior, transitions)])
            warn_of_turns(transitions)
            features = torch.cat([features, transitions.features])
        training = self.fit(
            features,
            targets,
            posterior.input_dim,
            posterior.predicts,
            seed,
            start=posterior,
        )
        return training.with_signals(posterior.signals)

    def fit(
        self,
        features: Tensor,
        targets: Tensor,
        input_dim: int,
        predicts: Predicts | None = None,
        seed: int = 0,
        start: GPPosterior | None = None,
        columns: Columns | None = None,
    ) -> Training:
        """Trains on features and any targets; the log names what they cannot teach.

        Args:
            features: x~ = (x, u) (N, n + m).
            targets: (N, k).
            input_dim: m.
            predicts: What the targets mean; the trainer's setting by default.
            seed: Of the random starts.
            start: Its hyperparameters are the first start instead; the random ones stay where they are.
            columns: What the log calls features and targets; by default states,
                inputs and outputs with numbers.

        Raises:
            ShapeError, SettingError, UnsupportedModel: Features, targets and ``start`` do not belong together, or are
                not in float64 and in host memory.
            DataError: An entry is not finite, or the kernel matrices would not fit the memory that is available.
            TrainingError: Every start failed for an output, which is named.
        """
        begin = time.perf_counter()
        check_number("seed", seed, least=0, whole=True)
        predicts = predicts or self.predicts
        data = training_data(features, targets, input_dim, predicts, self.scaling)
        features = data.features
        targets = data.targets
        if columns is None:
            columns = Columns.of(features, targets, input_dim, predicts)
        constants = Constants.of(features, targets, columns, self.resolution)
        prior = PriorScales.of(self, features.shape[1], columns.units)
        warn_of_constants(features, targets, columns, constants, prior, self.resolution)
        return self.fit_known(
            data,
            constants,
            prior,
            input_dim,
            predicts,
            seed=seed,
            start=start,
            begin=begin,
        )

    def fit_known(
        self,
        data: TrainingData,
        constants: Constants,
        prior: PriorScales,
        input_dim: int,
        predicts: Predicts,
        seed: int,
        start: GPPosterior | None = None,
        begin: float | None = None,
    ) -> Training:
        """``fit`` to checked data of which it is known, and was said, what never moves.

        ``begin`` is when it began, by ``time.perf_counter`` [s]; by default now.
        """
        begin = time.perf_counter() if begin is None else begin
        features, targets, feature_scaling, target_scaling = data
        (size, d), outputs = features.shape, targets.shape[1]
        _check_memory(size, outputs)
        x = feature_scaling.scale(features).numpy()
        y = target_scaling.scale(targets).numpy()
        factor = feature_scaling.factor.numpy()
        std = column_std(features.numpy(), constants.features) / factor
        first: Any = [None] * outputs
        if start is not None:
            _check_start("start", start)
            first = log_hyperparameters(start, feature_scaling, target_scaling)
            first = self._without_constants(first, start, constants, np.log(std))
        rng = np.random.default_rng(seed)
        perturbations = rng.normal(size=(outputs, self.restarts + 1, d + 2))
        rows = None
        converged = (
            start is not None and not self.restarts
        )  # a subset could not improve on where the search begins
        if self.subset is not None and size > self.subset and not converged:
            rows = np.sort(rng.permutation(size)[: self.subset])
        found = []
        evaluations = 0
        for a in range(outputs):
            deadline = (
                np.inf
                if self.time_limit is None
                else begin + self.time_limit * (a + 1) / outputs
            )
            search = OutputSearch(
                f"output {a + 1} of {outputs}",
                x,
                y[:, a],
                std,
                constants.features,
                prior.lengthscales / factor,
                self,
                deadline,
            )
            with threadpool_limits(1 if size < _ONE_THREAD else None, user_api="blas"):
                if constants.outputs[a] and prior.deviations is not None:
                    unit = float(target_scaling.factor[a])
                    found.append(search.unsearched(prior.deviations[a] / unit))
                else:
                    found.append(search(first[a], perturbations[a], rows))
            evaluations += search.evaluations
        theta, objective, explored = map(np.array, zip(*found, strict=True))
        if failed := np.flatnonzero(objective >= FAILED).tolist():
            raise TrainingError(
                failed,
                f"no start of {explored.shape[1]} led to a positive definite kernel matrix for output "
                f"{', '.join(map(str, failed))}: lower signal_to_noise_limit, or remove duplicate rows",
            )
        theta = restored_theta(theta, feature_scaling, target_scaling)
        kernel = Hyperparameters.from_theta(torch.from_numpy(theta))
        offset = target_scaling.offset
        posterior = GPPosterior.from_hyperparameters(
            features, targets, *kernel, input_dim, predicts, offset
        )
        return Training(
            posterior,
            theta,
            objective,
            explored,
            evaluations,
            time.perf_counter() - begin,
        )

    def _without_constants(
        self,
        first: np.ndarray,
        start: GPPosterior,
        constants: Constants,
        log_std: np.ndarray,
    ) -> list[np.ndarray | None]:
        """The starts of a posterior (k, d + 2), but for what its data held still.

        Of that its hyperparameters say nothing: a feature that moves by now begins with
        its spread, and an output that changes by now with the plain start.
        """
        began = constant_columns(start.features.cpu().double().numpy(), self.resolution)
        began &= ~constants.features
        first[:, :-2][:, began] = log_std[began]
        same = constant_columns(start.targets.cpu().double().numpy(), self.resolution)
        return [None if same[a] else first[a] for a in range(len(first))]


def train(transitions: Transitions, seed: int = 0, **settings: Any) -> Training:
    """``Trainer(**settings)(transitions, seed)``: fits one GP per output in one call."""
    return Trainer(**settings)(transitions, seed)


def _check_start(key: str, posterior: Any) -> None:
    if not isinstance(posterior, GPPosterior):
        raise UnsupportedModel(
            f"{key} must be a GPPosterior; got {type(posterior).__name__}"
        )


def _check_memory(size: int, outputs: int) -> None:
    """Raises ``DataError`` where a training of N points and k outputs would not fit the available memory."""
    free = available_memory()
    needed = (
        8 * size**2 * (outputs + 2)
    )  # of the posterior's factors, and two more while one is made
    if free is None or needed <= free:
        return
    raise DataError(
        f"exact GPs of {size} points and {outputs} outputs need {needed / _GIB:.3g} GiB, {8 * size**2 / _GIB:.3g} GiB "
        f"a kernel matrix; {free / _GIB:.3g} GiB are available: train on {int((free / needed) ** 0.5 * size)} points "
        "or fewer, or sparse GPs (SparseTrainer)"
    )


def available_memory(system: Path = Path("/")) -> int | None:
    """Bytes that this process may still take without swapping; None where the system does not say.

    What Linux calls available, or what the process's control groups (v2; a container, a Slurm job) leave, whichever is
    less; file pages that can be dropped count as free.
    """
    groups = system / "sys/fs/cgroup"
    left = []
    with suppress(OSError):
        lines = (system / "proc/meminfo").read_text().splitlines()
        left += [
            1024 * int(line.split()[1])
            for line in lines
            if line.startswith("MemAvailable:")
        ]
    with suppress(OSError):
        lines = (system / "proc/self/cgroup").read_text().splitlines()
        own = [groups / line[3:].strip("/") for line in lines if line.startswith("0::")]
        for folder in {folder for group in own for folder in (group, *group.parents)}:
            with suppress(OSError, ValueError):  # "max" where there is no limit
                pages = dict(
                    line.split()
                    for line in (folder / "memory.stat").read_text().splitlines()
                )
                used = int((folder / "memory.current").read_text()) - int(
                    pages.get("inactive_file", 0)
                )
                left.append(int((folder / "memory.max").read_text()) - used)
    return max(min(left), 0) if left else None
