import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior


def arguments(size=150, outputs=3, d=4):
    scales = 0.5 + torch.rand(outputs, d)
    return (
        torch.randn(size, d),
        scales,
        1 + torch.rand(outputs),
        torch.full((outputs,), 1e-3),
    )


def factorize(points, scales, signal, noise):
    """The Cholesky factors of a posterior's kernel matrices."""
    targets = torch.zeros(len(points), len(scales))
    kernel = (scales, signal, noise)
    gp = GPPosterior.from_hyperparameters(points, targets, *kernel, 0, "value")
    return gp.cholesky


def test_factors_made_in_place_are_the_same_bit_by_bit(monkeypatch):
    parts = arguments()
    at_once = factorize(*parts)
    monkeypatch.setattr("gpmpc.gp._kernel._MANY", 10)
    in_place = factorize(*parts)
    assert torch.equal(in_place, at_once)
    assert in_place.stride() == at_once.stride()


def test_of_factors_made_in_place_the_output_that_fails_is_named(monkeypatch):
    monkeypatch.setattr("gpmpc.gp._kernel._MANY", 10)
    points, scales, signal, noise = arguments(size=100)
    points[50:] = points[:50]
    noise[2] = 1e-300
    with pytest.raises(
        SettingError, match="the kernel matrix of output 3 is not positive definite"
    ):
        factorize(points, scales, signal, noise)


def test_gradients_pass_through_factors_of_any_size(monkeypatch):
    monkeypatch.setattr("gpmpc.gp._kernel._MANY", 10)
    points, scales, signal, noise = arguments(size=20, outputs=1)
    noise.requires_grad_()
    factorize(points, scales, signal, noise).diagonal(
        dim1=-2, dim2=-1
    ).log().sum().backward()
    K = factorize(points, scales, signal, noise.detach())[0]
    assert float(noise.grad) == pytest.approx(
        float(torch.cholesky_inverse(K).trace()) / 2
    )
