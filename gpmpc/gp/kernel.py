"""Problem: the SE-ARD kernel between two sets of points, of every output, exact for near points too."""

from torch import Tensor, zeros


def kernel_matrix(points: Tensor, others: Tensor, lengthscales: Tensor, signal_variance: Tensor) -> Tensor:
    """k_a(x~_i, x~_j) (k, N, M) of points (N, d) and others (M, d).

    Summed over differences a column at a time: exact for near points, where |x|^2 + |x'|^2 - 2 x'x cancels.
    """
    shape = (len(lengthscales), len(points), len(others))
    total = zeros(shape, dtype=points.dtype, device=points.device)
    for ours, theirs, scale in zip(points.T, others.T, lengthscales.T, strict=True):
        total.addcmul_((ours[:, None] - theirs).square(), scale[:, None, None] ** -2)
    return signal_variance[:, None, None] * (total / -2).exp()
