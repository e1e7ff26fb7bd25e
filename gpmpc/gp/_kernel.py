r"""The SE-ARD kernel, and the Cholesky factor of its noisy matrix.

    k(x~, x~') = sf2 exp(-1/2 sum_d (x~_d - x~'_d)^2 / l_d^2)
    dk/dx~     = k z,   d2k/dx~2 = k (z z' - D),   z = D (x~' - x~),   D = diag(1 / l^2)

``kernel_matrix`` and ``kernel_of_squares`` are the kernel of all torch code but
``module``, which ONNX limits. The formula is written out again where speed or another
language needs it; a change of the kernel is a change of each, derivatives included:

    gp/_likelihood               NumPy, and the gradient      tests/gp/test_likelihood
    gp/casadi_._predict_gps      CasADi                       tests/gp/test_casadi
    gp/module.PosteriorModule    torch, for ONNX              tests/gp/test_module
    _kernels/_gp_point.write_kernel     compiled              tests/kernels/test_kernels
      its derivatives, in which beta k weighs z, as for this kernel alone:
    _kernels/_gp_point.linearize_points, expand_points      tests/kernels/test_kernels
    _kernels/gp_rollout._write_means    compiled              tests/models/test_roll_out
    mpc/_slopes._gp_covariances  NumPy, of derivatives        tests/mpc/test_slopes
    gp/_posterior._jacobian      torch, of the mean           tests/gp/test_posterior
    gp/_sparse._cross            torch, by matrix products    tests/gp/test_sparse
    export/gp.c                  C, with derivatives          tests/export
    export/fixed.c, _fixed       C, exponents of base 2       tests/export

(``propagation._moments`` and ``_kernels._gp_moments`` hold its expectations.)

Differences and length-scales are read, without the formula, in
``_kernels/_gp_point._write_differences``, ``_kernels/_window._write_kernel_row``,
``mpc/_data_range``, ``mpc/_novelty``, ``export/_points``, ``estimation/_noise`` and
``testing/_propagator``. ``_kernels.GPArrays`` are made in ``_packed.pack``,
``Window.empty`` and ``models/_roll_out._compiled_tape``. ``SparseTrainer`` hands its
settings on to ``Trainer`` in ``_exact_trainer``; ``gp/_gpytorch.to_gpytorch`` makes an
RBF kernel of any posterior. ``models.Features`` makes sine and cosine of an angle: with
one length-scale for both that would be the periodic kernel of a turn, but training
chooses two.

Its parameters stand elsewhere too: rows theta = (log l, log sf, log(sf / sn)) in
``Hyperparameters``, ``gp._search``, ``gp._training_data``, ``gp._sparse_training`` and
``estimation._noise._prior_penalty``; its tensors in ``GPPosterior``,
``check_gp_tensors``, ``gp._storage`` and, one after the other, in ``gp._sparse``;
the kernel's name in files, ``gp._storage`` ("SE-ARD", where they are written and read);
and what ``from_gpytorch`` takes for it, ``gp._gpytorch._check_se_ard``. ``1 / l^2`` and
log sf2 travel packed (``_kernels.GPArrays``), from which ``learning._changed_model``
makes a posterior and ``export._models`` tables. Another kernel would have to be
refused where closed forms need this one: ``_has_exact_moments`` and ``_is_gp_alone`` of
``propagation`` look at a model's form alone, and ask for no kernel.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError

# length-scale of a feature that drops out of a kernel, in units of its magnitude
IGNORED = 1e8
# points: from here on kernel matrices are made and factorised one after another, in
# place
_MANY = 1000
_ROWS_AT_ONCE = 64  # of such a matrix: they fit the cache
# of a kernel matrix whose differences, all at once, fit the cache
_COLUMNS_AT_ONCE = 16


def kernel_of_squares(squares: Tensor, signal_variance: Tensor) -> Tensor:
    """Computes k from squared distances in units of the length-scales."""
    return signal_variance * (squares / -2).exp()


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
    if len(others) <= _COLUMNS_AT_ONCE:
        squares = (points[:, None] - others).square() @ lengthscales.mT**-2  # (N, M, k)
        squares = squares.movedim(-1, 0)
        return kernel_of_squares(squares, signal_variance[:, None, None])
    distances = points.new_zeros(len(lengthscales), len(points), len(others))
    columns = zip(points.T, others.T, lengthscales.T, strict=True)
    for column, other_column, scale in columns:
        squares = (column[:, None] - other_column).square()
        distances.addcmul_(squares, scale[:, None, None] ** -2)
    return kernel_of_squares(distances, signal_variance[:, None, None])


def centred(points: Any) -> Any:
    """Moves points (N, d), NumPy's or torch's, to mean zero.

    Elsewhere distances from a matrix product cancel; a stationary kernel does not
    depend on it. The first point is subtracted first, which is exact between near
    numbers: so a shift of all points changes no bit of the result.
    """
    shifted = points - points[0]
    return shifted - shifted.mean(0)


def factorize(
    features: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
) -> Tensor:
    """Computes the lower Cholesky factors of K + sn2 I (k, N, N).

    Raises:
        SettingError: One is not positive definite.
    """
    tensors = (features, lengthscales, signal_variance, noise_variance)
    in_graph = any(tensor.requires_grad for tensor in tensors)
    if len(features) > _MANY and not in_graph:
        cholesky, info = _factorize_in_place(
            features, lengthscales, signal_variance, noise_variance
        )
    else:
        kernel = kernel_matrix(features, features, lengthscales, signal_variance)
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
            f"the kernel matrix of output {output + 1} is not positive definite in "
            f"{signal_variance.dtype}; signal-to-noise ratio {ratio:.1e}: raise the "
            "noise",
        )


def _factorize_in_place(
    features: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
) -> tuple[Tensor, Tensor]:
    """Factorises in the memory of the result and little more.

    Returns:
        The factors (k, N, N), and LAPACK's info (k,).
    """
    size = len(features)
    outputs = len(lengthscales)
    info = torch.zeros(outputs, dtype=torch.int32, device=features.device)
    # Columns are contiguous, as LAPACK wants them.
    cholesky = features.new_empty(outputs, size, size).mT
    for a, factor in enumerate(cholesky):
        for end in range(
            _ROWS_AT_ONCE, size + _ROWS_AT_ONCE, _ROWS_AT_ONCE
        ):  # the lower triangle
            rows = slice(end - _ROWS_AT_ONCE, end)
            columns = slice(0, end)
            factor[rows, columns] = kernel_matrix(
                features[rows],
                features[columns],
                lengthscales=lengthscales[a, None],
                signal_variance=signal_variance[a, None],
            )[0]
        factor.diagonal().add_(noise_variance[a])
        torch.linalg.cholesky_ex(factor, out=(factor, info[a]))
    return cholesky, info


class Hyperparameters(NamedTuple):
    """Hyperparameters of k SE-ARD GPs over d features.

    See Also:
        ``GPPosterior.from_hyperparameters``, which takes them.
    """

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
