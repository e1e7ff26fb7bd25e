r"""Adds and removes points while a controller runs, in O(N^2) each.

K + sn2 I is not factorised anew.

Adding points extends the Cholesky factor by rows, L21' = L^-1 K(X, X*), L22 L22' =
K(X*, X*) + sn2 I - L21 L21'; removing one changes only the block below it
(``gpmpc._kernels._window``). The weights are solved for from the factor each time, so
that no error is carried along with them.

The least informative point is the one whose removal changes the posterior over
functions least, in Kullback-Leibler divergence. With and without y_i the two posteriors
differ by one factor of the likelihood, which depends on f(x~_i) alone; so the
leave-one-out formulas (Rasmussen and Williams, 2006, eq. (5.12)) give their divergence
from P = (K + sn2 I)^-1 and beta = P (y - offset):

    KL_i = 1/2 sum_a [ e_ai - 1 - log e_ai + beta_ai^2 (1 / P_aii - sn2_a) ]
    e_ai = sn2_a P_aii

(e is the variance of f(x~_i) with y_i over that without.) Of the pseudo-observations of
a sparse model, whose noise is correlated, only the variances are counted.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._kernels._window import drop_point
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_choice,
    check_number,
)
from gpmpc.gaussian import check_tensors
from gpmpc.gp._kernel import check_positive_definite, kernel_matrix
from gpmpc.gp._posterior import GPPosterior, check_posterior
from gpmpc.gp._tensor_checks import check_gp_tensors
from gpmpc.gp._transitions import Transitions, check_transitions

_log = logging.getLogger(__name__)
# where more than this part of the points is removed, one factorisation costs less than
# the updates
_LARGE_PART = 0.2


@explains_arguments
def append_transitions(posterior: GPPosterior, transitions: Transitions) -> GPPosterior:
    """Appends transitions to a posterior's data.

    The hyperparameters stay; ``Trainer.refit`` trains them.

    Raises:
        ShapeError: The transitions have other dimensions.
        UnsupportedModel: The model is no ``GPPosterior``, or its GPs predict values,
            which transitions do not hold: use ``append_points``.
        SettingError: The larger kernel matrix is not positive definite in this dtype.

    >>> from gpmpc.datasets import RandomData
    >>> from gpmpc.gp import Trainer
    >>> from gpmpc.systems import double_integrator
    >>> data = RandomData(samples=12).transitions(double_integrator())
    >>> gp = Trainer(predicts="difference", restarts=0)(data[:10]).posterior
    >>> len(append_transitions(gp, data[10:]))
    12

    See Also:
        ``append_points``; ``remove_points``; ``Trainer.refit``, which trains
        anew.
    """
    targets = targets_of(posterior, transitions)
    return append_points(posterior, transitions.features, targets)


@explains_arguments
def append_points(
    posterior: GPPosterior, features: Tensor, targets: Tensor
) -> GPPosterior:
    """Appends points to a posterior's data.

    Args:
        posterior: The posterior.
        features: x~ = (x, u) (p, n + m).
        targets: (p, k).

    Raises:
        UnsupportedModel: The model is no ``GPPosterior``.
        ShapeError: The points have other dimensions, or there is none.
        SettingError: The larger kernel matrix is not positive definite in this dtype.
        DataError: An entry is not finite.

    See Also:
        ``append_transitions``; ``remove_points``; ``SlidingWindow``.
    """
    features, targets = _checked_points(posterior, features, targets)
    size = len(posterior)
    p = len(features)
    signal_variance = posterior.signal_variance
    lengthscales = posterior.lengthscales
    cross = kernel_matrix(posterior.features, features, lengthscales, signal_variance)
    kernel = kernel_matrix(features, features, lengthscales, signal_variance)

    # One pass over the factor serves the new rows and the weights.
    old_residuals = (posterior.targets - posterior.offset).mT[..., None]  # (k, N, 1)
    columns = torch.cat([cross, old_residuals], dim=-1)
    whitened = torch.linalg.solve_triangular(posterior.cholesky, columns, upper=False)
    L21 = whitened[..., :p].mT
    whitened_old = whitened[..., p:]  # L^-1 (y - offset)
    schur_complement = kernel - L21 @ L21.mT
    noise = posterior.observation_noise
    if noise is None:  # new rows are observations, also beside pseudo-observations
        noise = posterior.noise_variance
    schur_complement.diagonal(dim1=-2, dim2=-1).add_(noise[:, None])
    L22, info = torch.linalg.cholesky_ex(schur_complement)
    check_positive_definite(info, signal_variance, noise)
    cholesky = posterior.cholesky.new_empty(posterior.output_dim, size + p, size + p)
    cholesky[:, :size, :size] = posterior.cholesky
    cholesky[:, :size, size:] = 0
    cholesky[:, size:, :size] = L21
    cholesky[:, size:, size:] = L22

    new_residuals = (targets - posterior.offset).mT[..., None]
    whitened_new = torch.linalg.solve_triangular(
        L22, new_residuals - L21 @ whitened_old, upper=False
    )
    whitened_residuals = torch.cat([whitened_old, whitened_new], dim=-2)
    weights = torch.linalg.solve_triangular(
        cholesky.mT, whitened_residuals, upper=True
    )[..., 0]
    return replace(
        posterior,
        features=torch.cat([posterior.features, features]),
        targets=torch.cat([posterior.targets, targets]),
        cholesky=cholesky,
        weights=weights,
    )


def _checked_points(
    posterior: GPPosterior, features: Tensor, targets: Tensor
) -> tuple[Tensor, Tensor]:
    """Converts points to the posterior's type, and checks that they belong to it."""
    check_posterior("posterior", posterior)
    check_tensors(features=features, targets=targets)
    for key, value in (("features", features), ("targets", targets)):
        if value.is_complex():
            raise SettingError(key, f"must be real numbers; got {value.dtype}")
    features = features.to(posterior.features)
    targets = targets.to(posterior.features)
    check_gp_tensors(
        features,
        targets,
        posterior.input_dim,
        posterior.predicts,
        posterior.dtype,
    )
    d = features.shape[1]
    k = targets.shape[1]
    if d != posterior.features.shape[1] or k != posterior.output_dim:
        raise ShapeError(
            f"points must have features and targets like those of {posterior}; "
            f"got {d} and {k}"
        )
    return features, targets


@explains_arguments
def remove_points(
    posterior: GPPosterior, indices: Sequence[int] | Tensor
) -> GPPosterior:
    """Removes points (rows of ``features``) from a posterior's data.

    Raises:
        UnsupportedModel: The model is no ``GPPosterior``.
        SettingError: An index is out of range or stands there twice.
        DataError: No point is left.
        torch.linalg.LinAlgError: So many are removed that the rest is factorised anew,
            and it is not positive definite in this dtype.

    See Also:
        ``append_points``; ``SlidingWindow``.
    """
    check_posterior("posterior", posterior)
    size = len(posterior)
    removed = _checked_indices(indices, size)
    if not removed:
        return posterior
    remaining = torch.tensor(
        sorted(set(range(size)).difference(removed)), device=posterior.device
    )
    if not len(remaining):
        raise DataError(
            f"a posterior needs at least one point; removing {len(removed)} of {size} "
            "leaves none"
        )
    in_host_memory = posterior.device.type == "cpu"
    in_graph = posterior.cholesky.requires_grad
    if in_host_memory and not in_graph and len(removed) <= _LARGE_PART * size:
        cholesky = _drop_one_by_one(posterior.cholesky, removed)
    else:
        cholesky = _refactorize(posterior.cholesky, remaining, first=removed[0])
    targets = posterior.targets[remaining]
    residuals = (targets - posterior.offset).mT[..., None]
    whitened_residuals = torch.linalg.solve_triangular(cholesky, residuals, upper=False)
    weights = torch.linalg.solve_triangular(
        cholesky.mT, whitened_residuals, upper=True
    )[..., 0]
    return replace(
        posterior,
        features=posterior.features[remaining],
        targets=targets,
        cholesky=cholesky,
        weights=weights,
    )


def _drop_one_by_one(cholesky: Tensor, removed: list[int]) -> Tensor:
    """Drops points from factors (k, N, N) by rank-one updates."""
    columns = np.ascontiguousarray(cholesky.mT.detach().numpy())
    for index in reversed(removed):
        smaller = np.empty_like(columns[:, 1:, 1:], order="C")
        drop_point(columns, index, smaller)
        columns = smaller
    return torch.from_numpy(columns).mT


def _refactorize(cholesky: Tensor, remaining: Tensor, first: int) -> Tensor:
    """Factorises again without some points, of which ``first`` is the first."""
    rows = cholesky[:, remaining]
    smaller = rows[:, :, remaining]
    # Nothing changes above the first point.
    block = rows[:, first:, first:]
    smaller[:, first:, first:] = torch.linalg.cholesky(block @ block.mT)
    return smaller


def targets_of(posterior: GPPosterior, transitions: Transitions) -> Tensor:
    """Returns the targets (N, n) that a posterior's GPs have for transitions.

    Errors are those of ``append_transitions``.
    """
    check_posterior("posterior", posterior)
    check_transitions(transitions, posterior)
    return transitions.targets(posterior.predicts)


@explains_arguments
@dataclass(frozen=True)
class SlidingWindow:
    """Appends points to a posterior and removes others that exceed a given number.

    New points stay under either rule, unless they alone are more than that (which is
    logged).

    Raises:
        SettingError: Fewer than one point, or an unknown rule.

    >>> SlidingWindow(points=100, remove="least_informative").points
    100

    See Also:
        ``append_points``, without a limit; ``gpmpc.learning`` for learning in
        flight.
    """

    points: int  #: how many points the posterior may hold
    #: which go first. ``"oldest"`` costs O(N^2) a point; ``"least_informative"`` needs
    #: the inverse of the kernel matrix, O(N^3) a call
    remove: Literal["oldest", "least_informative"] = "oldest"

    def __post_init__(self) -> None:
        check_number("points", self.points, least=1, whole=True)
        check_choice("remove", self.remove, ("oldest", "least_informative"))

    def __call__(self, posterior: GPPosterior, transitions: Transitions) -> GPPosterior:
        """Appends transitions, and removes what exceeds ``points``.

        Errors are those of ``append_transitions``.
        """
        targets = targets_of(posterior, transitions)
        return self.append(posterior, transitions.features, targets)

    def append(
        self, posterior: GPPosterior, features: Tensor, targets: Tensor
    ) -> GPPosterior:
        """Appends points x~ (p, n + m) with targets (p, k), and removes others."""
        extended = append_points(posterior, features, targets)
        candidates = len(posterior)
        if len(features) <= self.points:
            return self._reduce(extended, candidates)
        _log.warning(
            "%d new points exceed the window of %d: some are removed too",
            len(features),
            self.points,
        )
        new_alone = remove_points(extended, range(candidates))
        return self._reduce(new_alone, candidates=len(features))

    def _reduce(self, posterior: GPPosterior, candidates: int) -> GPPosterior:
        """Removes points that exceed ``points``, some of the first ``candidates``."""
        excess = len(posterior) - self.points
        if excess <= 0:
            return posterior
        if self.remove == "oldest":
            return remove_points(posterior, range(excess))
        return remove_points(
            posterior, least_informative(posterior, excess, candidates)
        )


def least_informative(
    posterior: GPPosterior, count: int, candidates: int | None = None
) -> list[int]:
    """Chooses points to drop, each the least informative without those before it.

    Args:
        posterior: The posterior.
        count: How many points go.
        candidates: How many of the first points may go; all by default.
    """
    P = posterior.precision.clone()
    beta = posterior.weights.clone()
    noise = _noise_variances(posterior)
    allowed = torch.zeros(len(posterior), dtype=torch.bool, device=posterior.device)
    allowed[:candidates] = True
    chosen = []
    for _ in range(count):
        score = _divergence(P.diagonal(dim1=-2, dim2=-1), beta, noise)
        i = int(torch.where(allowed, score, torch.inf).argmin())
        chosen.append(i)
        allowed[i] = False
        # Leaving i out is conditioning the precision matrix: the block inverse of what
        # remains.
        column = P[:, :, i].clone()
        pivot = P[:, i, i].clone()
        beta -= column * (beta[:, i] / pivot)[:, None]
        P -= column[:, :, None] * (column / pivot[:, None])[:, None, :]
        P[:, i, i] = 1.0  # gone: any positive number
    return chosen


def _divergence(P: Tensor, beta: Tensor, noise: Tensor) -> Tensor:
    """Computes KL_i (N,) from diagonals of P, beta and noise variances (k, N)."""
    e = (noise * P).clamp(max=1.0)
    return (e - 1 - e.log() + beta**2 * (1 - e) / P).sum(0) / 2


def _noise_variances(posterior: GPPosterior) -> Tensor:
    """Returns the noise variances of the targets (k, N).

    They are those of observations, or what the factor of pseudo-observations has on its
    diagonal beyond the kernel.
    """
    noise = posterior.observation_noise
    if noise is not None:
        return noise[:, None].expand_as(posterior.weights)
    diagonal = posterior.cholesky.square().sum(-1) - posterior.signal_variance[:, None]
    return diagonal.clamp_min(torch.finfo(posterior.dtype).eps)


def _checked_indices(indices: Sequence[int] | Tensor, size: int) -> list[int]:
    """Returns different indices from 0 to size - 1 in ascending order.

    Negative ones count from the end, as everywhere.
    """
    if isinstance(indices, Tensor):
        indices = indices.cpu()
    values = np.atleast_1d(np.asarray(indices)).tolist()
    for i in values:
        is_whole = isinstance(i, int) and not isinstance(i, bool)
        if not is_whole or not -size <= i < size:
            raise SettingError(
                "indices",
                f"must be whole numbers from {-size} to {size - 1}; got {values}",
            )
    different = sorted({i % size for i in values})
    if len(different) != len(values):
        raise SettingError("indices", f"must be different; got {values}")
    return different
