import numpy as np
import pytest
import torch

from gpmpc.exceptions import ShapeError
from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite


def test_mean_and_covariance_must_belong_together():
    with pytest.raises(ShapeError, match=r"\(\*batch, n, n\); got \(3,\) and \(2, 2\)"):
        Gaussian(torch.zeros(3), torch.eye(2))


def test_the_variance_is_the_diagonal_of_every_covariance():
    covariance = torch.randn(4, 3, 3)
    assert torch.equal(
        Gaussian(torch.zeros(4, 3), covariance).variance[2], covariance[2].diagonal()
    )


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_the_projection_is_the_nearest_semidefinite_matrix(batch):
    generator = torch.Generator().manual_seed(1)
    matrix = torch.randn(*batch, 4, 4, generator=generator)
    projected, deficit = nearest_positive_semidefinite(matrix)
    symmetric = (matrix + matrix.mT) / 2
    eigenvalues = torch.linalg.eigvalsh(symmetric)
    assert torch.linalg.eigvalsh(projected).min() > -1e-14
    assert torch.allclose(deficit, (-eigenvalues[..., 0]).clamp_min(0))
    distance = (projected - symmetric).square().sum((-2, -1))
    assert torch.allclose(
        distance, eigenvalues.clamp_max(0).square().sum(-1)
    )  # Higham (1988), theorem 2.1


def test_a_semidefinite_matrix_is_returned_unchanged():
    root = torch.randn(3, 3)
    projected, deficit = nearest_positive_semidefinite(root @ root.T)
    assert torch.equal(projected, (root @ root.T + (root @ root.T).T) / 2)
    assert float(deficit) == 0


@pytest.mark.parametrize(
    "eigenvalues", [(2.0, 2.0, 0.5, -1.0, -1.0), (1.0, 0.0, 0.0, -1e-18)]
)
def test_the_projection_has_its_slope_beside_equal_eigenvalues(eigenvalues):
    generator = torch.Generator().manual_seed(2)
    b = torch.tensor(eigenvalues, dtype=torch.float64)
    n = len(b)
    U = torch.eye(n, dtype=torch.float64)
    if min(eigenvalues) < -0.1:
        U, _ = torch.linalg.qr(torch.randn(n, n, generator=generator).double())
    matrix = (U @ b.diag() @ U.mT).requires_grad_()
    weights = torch.randn(n, n, generator=generator).double()
    projected, _ = nearest_positive_semidefinite(matrix)
    (slope,) = torch.autograd.grad((weights * projected).sum(), matrix)
    change = torch.randn(n, n, generator=generator).double()
    change = 1e-6 * (change @ change.mT)  # what is zero becomes no less
    moved, _ = nearest_positive_semidefinite(matrix.detach() + change)
    expected = float((weights * (moved - projected.detach())).sum())
    assert float((slope * change).sum()) == pytest.approx(expected, rel=1e-4)


def test_an_array_that_is_read_backwards_is_a_state():
    assert Gaussian.certain(np.arange(3.0)[::-1]).mean.tolist() == [2.0, 1.0, 0.0]
