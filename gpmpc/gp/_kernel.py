"""The SE-ARD kernel between two sets of points, the factor of its noisy matrix, and the checks of its arguments."""

from typing import Any, Literal, NamedTuple

from torch import Tensor, float64, int32, isfinite, linalg, nonzero, zeros

from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_choice,
    check_number,
)
from gpmpc.gaussian import check_tensors

Predicts = Literal["next_state", "difference", "value"]
PREDICTS = ("next_state", "difference", "value")
IGNORED = 1e8  # length-scale of an input that drops out of a kernel, in units of its magnitude
_MANY = 1000  # points: from here on kernel matrices are made and factorised one after another, in place
_ROWS = 64  # of such a matrix at a time: they fit the cache
_FEW = 16  # columns of a kernel matrix whose differences, all at once, fit the cache


def kernel_matrix(
    points: Tensor, others: Tensor, lengthscales: Tensor, signal_variance: Tensor
) -> Tensor:
    """k_a(x~_i, x~_j) (k, N, M) of points (N, d) and others (M, d).

    Summed over differences, a column at a time where there are many: exact for near points, where
    |x|^2 + |x'|^2 - 2 x'x cancels.
    """
    if len(others) <= _FEW:
        squares = (points[:, None] - others).square() @ lengthscales.mT**-2  # (N, M, k)
        return signal_variance[:, None, None] * (squares.movedim(-1, 0) / -2).exp()
    total = zeros(
        len(lengthscales),
        len(points),
        len(others),
        dtype=points.dtype,
        device=points.device,
    )
    for ours, theirs, scale in zip(points.T, others.T, lengthscales.T, strict=True):
        total.addcmul_((ours[:, None] - theirs).square(), scale[:, None, None] ** -2)
    return signal_variance[:, None, None] * (total / -2).exp()


def centred(points: Any) -> Any:
    """Points (N, d), NumPy's or torch's, moved to mean zero: elsewhere distances from a matrix product cancel.

    A stationary kernel does not depend on it. The first point is subtracted first, which is exact between near numbers:
    so a shift of all points changes no bit of the result.
    """
    away = points - points[0]
    return away - away.mean(0)


def factorize(
    inputs: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
) -> Tensor:
    """The lower Cholesky factors of K + sn2 I (k, N, N); ``SettingError`` where one is not positive definite."""
    if len(inputs) > _MANY and not any(
        t.requires_grad for t in (inputs, lengthscales, signal_variance, noise_variance)
    ):
        cholesky, info = _factorize_in_place(
            inputs, lengthscales, signal_variance, noise_variance
        )
    else:
        kernel = kernel_matrix(inputs, inputs, lengthscales, signal_variance)
        kernel.diagonal(dim1=-2, dim2=-1).add_(noise_variance[:, None])
        cholesky, info = linalg.cholesky_ex(kernel)
    check_positive_definite(info, signal_variance, noise_variance)
    return cholesky


def check_positive_definite(
    failed: Tensor, signal_variance: Tensor, noise_variance: Tensor
) -> None:
    """Raises ``SettingError`` where the factorisation of an output's K + sn2 I has failed (k,)."""
    if bool(failed.any()):
        output = int(nonzero(failed)[0])
        raise SettingError(
            "noise_variance",
            f"the kernel matrix of output {output} is not positive definite in {signal_variance.dtype}; "
            f"signal-to-noise ratio {float((signal_variance / noise_variance)[output]):.1e}: raise the noise",
        )


def _factorize_in_place(
    inputs: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
) -> tuple[Tensor, Tensor]:
    """Factorises in the memory of the result (k, N, N) and little more; returns LAPACK's info (k,) too."""
    (size, _), outputs = inputs.shape, len(lengthscales)
    info = zeros(outputs, dtype=int32, device=inputs.device)
    cholesky = inputs.new_empty(
        outputs, size, size
    ).mT  # columns contiguous, as LAPACK wants them
    for a, factor in enumerate(cholesky):
        for end in range(_ROWS, size + _ROWS, _ROWS):  # the lower triangle
            rows = slice(end - _ROWS, end)
            columns = slice(0, end)
            scales = lengthscales[a, None], signal_variance[a, None]
            factor[rows, columns] = kernel_matrix(
                inputs[rows], inputs[columns], *scales
            )[0]
        factor.diagonal().add_(noise_variance[a])
        linalg.cholesky_ex(factor, out=(factor, info[a]))
    return cholesky, info


def check_posterior(
    given: dict[str, Tensor], input_dim: int, predicts: str, dtype: Any = float64
) -> None:
    """Raises unless these fields of a ``GPPosterior`` belong together; ``from_hyperparameters`` has the rules.

    The features come first, under any name; before training there are only they and the targets.
    """
    check_tensors(**given)
    (first, inputs), targets = next(iter(given.items())), given["targets"]
    if (
        inputs.dim() != 2
        or targets.dim() != 2
        or not len(inputs)
        or not targets.shape[1]
    ):
        raise ShapeError(
            f"{first} (N, d) and targets (N, k) need two dimensions, a column and a row; "
            f"got {tuple(inputs.shape)} and {tuple(targets.shape)}"
        )
    (size, d), k = inputs.shape, targets.shape[1]
    shapes: dict[str, tuple[int, ...]] = {
        first: (size, d),
        "targets": (size, k),
        "lengthscales": (k, d),
    }
    shapes |= {"cholesky": (k, size, size), "weights": (k, size)}
    for name, value in given.items():
        if tuple(value.shape) != (shape := shapes.get(name, (k,))):
            raise ShapeError(
                f"{name} must have shape {shape}; got {tuple(value.shape)}"
            )
        if value.dtype != dtype:
            raise SettingError(
                name,
                f"must be {str(dtype)[6:]} (convert after: posterior.to(dtype=...)); got {value.dtype}",
            )
        if value.device != inputs.device:
            raise SettingError(
                name,
                f"must be on the device of {first}, {inputs.device}; got {value.device}",
            )
        for part in (
            value if value.dim() == 3 else [value]
        ):  # of a factor no second copy is made
            if not bool(isfinite(part).all()):
                raise DataError(
                    f"{name} must be finite; got {float(part[~isfinite(part)][0])}"
                )
    check_columns(first, d, k, input_dim, predicts)
    for name in ("lengthscales", "signal_variance", "noise_variance"):
        if name in given and not bool((given[name] > 0).all()):
            raise SettingError(name, f"must be positive; got {given[name].tolist()}")


def check_columns(name: str, d: int, k: int, input_dim: int, predicts: str) -> None:
    """Raises unless d columns are the states and controls of k GPs that predict what they are said to."""
    check_choice("predicts", predicts, PREDICTS)
    check_number("input_dim", input_dim, least=0, whole=True)
    if input_dim >= d or (predicts != "value" and d != k + input_dim):
        raise ShapeError(
            f"{name} must have n + m columns, one state an output and {input_dim} controls; "
            f"got {d} columns and {k} outputs"
        )


class Hyperparameters(NamedTuple):
    """Of k SE-ARD GPs over d features."""

    lengthscales: Tensor  #: (k, d)
    signal_variance: Tensor  #: sf2 (k,)
    noise_variance: Tensor  #: sn2 (k,)

    @classmethod
    def from_theta(cls, theta: Tensor) -> "Hyperparameters":
        """Of rows (log l, log sf, log(sf / sn)), one an output (k, d + 2)."""
        return cls(
            theta[:, :-2].exp(),
            (2 * theta[:, -2]).exp(),
            (2 * (theta[:, -2] - theta[:, -1])).exp(),
        )
