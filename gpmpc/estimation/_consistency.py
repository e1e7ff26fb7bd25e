"""Consistency of estimates: are errors as large as their covariances say?

The normalised estimation error squared e' P^-1 e (NEES), e the error of an estimate of
covariance P, and the normalised innovation squared nu' S^-1 nu (NIS) have the mean n,
the number of entries, where an estimator is consistent; over N independent ones N times
the mean is chi-square of N n degrees of freedom (Bar-Shalom, Li and Kirubarajan, 2001,
section 5.4). Too large a mean: the estimator is overconfident. Innovations of a
consistent filter are white.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

from gpmpc._angles import state_difference
from gpmpc._calls import explains_arguments
from gpmpc.estimation._conditioning import decorrelated
from gpmpc.exceptions import DataError, SettingError, ShapeError, check_number
from gpmpc.gaussian import Gaussian


@dataclass(frozen=True, eq=False)
class Consistency:
    """Normalised squared errors, and the band that their mean should lie in.

    See Also:
        ``normalized_errors``, which returns it.
    """

    values: np.ndarray  #: one an error (N,); errors without a finite entry are left out
    #: degrees of freedom of each: how many entries were finite (N,)
    degrees: np.ndarray
    #: limits of the mean, per degree of freedom, for independent errors
    band: tuple[float, float]

    @property
    def mean(self) -> float:
        """Mean per degree of freedom: 1 where the covariances are right."""
        return float(self.values.sum() / self.degrees.sum())

    @property
    def consistent(self) -> bool:
        """Whether the mean lies in the band."""
        return self.band[0] <= self.mean <= self.band[1]


@explains_arguments
def normalized_errors(
    errors: Any, covariances: Any, level: float = 0.95, independent: int | None = None
) -> Consistency:
    """Computes normalised squared errors.

    They are the NEES of estimation errors, or the NIS of innovations.

    Args:
        errors: (..., n); entries that are not finite (nothing was measured) are left
            out.
        covariances: Of the errors (..., n, n).
        level: Probability of the band.
        independent: How many of the errors are independent, for the band; all by
            default. Estimates of one run are correlated in time, those of different
            runs are not.

    Raises:
        ShapeError: The two do not belong together.
        SettingError: The level is not between 0 and 1, or no error is independent, or
            more than there are.
        DataError: No error is finite, or a covariance is not positive definite: the
            chi-square of such an error is not defined.

    >>> import numpy as np
    >>> errors = np.random.default_rng(0).normal(size=(500, 2))
    >>> found = normalized_errors(errors, np.tile(np.eye(2), (500, 1, 1)))
    >>> low, high = found.band
    >>> bool(low < found.values.sum() / found.degrees.sum() < high)
    True

    See Also:
        ``estimation_errors``; ``autocorrelation``.
    """
    check_number("level", level)
    if not 0 < level < 1:
        raise SettingError("level", f"must lie between 0 and 1; got {level}")
    if independent is not None:
        check_number("independent", independent, least=1, whole=True)
    e = _on_host(errors)
    P = _on_host(covariances)
    n = e.shape[-1]
    if P.shape != (*e.shape, n):
        raise ShapeError(
            f"errors (..., n) need covariances (..., n, n); got {tuple(e.shape)} and "
            f"{tuple(P.shape)}"
        )
    e = e.reshape(-1, n)
    P = P.reshape(-1, n, n)
    missing = ~torch.isfinite(e)
    measured = ~missing.all(-1)
    if not bool(measured.any()):
        raise DataError("no error is finite")
    e = e[measured]
    P = P[measured]
    missing = missing[measured]
    P = _with_independent(P, missing)
    e = torch.where(missing, 0.0, e)
    if not bool(torch.isfinite(P).all()):
        raise DataError("the covariances must be finite; got one that is not")
    root, info = torch.linalg.cholesky_ex(P)
    if bool(info.any()):
        raise DataError(
            "the covariances must be positive definite; got one that is not: leave out "
            "entries that are known exactly"
        )
    whitened = torch.linalg.solve_triangular(root, e[..., None], upper=False)
    values = whitened[..., 0].square().sum(-1).numpy()
    degrees = (~missing).sum(-1).numpy()
    count = len(values) if independent is None else independent
    if count > len(values):
        raise SettingError(
            "independent", f"must be at most {len(values)}, the errors; got {count}"
        )
    total = float(degrees.mean()) * count
    low, high = chi2.ppf([(1 - level) / 2, (1 + level) / 2], total) / total
    return Consistency(values=values, degrees=degrees, band=(float(low), float(high)))


@explains_arguments
def estimation_errors(belief: Gaussian, states: Any, angles: Any = ()) -> Tensor:
    """Computes the errors x - mu (..., n) of beliefs; of angles, within half a turn.

    >>> import torch
    >>> from gpmpc.gaussian import Gaussian
    >>> belief = Gaussian.certain(torch.tensor([3.0]).double())
    >>> state = torch.tensor([-3.0]).double()
    >>> estimation_errors(belief, state, angles=[0]).round(decimals=2).tolist()
    [0.28]

    See Also:
        ``normalized_errors``.
    """
    mean = belief.mean
    truth = torch.as_tensor(states, dtype=mean.dtype, device=mean.device)
    return state_difference(truth, belief.mean, angles)


@explains_arguments
def autocorrelation(
    innovations: Any, covariances: Any, lag: int = 1
) -> tuple[float, float]:
    """Computes the autocorrelation of whitened innovations (T, p).

    Whitened are L^-1 nu with S = L L', L lower triangular: of entries whose errors are
    correlated each counts by what the ones before it do not say already. An entry that
    was not measured, or of which S leaves no variance, does not count.

    Args:
        innovations: nu (T, p); entries that are not finite were not measured.
        covariances: S (T, p, p).
        lag: Steps between the two of a pair.

    Returns:
        The autocorrelation, and the 95 % limit of its size where they are white.

    Raises:
        ShapeError: The two do not belong together.
        SettingError: The lag is no whole number of one or more.
        DataError: Fewer than two pairs are finite, or all innovations are zero.

    >>> import numpy as np
    >>> innovations = np.random.default_rng(0).normal(size=(500, 1))
    >>> value, bound = autocorrelation(innovations, np.ones((500, 1, 1)))
    >>> abs(value) < bound
    True

    See Also:
        ``normalized_errors``; ``FilterRun``, which has innovations.
    """
    e = _on_host(innovations)
    S = _on_host(covariances)
    if e.dim() != 2 or S.shape != (*e.shape, e.shape[1]):
        raise ShapeError(
            f"innovations (T, p) need covariances (T, p, p); got {tuple(e.shape)} and "
            f"{tuple(S.shape)}"
        )
    check_number("lag", lag, least=1, whole=True)
    white = _whitened(e, S).numpy()
    first = white[:-lag]
    second = white[lag:]
    pairs = np.isfinite(first) & np.isfinite(second)
    if pairs.sum() < 2:
        raise DataError(
            "an autocorrelation needs two pairs of finite innovations or more"
        )
    a = first[pairs]
    b = second[pairs]
    scale = np.sqrt((a**2).sum() * (b**2).sum())
    if not scale:
        raise DataError("an autocorrelation needs innovations that are not all zero")
    correlation = (a * b).sum() / scale
    limit = 1.96 / np.sqrt(len(a))
    return float(correlation), float(limit)


def _on_host(values: Any) -> Tensor:
    """Returns numbers as float64 on the CPU, without a graph."""
    return torch.as_tensor(values, dtype=torch.float64).detach().cpu()


def _whitened(errors: Tensor, covariances: Tensor) -> Tensor:
    """Computes L^-1 e (T, p) with S = L L'; NaN where nothing was measured.

    Args:
        errors: e (T, p), not finite where nothing was measured.
        covariances: S (T, p, p).
    """
    missing = ~torch.isfinite(errors)
    unit_lower, variances = decorrelated(_with_independent(covariances, missing))
    independent = torch.linalg.solve_triangular(
        unit_lower,
        torch.where(missing, 0.0, errors)[..., None],
        upper=False,
        unitriangular=True,
    )[..., 0]
    unknown = missing | (variances <= 0)
    return torch.where(unknown, torch.nan, independent / variances.sqrt())


def _with_independent(covariances: Tensor, missing: Tensor) -> Tensor:
    """Makes missing entries (T, p) of covariances (T, p, p) independent of others."""
    in_missing = missing[:, :, None] | missing[:, None, :]
    eye = torch.eye(covariances.shape[-1], dtype=covariances.dtype)
    return torch.where(in_missing, eye, covariances)
