"""Training of one exact GP per output by maximum marginal likelihood.

The GP model of Cao, Lai and Alam (2017, eq. (9)). Each output is fitted on its own; see
``gpmpc.gp._search``. What cannot fit the memory is refused before the work.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import (
    SettingError,
    TrainingError,
    UnsupportedModel,
    check_choice,
    check_number,
)
from gpmpc.gp._data_checks import (
    RESOLUTION,
    ROUND_OFF,
    ColumnDescriptions,
    checked_targets,
    constant_columns,
)
from gpmpc.gp._kernel import Hyperparameters
from gpmpc.gp._memory import check_memory
from gpmpc.gp._online import targets_of
from gpmpc.gp._posterior import GPPosterior, check_posterior
from gpmpc.gp._prior_scales import PriorLengthscales
from gpmpc.gp._scaling import Scaling, centre
from gpmpc.gp._search import (
    ALL_ROWS,
    FAILED,
    OutputSearch,
    Penalty,
    SearchFeatures,
    SearchResult,
)
from gpmpc.gp._tensor_checks import PREDICTS, Predicts
from gpmpc.gp._training_data import (
    TrainingData,
    check_data_settings,
    check_function,
    read_training_data,
    restored_theta,
    scaled_theta,
)
from gpmpc.gp._transitions import Transitions
from gpmpc.gp._wrapped import warn_of_turns
from gpmpc.signals import Signals

# Points below which LAPACK's threads wait for each other longer than they work.
_ONE_THREAD = 1000


@dataclass(frozen=True, eq=False)
class Training:
    """The result of a training.

    See Also:
        ``Trainer`` and ``SparseTrainer``, which return it.
    """

    #: the model: the trained GPs, frozen, or a ``ResidualModel`` with them where a
    #: system's structure is known; of a sparse training, GPs of M pseudo-observations
    #: at the inducing points
    posterior: GPPosterior
    #: rows (log l, log sf, log(sf / sn)), one an output (k, d + 2), in the units of the
    #: data
    theta: np.ndarray
    #: negative log marginal likelihood plus penalty where the search ended (k,),
    #: without the penalty of a constant output, which is not searched
    #: (``prior_deviation``); of a sparse training minus the bound on the log marginal
    #: likelihood; both of the scaled targets
    objective: np.ndarray
    #: of an exact training, the objective where the exploration from every start ended
    #: (k, restarts + 1), over the subset if there is one, NaN for starts that a time
    #: limit left out, and for all but the first of a constant output; of a sparse
    #: training, where the search over the bound began (k, 1)
    explored: np.ndarray
    #: of the likelihood or of the bound, all starts and outputs together
    evaluations: int
    seconds: float  #: wall time [s]

    def with_signals(self, signals: Signals) -> "Training":
        """Returns the training with the names and the time step of its data."""
        return replace(self, posterior=replace(self.posterior, signals=signals))


@explains_arguments
@dataclass(frozen=True)
class Trainer:
    """Fits one SE-ARD GP per output to observed transitions.

    Raises:
        SettingError: A setting is out of range.

    >>> import numpy as np
    >>> from gpmpc.gp import Transitions
    >>> x = np.linspace(-1, 1, 8)[:, None]
    >>> data = Transitions(states=x, inputs=x**2, next_states=0.9 * x + 0.1 * x**2)
    >>> Trainer(restarts=0, predicts="difference")(data).posterior
    GPPosterior(8 points, n=1, m=1, k=1, predicts='difference', torch.float64 on cpu)

    See Also:
        ``gpmpc.models.train``, which knows a system's angles and rates;
        ``SparseTrainer`` for thousands of points; ``Transitions``.
    """

    #: what the GPs learn: the next state, the difference to it, or any values, which
    #: ``fit`` takes. None: what a system's description leaves open, in
    #: ``gpmpc.models.train`` and an ``Experiment``; elsewhere the next state
    predicts: Predicts | None = None
    #: how features and targets are scaled for training; what comes out is in the units
    #: of the data all the same. The prior mean is what it maps to zero: the targets'
    #: mean by default and with ``standardize``, zero with ``identity``
    scaling: Callable[[Tensor, Sequence[str]], Scaling] = centre
    #: added to every output's negative log marginal likelihood, such as
    #: ``SoftLimits()``; none by default
    penalty: Penalty | None = None
    #: random starts besides the first, which has l = std(x~), sf = std(y),
    #: sn = std(y) / 10
    restarts: int = 3
    #: of more points than this a random subset of as many is searched first, from all
    #: starts; the search over all points goes on from its best. An output that stands
    #: still in the subset has rows added in which it moves. None searches over all of
    #: them from every start
    subset: int | None = 1000
    tolerance: float = 1e-8  #: relative decrease of the objective where L-BFGS stops
    #: the box holds sf / sn within this factor of one. Moment matching needs sf2 / sn2
    #: below about 1e10 in double precision
    signal_to_noise_limit: float = 1e4
    #: wall time of a training [s], in equal parts for the outputs, after which the best
    #: so far is taken: what that is depends on the machine. One iteration over all
    #: points is made in any case. None: no limit
    time_limit: float | None = None
    #: of features that are constant in the data, for all or one each, in their units:
    #: how far from the value that they have predictions hold. None: one unit;
    #: ``"no_effect"``: it is known that they have none
    prior_lengthscale: PriorLengthscales = None
    #: of outputs that are constant in the data: the standard deviation that they are
    #: supposed to have elsewhere, in their units; of a residual, in units of what a
    #: step changes. None: what the search finds, which is nearly none
    prior_deviation: float | None = 1.0
    #: a feature or a target that moves by no more than this, in its unit, or by
    #: round-off, is constant
    resolution: float = RESOLUTION

    def __post_init__(self) -> None:
        if self.predicts is not None:
            check_choice("predicts", self.predicts, PREDICTS)
        check_number("restarts", self.restarts, least=0, whole=True)
        if self.subset is not None:
            check_number("subset", self.subset, least=1, whole=True)
        check_data_settings(self)
        if self.penalty is not None:
            check_function("penalty", self.penalty, example="SoftLimits()")
        check_number("tolerance", self.tolerance, above=0)
        check_number("signal_to_noise_limit", self.signal_to_noise_limit, above=1)
        if self.time_limit is not None:
            check_number("time_limit", self.time_limit, above=0, unit="[s]")

    def __call__(
        self, transitions: Transitions, seed: int = 0, start: GPPosterior | None = None
    ) -> Training:
        """Trains on transitions; see ``fit``."""
        predicts = self.predicts or "next_state"
        targets = checked_targets(transitions, predicts)
        training = self.fit(
            transitions.features,
            targets,
            transitions.input_dim,
            predicts=predicts,
            seed=seed,
            start=start,
            columns=ColumnDescriptions.of_transitions(transitions, predicts),
        )
        return training.with_signals(transitions.signals)

    def refit(
        self,
        posterior: GPPosterior,
        transitions: Transitions | None = None,
        seed: int = 0,
    ) -> Training:
        """Trains on the points of a posterior, and on new ones.

        The search goes on from the posterior's hyperparameters, with ``restarts=0``
        from them alone. The prior mean is that of this trainer's scaling, as in any
        training. ``prior_deviation`` counts in the units of the targets, for the GPs of
        a residual too: a posterior does not know what a step changes. There it is to be
        set, or the whole model to be trained again.

        Raises:
            UnsupportedModel: The posterior holds a sparse model's pseudo-observations,
                or is none. Further errors are those of ``fit``.
        """
        check_posterior("posterior", posterior)
        noise = posterior.observation_noise
        if noise is None:
            raise UnsupportedModel(
                "the posterior holds a sparse model's pseudo-observations, no data: "
                "train again with SparseTrainer"
            )
        features = posterior.features.to("cpu", torch.float64)
        targets = posterior.targets.to("cpu", torch.float64)
        if transitions is not None:
            new_targets = targets_of(posterior, transitions)
            warn_of_turns(transitions)
            targets = torch.cat([targets, new_targets.cpu()])
            features = torch.cat([features, transitions.features.cpu()])
        training = self.fit(
            features,
            targets,
            posterior.input_dim,
            predicts=posterior.predicts,
            seed=seed,
            start=replace(posterior, noise_variance=noise),
            columns=ColumnDescriptions.of_tensors(
                features,
                targets,
                posterior.input_dim,
                predicts=posterior.predicts,
                signals=posterior.signals,
            ),
        )
        return training.with_signals(posterior.signals)

    @explains_arguments
    def fit(
        self,
        features: Tensor,
        targets: Tensor,
        input_dim: int,
        predicts: Predicts | None = None,
        seed: int = 0,
        start: GPPosterior | None = None,
        columns: ColumnDescriptions | None = None,
    ) -> Training:
        """Trains on features and any targets; the log names what they cannot teach.

        Args:
            features: x~ = (x, u) (N, n + m).
            targets: (N, k).
            input_dim: m.
            predicts: What the targets mean; the trainer's setting by default.
            seed: Of the random starts.
            start: Its hyperparameters are the first start instead; the random ones stay
                where they are.
            columns: What the log calls features and targets; by default states,
                inputs and outputs with numbers.

        Raises:
            ShapeError, SettingError, UnsupportedModel: Features, targets and ``start``
                do not belong together, or are not in float64 and in host memory.
            DataError: An entry is not finite, or the kernel matrices would not fit the
                memory that is available.
            TrainingError: Every start failed for an output, which is named.
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
        return self.fit_data(data, seed, start, start_time)

    def fit_data(
        self,
        data: TrainingData,
        seed: int,
        start: GPPosterior | None = None,
        start_time: float | None = None,
    ) -> Training:
        """Trains on data that were checked; see ``fit``.

        Args:
            data: The data.
            seed: Of the random starts.
            start: Its hyperparameters are the first start.
            start_time: When the training began, by ``time.perf_counter`` [s]; by
                default now.
        """
        if start_time is None:
            start_time = time.perf_counter()
        size, d = data.features.shape
        k = data.targets.shape[1]
        check_memory(size, k)
        features = _search_features(data)
        targets = data.scaled_targets.numpy()
        start_thetas = self._start_thetas(data, features, start)
        rng = np.random.default_rng(seed)
        # The first start needs none. Its row is drawn and not used: without it a seed
        # would mean other starts than it always did.
        perturbations = rng.normal(size=(k, self.restarts + 1, d + 2))
        subset_rows = self._subset_rows(size, rng, has_start=start is not None)

        results: list[SearchResult] = []
        evaluations = 0
        for a in range(k):
            search = OutputSearch(
                name=f"{data.columns.outputs[a]} ({a + 1} of {k})",
                features=features,
                targets=targets[:, a],
                settings=self,
                deadline=self._deadline(start_time, (a + 1) / k),
            )
            with threadpool_limits(1 if size < _ONE_THREAD else None, user_api="blas"):
                deviation = _deviation_of_constant(data, a)
                if deviation is None:
                    rows = _with_moving_rows(subset_rows, targets[:, a])
                    results.append(search(start_thetas[a], perturbations[a, 1:], rows))
                else:
                    results.append(search.result_of_constant(deviation))
            evaluations += search.evaluations

        objective = np.array([result.objective for result in results])
        self._check_success(objective, data.columns.outputs)
        theta = restored_theta(
            np.array([result.theta for result in results]),
            data.feature_scaling,
            data.target_scaling,
        )
        # Factorised over the raw data, which restoring scaled ones would round.
        kernel = Hyperparameters.from_theta(torch.from_numpy(theta))
        posterior = GPPosterior.from_hyperparameters(
            data.features,
            data.targets,
            lengthscales=kernel.lengthscales,
            signal_variance=kernel.signal_variance,
            noise_variance=kernel.noise_variance,
            input_dim=data.input_dim,
            predicts=data.predicts,
            offset=data.target_scaling.offset,
        )
        return Training(
            posterior=posterior,
            theta=theta,
            objective=objective,
            explored=np.array([result.explored for result in results]),
            evaluations=evaluations,
            seconds=time.perf_counter() - start_time,
        )

    def _start_thetas(
        self, data: TrainingData, features: SearchFeatures, start: GPPosterior | None
    ) -> list[np.ndarray | None]:
        """The first start (d + 2,) of every output; None for the plain one.

        Hyperparameters of a posterior say nothing of what is constant in its data. A
        feature that was constant there, and is not here, begins with its standard
        deviation; such an output begins with the plain start.
        """
        if start is None:
            return [None] * data.targets.shape[1]
        check_posterior("start", start)
        theta = scaled_theta(start, data.feature_scaling, data.target_scaling)
        start_features = start.features.double().numpy(force=True)
        was_constant = constant_columns(start_features, self.resolution)
        no_longer_constant = was_constant & ~data.constant.features
        log_scales = np.log(features.scales)
        theta[:, :-2][:, no_longer_constant] = log_scales[no_longer_constant]
        targets = start.targets.double().numpy(force=True)
        outputs_were_constant = constant_columns(
            targets, self.resolution, data.columns.magnitudes
        )
        return [
            None if was_constant_output else row
            for row, was_constant_output in zip(
                theta, outputs_were_constant, strict=True
            )
        ]

    def _subset_rows(
        self, size: int, rng: np.random.Generator, has_start: bool
    ) -> np.ndarray | slice:
        """The rows that are searched first."""
        if self.subset is None or size <= self.subset:
            return ALL_ROWS
        if has_start and not self.restarts:
            return ALL_ROWS  # a subset could not improve on where the search begins
        return np.sort(rng.permutation(size)[: self.subset])

    def _deadline(self, start_time: float, part: float) -> float:
        """When a part of the training has to end, by ``time.perf_counter`` [s]."""
        if self.time_limit is None:
            return np.inf
        return start_time + self.time_limit * part

    def _check_success(self, objective: np.ndarray, names: Sequence[str]) -> None:
        """Raises ``TrainingError`` where every start of an output failed (k,)."""
        failed: list[int] = np.flatnonzero(objective >= FAILED).tolist()
        if failed:
            penalty = "" if self.penalty is None else " and a finite penalty"
            raise TrainingError(
                failed,
                f"no start of {self.restarts + 1} led to a positive definite kernel "
                f"matrix{penalty} for {', '.join(names[a] for a in failed)}: lower "
                "signal_to_noise_limit, or remove duplicate rows",
            )


@explains_arguments
def train(transitions: Transitions, seed: int = 0, **settings: Any) -> Training:
    """Fits one GP per output: ``Trainer(**settings)(transitions, seed)``.

    ``gpmpc.models.train`` takes a system as well, and learns what that leaves open.

    >>> from gpmpc.datasets import RandomData
    >>> from gpmpc.systems import double_integrator
    >>> data = RandomData(samples=10).transitions(double_integrator())
    >>> train(data, predicts="difference", restarts=0).posterior
    GPPosterior(10 points, n=2, m=1, k=2, predicts='difference', torch.float64 on cpu)

    See Also:
        ``Trainer`` for the settings; ``SparseTrainer`` for thousands of rows.
    """
    if "system" in settings:
        raise SettingError("system", "is an argument of train of gpmpc.models")
    return Trainer(**settings)(transitions, seed)


def _search_features(data: TrainingData) -> SearchFeatures:
    """The features in scaled units, as the searches of all outputs take them."""
    factor = data.feature_scaling.factor.numpy()
    return SearchFeatures(
        points=data.feature_scaling.scale(data.features).numpy(),
        scales=data.feature_scales / factor,
        constant=data.constant.features,
        prior_lengthscales=data.prior.lengthscales / factor,
    )


def _with_moving_rows(
    rows: np.ndarray | slice, targets: np.ndarray
) -> np.ndarray | slice:
    """Adds rows that move to those that are searched first, if none of these does.

    An output that moves in few rows only, as at a contact, may be constant in a random
    subset. Its optimum there is noise, out of which the search over all rows does not
    find. At most half as many rows are added, those that differ most.

    Args:
        rows: Indices of a subset, or ``ALL_ROWS``.
        targets: One output's (N,).
    """
    if isinstance(rows, slice):
        return rows
    differences = np.abs(targets - targets[rows[0]])
    moves = differences > ROUND_OFF * differences.max()
    if moves[rows].any():
        return rows
    largest = np.argsort(differences)[-max(len(rows) // 2, 1) :]
    return np.union1d(rows, largest[moves[largest]])


def _deviation_of_constant(data: TrainingData, output: int) -> float | None:
    """The scaled prior deviation of a constant output; None of one to be searched."""
    deviations = data.prior.deviations
    if deviations is None or not data.constant.outputs[output]:
        return None
    return deviations[output] / float(data.target_scaling.factor[output])
