"""Training of one exact GP per output by maximum marginal likelihood (Cao, Lai and Alam, 2017, eq. (9)).

Each output is fitted on its own, over theta = (log length-scales, log sf, log(sf / sn)) inside a wide box; see
``gpmpc.gp._search``. Exact GPs are cubic in time and square in memory over the points: one factor of 200 MB an output
at N = 5000. What cannot fit is refused before the work.

Many sets are trained side by side on every core (``train_many``), one output of one set a job, with bitwise the numbers
of each training alone on one thread.
"""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from gpmpc.exceptions import DataError, SettingError, ShapeError, TrainingError, UnsupportedModel, check_number
from gpmpc.gp._kernel import PREDICTS, Predicts
from gpmpc.gp._likelihood import FAILED
from gpmpc.gp._search import (
    Penalty,
    SearchProblem,
    SearchResult,
    SearchSettings,
    column_std,
    constant_columns,
    find_hyperparameters,
    log_hyperparameters,
    training_data,
)
from gpmpc.gp.online import targets_of
from gpmpc.gp.posterior import GPPosterior
from gpmpc.gp.scaling import Scaling, centre
from gpmpc.gp.transitions import Transitions, check_transitions
from gpmpc.memory import GIB, available_memory
from gpmpc.parallel import cores, in_processes

_log = logging.getLogger(__name__)
# N x N matrices that one evaluation of the likelihood holds, measured; the posterior holds one an output.
_MATRICES = {"closed_form": 1, "gpytorch": 13}
_MANY = 1000  # points: from here on the log has a line an output
_PROCESS = 0.4 * GIB  # bytes that a worker takes before it has data: torch and its kin


@dataclass(frozen=True)
class Training:
    """The result of a training.

    Attributes:
        posterior: The trained GPs, frozen.
        theta: Rows (log l, log sf, log(sf / sn)), one an output (n, d + 2), in the units of the data.
        objective: Negative log marginal likelihood plus penalty where the search ended (n,).
        explored: The same where the exploration from every start ended (n, restarts + 1), over the subset if there is
            one; ``FAILED`` where none could.
        evaluations: Likelihood evaluations, all starts and outputs together.
        seconds: Wall time [s]; of ``train_many`` the sum over the outputs.
    """

    posterior: GPPosterior
    theta: np.ndarray
    objective: np.ndarray
    explored: np.ndarray
    evaluations: int
    seconds: float  # [s]


@dataclass(frozen=True)
class Trainer:
    """Fits one SE-ARD GP per output to observed transitions.

    Attributes:
        predicts: What the GPs learn: the next state, the difference to it, or any values, which ``fit`` takes.
        scaling: How features and targets are scaled for training; what comes out is in the units of the data all the
            same. The prior mean is what it maps to zero: the targets' mean by default and with ``standardize``, zero
            with ``identity``.
        penalty: Added to every output's negative log marginal likelihood; none by default.
        restarts: Random starts besides the first, which has l = std(x~), sf = std(y), sn = std(y) / 10.
        subset: Of more points than this a random subset of as many is searched first, from all starts; the search over
            all points goes on from its best. None searches over all of them from every start.
        likelihood: How it is evaluated: in closed form, or by GPyTorch's automatic differentiation (slower; the same).
        tolerance: Relative decrease of the objective at which L-BFGS stops.
        lengthscale_limit: The box holds length-scales within this factor of their input's spread.
        signal_to_noise_limit: The box holds sf / sn within this factor of one. Moment matching needs sf2 / sn2 below
            about 1e10 in double precision.

    Raises:
        SettingError: Fewer than no restarts, a subset of none, an unknown ``likelihood`` or ``predicts``, a tolerance
            that is not positive, or a limit of 1 or less.
    """

    predicts: Predicts = "next_state"
    scaling: Callable[[Tensor, Sequence[str]], Scaling] = centre
    penalty: Penalty | None = None
    restarts: int = 3
    subset: int | None = 1000
    likelihood: Literal["closed_form", "gpytorch"] = "closed_form"
    tolerance: float = 1e-8
    lengthscale_limit: float = 1e4
    signal_to_noise_limit: float = 1e4

    def __post_init__(self) -> None:
        if self.predicts not in PREDICTS:
            raise SettingError("predicts", f"must be one of {', '.join(map(repr, PREDICTS))}; got {self.predicts!r}")
        check_number("restarts", self.restarts, least=0, whole=True)
        if self.subset is not None:
            check_number("subset", self.subset, least=1, whole=True)
        if self.likelihood not in ("closed_form", "gpytorch"):
            raise SettingError("likelihood", f"must be 'closed_form' or 'gpytorch'; got {self.likelihood!r}")
        for key in ("scaling", "penalty"):
            if not (callable(value := getattr(self, key)) or (key == "penalty" and value is None)):
                example = "standardize" if key == "scaling" else "SoftLimits()"
                raise SettingError(key, f"must be a function such as {example} of gpmpc.gp; got {value!r}")
        for key, least in (("tolerance", 0), ("lengthscale_limit", 1), ("signal_to_noise_limit", 1)):
            check_number(key, getattr(self, key), above=least)

    def __call__(self, transitions: Transitions, seed: int = 0, start: GPPosterior | None = None) -> Training:
        """Trains on transitions; see ``fit``."""
        check_transitions(transitions)
        targets = transitions.targets(self.predicts)
        return self.fit(transitions.features, targets, transitions.input_dim, seed=seed, start=start)

    def refit(self, posterior: GPPosterior, transitions: Transitions | None = None, seed: int = 0) -> Training:
        """Trains on the points a posterior holds, and on new ones, from its hyperparameters on.

        With ``restarts=0`` only from them on. The prior mean is that of this trainer's scaling, as in any training.

        Args:
            posterior: What was learned so far; what it predicts and its number of inputs stay.
            transitions: Seen besides, if given.
            seed: Of the random starts.

        Raises:
            UnsupportedModel: It is no ``GPPosterior``, or stands on a sparse model's pseudo-observations.
            ShapeError: The transitions have other dimensions.
            TrainingError: Every start failed for an output, which is named.
        """
        _check_start("posterior", posterior)
        if not posterior.has_observation_noise:
            raise UnsupportedModel(
                "the posterior holds a sparse model's pseudo-observations, no data: train again with SparseTrainer"
            )
        features, targets = (t.to("cpu", torch.float64) for t in (posterior.features, posterior.targets))
        if transitions is not None:
            targets = torch.cat([targets, targets_of(posterior, transitions)])
            features = torch.cat([features, transitions.features])
        return self.fit(features, targets, posterior.input_dim, posterior.predicts, seed, start=posterior)

    def fit(
        self,
        features: Tensor,
        targets: Tensor,
        input_dim: int,
        predicts: Predicts | None = None,
        seed: int = 0,
        start: GPPosterior | None = None,
    ) -> Training:
        """Trains on features and any targets.

        Args:
            features: x~ = (x, u) (N, n + m).
            targets: (N, k).
            input_dim: m.
            predicts: What the targets mean; by default what the trainer's setting says.
            seed: Of the random starts.
            start: Its hyperparameters are the first start instead; the random ones stay where they are.

        Raises:
            ShapeError: Features and targets do not belong together, or ``start`` has other dimensions.
            SettingError: They are no float64 tensors in host memory, or the seed is no whole number.
            UnsupportedModel: ``start`` is no ``GPPosterior``.
            DataError: An entry is not finite, or the kernel matrices would not fit the memory that is available.
            TrainingError: Every start failed for an output, which is named.
        """
        begin = time.perf_counter()
        problem = _prepared(self, features, targets, input_dim, predicts, seed, start)
        found = []
        for task in problem.tasks:
            found.append(find_hyperparameters(task))
            if len(features) > _MANY:
                _log.info("training: %s: %d evaluations, %.1f s", task.name, found[-1].evaluations, found[-1].seconds)
        return problem.training(found, begin)


@dataclass(frozen=True)
class _Prepared:
    """A data set's training, taken apart by outputs."""

    features: Tensor
    targets: Tensor
    feature_scaling: Scaling
    target_scaling: Scaling
    input_dim: int
    predicts: Predicts
    tasks: Sequence[SearchProblem]

    def training(self, found: Sequence[SearchResult], begin: float | None = None) -> Training:
        """Joins the outputs' results; without ``begin`` (``time.perf_counter``) their seconds add up."""
        assembling = time.perf_counter()
        failed = [a for a, one in enumerate(found) if one.objective >= FAILED]
        if failed:
            raise TrainingError(
                failed,
                f"no start of {len(found[0].explored)} led to a positive definite kernel matrix for output "
                f"{', '.join(str(a) for a in failed)}: lower signal_to_noise_limit, or remove duplicate rows",
            )
        theta = np.array([one.theta for one in found])
        theta[:, :-2] += self.feature_scaling.factor.log().numpy()
        theta[:, -2] += self.target_scaling.factor.log().numpy()
        physical = torch.from_numpy(theta)
        posterior = GPPosterior.from_hyperparameters(
            self.features,
            self.targets,
            lengthscales=physical[:, :-2].exp(),
            signal_variance=(2 * physical[:, -2]).exp(),
            noise_variance=(2 * (physical[:, -2] - physical[:, -1])).exp(),
            input_dim=self.input_dim,
            predicts=self.predicts,
            offset=self.target_scaling.offset,
        )
        spent = sum(one.seconds for one in found) + time.perf_counter() - assembling
        return Training(
            posterior,
            theta,
            objective=np.array([one.objective for one in found]),
            explored=np.array([one.explored for one in found]),
            evaluations=sum(one.evaluations for one in found),
            seconds=spent if begin is None else time.perf_counter() - begin,
        )


def _prepared(
    trainer: Trainer,
    features: Tensor,
    targets: Tensor,
    input_dim: int,
    predicts: Predicts | None,
    seed: int,
    start: GPPosterior | None = None,
) -> _Prepared:
    check_number("seed", seed, least=0, whole=True)
    predicts = trainer.predicts if predicts is None else predicts
    features, targets = training_data(features, targets, input_dim, predicts)
    (size, d), outputs = features.shape, targets.shape[1]
    _check_memory([(size, outputs)], trainer.likelihood)
    names = [f"x{i + 1}" for i in range(d - input_dim)] + [f"u{i + 1}" for i in range(input_dim)]
    feature_scaling = trainer.scaling(features, names)
    target_scaling = trainer.scaling(targets, [f"y{a + 1}" for a in range(outputs)])
    x, y = feature_scaling.scale(features).numpy(), target_scaling.scale(targets).numpy()
    first: list[np.ndarray | None] = [None] * outputs
    if start is not None:
        _check_start("start", start)
        first = list(log_hyperparameters(start, feature_scaling, target_scaling))
    rng = np.random.default_rng(seed)
    perturbations = rng.normal(size=(outputs, trainer.restarts + 1, d + 2))
    rows = None
    converged = start is not None and not trainer.restarts  # a subset could not improve on where the search begins
    if trainer.subset is not None and size > trainer.subset and not converged:
        rows = np.sort(rng.permutation(size)[: trainer.subset])
    columns = features.numpy()
    std, constant = column_std(columns) / feature_scaling.factor.numpy(), constant_columns(columns)
    limits = trainer.tolerance, trainer.lengthscale_limit, trainer.signal_to_noise_limit
    settings = SearchSettings(trainer.penalty, trainer.likelihood, *limits)
    tasks = [
        SearchProblem(
            f"output {a + 1} of {outputs}", x, y[:, a], first[a], perturbations[a], rows, std, constant, settings
        )
        for a in range(outputs)
    ]
    return _Prepared(features, targets, feature_scaling, target_scaling, input_dim, predicts, tasks)


def train(transitions: Transitions, seed: int = 0, **settings: Any) -> Training:
    """``Trainer(**settings)(transitions, seed)``: fits one GP per output in one call."""
    return Trainer(**settings)(transitions, seed)


def train_many(
    trainer: Trainer,
    sets: Sequence[Transitions],
    seeds: int | Sequence[int] = 0,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Training | TrainingError]:
    """Trains on many sets of transitions at once, on every core; as ``trainer(set, seed)`` one after another.

    A script calls it below ``if __name__ == "__main__":``, since every worker process imports the script.

    Args:
        trainer: Its settings; picklable.
        sets: Of any sizes and dimensions.
        seeds: One a set, or one for all.
        workers: Processes; None takes one a core, or fewer where memory asks for it. Starting them takes seconds: a few
            small trainings are faster alone.
        progress: Called with the number of outputs fitted so far, and of all.

    Returns:
        One training a set, in their order; the error instead where every start failed for one of its outputs.

    Raises:
        SettingError: A seed or the number of workers is out of range.
        ShapeError: There are not as many seeds as sets.
        DataError: The kernel matrices would not fit the memory that is available, those of all workers or all results.
    """
    if workers is not None:
        check_number("workers", workers, least=1, whole=True)
    seeds = [int(seeds)] * len(sets) if isinstance(seeds, int | np.integer) else list(seeds)
    for seed in seeds:
        check_number("seeds", seed, least=0, whole=True)
    if len(seeds) != len(sets):
        raise ShapeError(f"one seed a set is needed, or one for all; got {len(seeds)} for {len(sets)} sets")
    for one in sets:
        check_transitions(one)
    problems = [
        _prepared(trainer, one.features, one.targets(trainer.predicts), one.input_dim, trainer.predicts, seed)
        for one, seed in zip(sets, seeds, strict=True)
    ]
    places = [(s, a) for s, problem in enumerate(problems) for a in range(len(problem.tasks))]
    places.sort(key=lambda place: -len(sets[place[0]]))  # the last jobs to run are then short ones
    tasks = [problems[s].tasks[a] for s, a in places]
    if not tasks:
        return []
    shapes = [(len(one), one.state_dim) for one in sets]
    workers = min(workers, len(tasks)) if workers else _workers_that_fit(shapes, trainer.likelihood, len(tasks))
    _check_memory(shapes, trainer.likelihood, workers)
    found: dict[tuple[int, int], SearchResult] = {}
    with closing(in_processes(find_hyperparameters, tasks, workers)) as finished:
        for index, result in finished:
            found[places[index]] = result
            if progress is not None:
                progress(len(found), len(tasks))
    trainings: list[Training | TrainingError] = []
    for s, problem in enumerate(problems):
        try:
            trainings.append(problem.training([found[s, a] for a in range(len(problem.tasks))]))
        except TrainingError as error:  # of this set; the others stand
            trainings.append(error)
    return trainings


def _workers_that_fit(shapes: Sequence[tuple[int, int]], likelihood: str, tasks: int) -> int:
    free, workers = available_memory(), min(cores(), tasks)
    while free is not None and workers > 1:
        if _needed_memory(shapes, likelihood, workers) + workers * _PROCESS <= free:
            break
        workers -= 1
    return workers


def _check_start(key: str, posterior: Any) -> None:
    if not isinstance(posterior, GPPosterior):
        raise UnsupportedModel(f"{key} must be a GPPosterior; got {type(posterior).__name__}")


def _check_memory(shapes: Sequence[tuple[int, int]], likelihood: str, workers: int = 1) -> None:
    """Raises ``DataError`` where trainings of N points and k outputs each would not fit the available memory."""
    free, needed = available_memory(), _needed_memory(shapes, likelihood, workers)
    if free is None or needed <= free:
        return
    size, outputs = max(shapes)
    fitting = int((free / needed) ** 0.5 * size)
    many = f"{len(shapes)} trainings of exact GPs of up to" if len(shapes) > 1 else "exact GPs of"
    raise DataError(
        f"{many} {size} points and {outputs} outputs need {needed / GIB:.3g} GiB, {8 * size**2 / GIB:.3g} GiB a kernel "
        f"matrix; {free / GIB:.3g} GiB are available: train on {fitting} points or fewer, or sparse GPs (SparseTrainer)"
    )


def _needed_memory(shapes: Sequence[tuple[int, int]], likelihood: str, workers: int = 1) -> int:
    """The bytes of the searches, or of the posteriors, whichever take more."""
    tasks = sorted((size for size, outputs in shapes for _ in range(outputs)), reverse=True)
    searches = sum(8 * _MATRICES[likelihood] * size**2 for size in tasks[:workers])
    kept = sum(8 * outputs * size**2 for size, outputs in shapes)
    return max(searches, kept + 2 * 8 * max(tasks) ** 2)  # two more while a factor is made
