"""The SE-ARD kernel, the factor of its noisy matrix, and checks of GP parameters."""

from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

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
# length-scale of an input that drops out of a kernel, in units of its magnitude
IGNORED = 1e8
# points: from here on kernel matrices are made and factorised one after another, in
# place
_MANY = 1000
_ROWS = 64  # of such a matrix at a time: they fit the cache
_FEW = 16  # columns of a kernel matrix whose differences, all at once, fit the cache


def kernel_matrix(
    points: Tensor, others: Tensor, lengthscales: Tensor, signal_variance: Tensor
) -> Tensor:
    """Computes k_a(x~_i, x~_j) (k, N, M).

    It is summed over differences, a column at a time where there are many: exact for
    near points, where |x|^2 + |x'|^2 - 2 x'x cancels.

    Args:
        points: (N, d).
        others: (M, d).
        lengthscales: (k, d).
        signal_variance: (k,).
    """
    if len(others) <= _FEW:
        squares = (points[:, None] - others).square() @ lengthscales.mT**-2  # (N, M, k)
        return signal_variance[:, None, None] * (squares.movedim(-1, 0) / -2).exp()
    distances = points.new_zeros(len(lengthscales), len(points), len(others))
    columns = zip(points.T, others.T, lengthscales.T, strict=True)
    for column, other_column, scale in columns:
        squares = (column[:, None] - other_column).square()
        distances.addcmul_(squares, scale[:, None, None] ** -2)
    return signal_variance[:, None, None] * (distances / -2).exp()


def centred(points: Any) -> Any:
    """Moves points (N, d), NumPy's or torch's, to mean zero.

    Elsewhere distances from a matrix product cancel; a stationary kernel does not
    depend on it. The first point is subtracted first, which is exact between near
    numbers: so a shift of all points changes no bit of the result.
    """
    shifted = points - points[0]
    return shifted - shifted.mean(0)


def factorize(
    inputs: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
) -> Tensor:
    """Computes the lower Cholesky factors of K + sn2 I (k, N, N).

    Raises:
        SettingError: One is not positive definite.
    """
    tensors = (inputs, lengthscales, signal_variance, noise_variance)
    in_graph = any(tensor.requires_grad for tensor in tensors)
    if len(inputs) > _MANY and not in_graph:
        cholesky, info = _factorize_in_place(
            inputs, lengthscales, signal_variance, noise_variance
        )
    else:
        kernel = kernel_matrix(inputs, inputs, lengthscales, signal_variance)
        kernel.diagonal(dim1=-2, dim2=-1).add_(noise_variance[:, None])
        cholesky, info = torch.linalg.cholesky_ex(kernel)
    check_positive_definite(info, signal_variance, noise_variance)
    return cholesky


def check_positive_definite(
    failed: Tensor, signal_variance: Tensor, noise_variance: Tensor
) -> None:
    """Raises ``SettingError`` where an output's factorisation has failed (k,)."""
    if bool(failed.any()):
        output = int(torch.nonzero(failed)[0])
        ratio = float((signal_variance / noise_variance)[output])
        raise SettingError(
            "noise_variance",
            f"the kernel matrix of output {output} is not positive definite in "
            f"{signal_variance.dtype}; signal-to-noise ratio {ratio:.1e}: raise the "
            "noise",
        )


def _factorize_in_place(
    inputs: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
) -> tuple[Tensor, Tensor]:
    """Factorises in the memory of the result and little more.

    Returns:
        The factors (k, N, N), and LAPACK's info (k,).
    """
    size = len(inputs)
    outputs = len(lengthscales)
    info = torch.zeros(outputs, dtype=torch.int32, device=inputs.device)
    # Columns are contiguous, as LAPACK wants them.
    cholesky = inputs.new_empty(outputs, size, size).mT
    for a, factor in enumerate(cholesky):
        for end in range(_ROWS, size + _ROWS, _ROWS):  # the lower triangle
            rows = slice(end - _ROWS, end)
            columns = slice(0, end)
            factor[rows, columns] = kernel_matrix(
                inputs[rows],
                inputs[columns],
                lengthscales=lengthscales[a, None],
                signal_variance=signal_variance[a, None],
            )[0]
        factor.diagonal().add_(noise_variance[a])
        torch.linalg.cholesky_ex(factor, out=(factor, info[a]))
    return cholesky, info


def check_posterior(
    tensors: dict[str, Tensor],
    input_dim: int,
    predicts: str,
    dtype: torch.dtype = torch.float64,
) -> None:
    """Raises unless these fields of a ``GPPosterior`` belong together.

    ``GPPosterior.from_hyperparameters`` has the rules.

    Args:
        tensors: The features first, under any name, then the targets and others; before
            training there are only these two.
        input_dim: m.
        predicts: What the targets mean.
        dtype: That all must have.
    """
    check_tensors(**tensors)
    feature_name, features = next(iter(tensors.items()))
    targets = tensors["targets"]
    two_dimensional = features.dim() == 2 and targets.dim() == 2
    if not two_dimensional or not len(features) or not targets.shape[1]:
        raise ShapeError(
            f"{feature_name} (N, d) and targets (N, k) need two dimensions, a column "
            f"and a row; got {tuple(features.shape)} and {tuple(targets.shape)}"
        )
    size, d = features.shape
    k = targets.shape[1]
    shapes: dict[str, tuple[int, ...]] = {
        feature_name: (size, d),
        "targets": (size, k),
        "lengthscales": (k, d),
        "cholesky": (k, size, size),
        "weights": (k, size),
    }
    for name, value in tensors.items():
        shape = shapes.get(name, (k,))
        if tuple(value.shape) != shape:
            raise ShapeError(
                f"{name} must have shape {shape}; got {tuple(value.shape)}"
            )
        if value.dtype != dtype:
            type_name = str(dtype).removeprefix("torch.")
            raise SettingError(
                name,
                f"must be {type_name} (convert after: posterior.to(dtype=...)); "
                f"got {value.dtype}",
            )
        if value.device != features.device:
            raise SettingError(
                name,
                f"must be on the device of {feature_name}, {features.device}; "
                f"got {value.device}",
            )
        _check_finite(name, value)
    check_columns(feature_name, d, k, input_dim, predicts)
    for name in ("lengthscales", "signal_variance", "noise_variance"):
        if name in tensors and not bool((tensors[name] > 0).all()):
            raise SettingError(name, f"must be positive; got {tensors[name].tolist()}")


def _check_finite(name: str, value: Tensor) -> None:
    """Raises ``DataError`` unless all entries are finite."""
    # A factor (k, N, N) is looked at output by output: no second copy is made.
    blocks = value if value.dim() == 3 else [value]
    for block in blocks:
        finite = torch.isfinite(block)
        if not bool(finite.all()):
            first = float(block[~finite][0])
            raise DataError(f"{name} must be finite; got {first}")


def check_columns(name: str, d: int, k: int, input_dim: int, predicts: str) -> None:
    """Raises unless d columns are states and controls of k GPs.

    Args:
        name: What the columns are called.
        d: Number of columns.
        k: Number of GPs.
        input_dim: Number of controls, m.
        predicts: What the GPs predict: d = k + m unless values.
    """
    check_choice("predicts", predicts, PREDICTS)
    check_number("input_dim", input_dim, least=0, whole=True)
    if input_dim >= d or (predicts != "value" and d != k + input_dim):
        raise ShapeError(
            f"{name} must have n + m columns, one state an output and {input_dim} "
            f"controls; got {d} columns and {k} outputs"
        )


class Hyperparameters(NamedTuple):
    """Hyperparameters of k SE-ARD GPs over d features."""

    lengthscales: Tensor  #: (k, d)
    signal_variance: Tensor  #: sf2 (k,)
    noise_variance: Tensor  #: sn2 (k,)

    @classmethod
    def from_theta(cls, theta: Tensor) -> "Hyperparameters":
        """Converts rows (log l, log sf, log(sf / sn)), one an output (k, d + 2)."""
        return cls(
            lengthscales=theta[:, :-2].exp(),
            signal_variance=(2 * theta[:, -2]).exp(),
            noise_variance=(2 * (theta[:, -2] - theta[:, -1])).exp(),
        )

    def of_output(self, output: int) -> "Hyperparameters":
        """Returns those of one GP, with shapes as of k = 1."""
        return Hyperparameters(
            lengthscales=self.lengthscales[output, None],
            signal_variance=self.signal_variance[output, None],
            noise_variance=self.noise_variance[output, None],
        )
