import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gp._kernel import factorize, kernel_matrix


def arguments(size=150, outputs=3, d=4):
    scales = 0.5 + torch.rand(outputs, d)
    return torch.randn(size, d), scales, 1 + torch.rand(outputs), torch.full((outputs,), 1e-3)


@pytest.mark.parametrize("size", [1, 20, 150])
def test_the_factors_are_those_of_all_matrices_at_once_bit_by_bit(size):
    points, scales, signal, noise = arguments(size)
    kernel = kernel_matrix(points, points, scales, signal)
    kernel.diagonal(dim1=-2, dim2=-1).add_(noise[:, None])
    at_once, one_by_one = torch.linalg.cholesky(kernel), factorize(points, scales, signal, noise)
    assert torch.equal(one_by_one, at_once)
    assert one_by_one.stride() == at_once.stride()


def test_the_output_whose_factorisation_fails_is_named():
    points, scales, signal, noise = arguments(size=100)
    points[50:] = points[:50]
    noise[2] = 1e-300
    with pytest.raises(SettingError, match="the kernel matrix of output 2 is not positive definite"):
        factorize(points, scales, signal, noise)


def test_gradients_pass_through_factors():
    points, scales, signal, noise = arguments(size=20, outputs=1)
    noise.requires_grad_()
    factorize(points, scales, signal, noise).diagonal(dim1=-2, dim2=-1).log().sum().backward()
    K = factorize(points, scales, signal, noise.detach())[0]
    assert float(noise.grad) == pytest.approx(float(torch.cholesky_inverse(K).trace()) / 2)
