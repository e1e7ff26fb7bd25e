r"""Points that come and go while a controller runs, in O(N^2) each: K + sn2 I is not factorised anew.

Adding points extends the Cholesky factor by rows, L21' = L^-1 K(X, X*), L22 L22' = K(X*, X*) + sn2 I - L21 L21';
removing one changes only the block below it (``gpmpc._kernels._window``). The weights are solved for from the factor
each time, so that no error is carried along with them.

The least informative point is the one whose removal changes the posterior over functions least, in Kullback-Leibler
divergence. With and without y_i the two posteriors differ by one factor of the likelihood, which depends on f(x~_i)
alone; so the leave-one-out formulas (Rasmussen and Williams, 2006, eq. (5.12)) give their divergence from
P = (K + sn2 I)^-1 and beta = P (y - offset):

    KL_i = 1/2 sum_a [ e_ai - 1 - log e_ai + beta_ai^2 (1 / P_aii - sn2_a) ],     e_ai = sn2_a P_aii

(e is the variance of f(x~_i) with y_i over that without.) Of the pseudo-observations of a sparse model, whose noise is
correlated, only the variances are counted.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from gpmpc._kernels._window import drop_point
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    UnsupportedModel,
    check_choice,
    check_number,
)
from gpmpc.gaussian import check_tensors
from gpmpc.gp._kernel import check_positive_definite, check_posterior, kernel_matrix
from gpmpc.gp._posterior import GPPosterior
from gpmpc.gp._transitions import Transitions, check_transitions

_log = logging.getLogger(__name__)
_MANY = 0.2  # where more than this part of the points is removed, one factorisation costs less than the updates


def append_transitions(posterior: GPPosterior, transitions: Transitions) -> GPPosterior:
    """Appends transitions to a posterior's data; the hyperparameters stay (``Trainer.refit`` trains them).

    Raises:
        ShapeError: The transitions have other dimensions.
        UnsupportedModel: The GPs predict values, which transitions do not hold: ``append_points``.
        SettingError: The larger kernel matrix is not positive definite in this dtype.
    """
    targets = targets_of(posterior, transitions)
    return append_points(posterior, transitions.features, targets)


def append_points(
    posterior: GPPosterior, features: Tensor, targets: Tensor
) -> GPPosterior:
    """Appends points x~ = (x, u) (p, n + m) with targets (p, k) to a posterior's data."""
    check_tensors(features=features, targets=targets)
    for key, value in (("features", features), ("targets", targets)):
        if value.is_complex():
            raise SettingError(key, f"must be real numbers; got {value.dtype}")
    features = features.to(posterior.features)
    targets = targets.to(posterior.features)
    given = {"features": features, "targets": targets}
    check_posterior(given, posterior.input_dim, posterior.predicts, posterior.dtype)
    if (got := (features.shape[1], targets.shape[1])) != (
        posterior.features.shape[1],
        posterior.output_dim,
    ):
        raise ShapeError(
            f"points must have features and targets like those of {posterior}; got {got[0]} and {got[1]}"
        )
    size = len(posterior)
    p = len(features)
    scales = posterior.lengthscales
    sf2 = posterior.signal_variance
    old_targets = (posterior.targets - posterior.offset).mT[..., None]  # (k, N, 1)
    new_targets = (targets - posterior.offset).mT[..., None]
    # One pass over the factor serves the new rows and the first half of the weights.
    right = torch.cat(
        [kernel_matrix(posterior.features, features, scales, sf2), old_targets], dim=-1
    )
    right = torch.linalg.solve_triangular(posterior.cholesky, right, upper=False)
    L21 = right[..., :p].mT
    w1 = right[..., p:]
    corner = kernel_matrix(features, features, scales, sf2) - L21 @ L21.mT
    corner.diagonal(dim1=-2, dim2=-1).add_(posterior.noise_variance[:, None])
    L22, info = torch.linalg.cholesky_ex(corner)
    check_positive_definite(info, sf2, posterior.noise_variance)
    cholesky = posterior.cholesky.new_empty(posterior.output_dim, size + p, size + p)
    cholesky[:, :size, :size] = posterior.cholesky
    cholesky[:, :size, size:] = 0
    cholesky[:, size:, :size] = L21
    cholesky[:, size:, size:] = L22
    w2 = torch.linalg.solve_triangular(L22, new_targets - L21 @ w1, upper=False)
    weights = torch.linalg.solve_triangular(
        cholesky.mT, torch.cat([w1, w2], dim=-2), upper=True
    )[..., 0]
    features = torch.cat([posterior.features, features])
    targets = torch.cat([posterior.targets, targets])
    return replace(
        posterior,
        features=features,
        targets=targets,
        cholesky=cholesky,
        weights=weights,
    )


def remove_points(
    posterior: GPPosterior, indices: Sequence[int] | Tensor
) -> GPPosterior:
    """Removes points (rows of ``features``) from a posterior's data.

    Raises:
        SettingError: An index is out of range or stands there twice.
        DataError: No point is left.
    """
    size = len(posterior)
    removed = _indices(indices, size)
    if not removed:
        return posterior
    kept = torch.tensor(
        sorted(set(range(size)).difference(removed)), device=posterior.device
    )
    if not len(kept):
        raise DataError(
            f"a posterior needs at least one point; removing {len(removed)} of {size} leaves none"
        )
    if (
        posterior.device.type != "cpu"
        or posterior.cholesky.requires_grad
        or len(removed) > _MANY * size
    ):
        rows = posterior.cholesky[:, kept]
        first = removed[0]  # nothing changes above it
        cholesky = rows[:, :, kept]
        cholesky[:, first:, first:] = torch.linalg.cholesky(
            rows[:, first:, first:] @ rows[:, first:, first:].mT
        )
    else:
        columns = np.ascontiguousarray(posterior.cholesky.mT.detach().numpy())
        for index in reversed(removed):
            before = columns
            columns = np.empty_like(columns[:, 1:, 1:], order="C")
            drop_point(before, index, columns)
        cholesky = torch.from_numpy(columns).mT
    targets = posterior.targets[kept]
    half = torch.linalg.solve_triangular(
        cholesky, (targets - posterior.offset).mT[..., None], upper=False
    )
    weights = torch.linalg.solve_triangular(cholesky.mT, half, upper=True)[..., 0]
    return replace(
        posterior,
        features=posterior.features[kept],
        targets=targets,
        cholesky=cholesky,
        weights=weights,
    )


def targets_of(posterior: GPPosterior, transitions: Transitions) -> Tensor:
    """The targets (N, n) that a posterior's GPs have for transitions; errors are those of ``append_transitions``."""
    check_transitions(transitions, posterior)
    return transitions.targets(posterior.predicts)


@dataclass(frozen=True)
class SlidingWindow:
    """Appends new points to a posterior and removes others until it holds no more than a given number.

    New points stay under either rule, unless they alone are more than that (which is logged).

    Raises:
        SettingError: Fewer than one point, or an unknown rule.
    """

    points: int  #: how many points the posterior may hold
    #: which go first. ``"oldest"`` costs O(N^2) a point; ``"least_informative"`` needs the inverse of the kernel
    #: matrix, O(N^3) a call
    remove: Literal["oldest", "least_informative"] = "oldest"

    def __post_init__(self) -> None:
        check_number("points", self.points, least=1, whole=True)
        check_choice("remove", self.remove, ("oldest", "least_informative"))

    def __call__(self, posterior: GPPosterior, transitions: Transitions) -> GPPosterior:
        """The posterior with the transitions, held to ``points`` points; errors are those of ``append_transitions``."""
        if not isinstance(posterior, GPPosterior):
            got = type(posterior).__name__
            raise UnsupportedModel(
                f"a window is for a GPPosterior (ResidualModel.append takes one); got {got}"
            )
        targets = targets_of(posterior, transitions)
        return self.append(posterior, transitions.features, targets)

    def append(
        self, posterior: GPPosterior, features: Tensor, targets: Tensor
    ) -> GPPosterior:
        """The posterior with points x~ (p, n + m) and their targets (p, k), held to ``points`` points."""
        larger = append_points(posterior, features, targets)
        removable = len(posterior)
        if len(features) > self.points:
            _log.warning(
                "%d new points exceed the window of %d: some are removed too",
                len(features),
                self.points,
            )
            larger = remove_points(larger, range(removable))
            removable = len(features)
        if (excess := len(larger) - self.points) <= 0:
            return larger
        oldest = self.remove == "oldest"
        return remove_points(
            larger,
            range(excess) if oldest else least_informative(larger, excess, removable),
        )


def least_informative(
    posterior: GPPosterior, count: int, candidates: int | None = None
) -> list[int]:
    """Which of the first ``candidates`` points to drop, each the least informative when those before it are gone."""
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
        # Leaving i out is conditioning the precision matrix: the block inverse of what remains.
        column = P[:, :, i].clone()
        pivot = P[:, i, i].clone()
        beta -= column * (beta[:, i] / pivot)[:, None]
        P -= column[:, :, None] * (column / pivot[:, None])[:, None, :]
        P[:, i, i] = 1.0  # gone: any positive number
    return chosen


def _divergence(P: Tensor, beta: Tensor, noise: Tensor) -> Tensor:
    """KL_i (N,) from the diagonals of P, beta and the noise variances (k, N)."""
    e = (noise * P).clamp(max=1.0)
    return (e - 1 - e.log() + beta**2 * (1 - e) / P).sum(0) / 2


def _noise_variances(posterior: GPPosterior) -> Tensor:
    """Of the targets (k, N): sn2, or what the factor of pseudo-observations has on its diagonal beyond the kernel."""
    nominal = posterior.noise_variance[:, None].expand_as(posterior.weights)
    if posterior.has_observation_noise:
        return nominal
    diagonal = posterior.cholesky.square().sum(-1) - posterior.signal_variance[:, None]
    return diagonal.clamp_min(torch.finfo(posterior.dtype).eps)


def _indices(indices: Sequence[int] | Tensor, size: int) -> list[int]:
    """Different indices from 0 to size - 1 in ascending order; negative ones count from the end, as everywhere."""
    given = np.atleast_1d(np.asarray(indices)).tolist()
    if any(
        isinstance(i, bool) or not isinstance(i, int) or not -size <= i < size
        for i in given
    ):
        raise SettingError(
            "indices", f"must be whole numbers from {-size} to {size - 1}; got {given}"
        )
    found = sorted({i % size for i in given})
    if len(found) != len(given):
        raise SettingError("indices", f"must be different; got {given}")
    return found
