"""Models of GPyTorch, with data to train them on."""

import gpytorch
import torch
from gpytorch.kernels import (
    InducingPointKernel,
    MaternKernel,
    RBFKernel,
    ScaleKernel,
)
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.means import ZeroMean

from gpmpc.gp import KernelPosterior


class Model(gpytorch.models.ExactGP):
    def __init__(self, x, y, kernel, mean=None, likelihood=None, batch=()):
        likelihood = likelihood or GaussianLikelihood(batch_shape=torch.Size(batch))
        super().__init__(x, y, likelihood)
        self.mean_module = mean or ZeroMean(batch_shape=torch.Size(batch))
        self.covar_module = kernel

    def forward(self, x):
        return gpytorch.distributions.MultivariateNormal(
            self.mean_module(x), self.covar_module(x)
        )


def data(size, outputs=2, d=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = 3 * torch.rand(size, d, generator=generator) - 1.5
    y = torch.stack(
        [torch.sin((a + 1) * x[:, 0]) + x[:, 1] * x[:, -1] + a for a in range(outputs)]
    )
    return x, y + 0.05 * torch.randn(outputs, size, generator=generator)


def shaken(model, seed=0):
    """Trained, as far as these tests care: parameters away from their defaults."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.dim() < 2 or "inducing" not in str(parameter.shape):
                parameter.add_(0.4 * torch.randn(parameter.shape, generator=generator))
    return model.double().eval()


def batch(size, kernel=None, outputs=2, mean=None):
    x, y = data(size, outputs)
    shape = torch.Size([outputs])
    kernel = kernel or ScaleKernel(
        RBFKernel(ard_num_dims=3, batch_shape=shape), batch_shape=shape
    )
    return shaken(Model(x.expand(outputs, -1, -1), y, kernel, mean, batch=shape))


def matern_dynamics(predicts="next_state", size=40):
    kernel = ScaleKernel(
        MaternKernel(nu=2.5, ard_num_dims=3, batch_shape=torch.Size([2])),
        batch_shape=torch.Size([2]),
    )
    return KernelPosterior.from_gpytorch(
        batch(size, kernel), input_dim=1, predicts=predicts
    )


def sgpr(size=120, points=12, outputs=2):
    x, y = data(size, outputs)
    likelihood = GaussianLikelihood(batch_shape=torch.Size([outputs]))
    shape = torch.Size([outputs])
    kernel = ScaleKernel(
        RBFKernel(ard_num_dims=3, batch_shape=shape), batch_shape=shape
    )
    inducing = InducingPointKernel(kernel, x[:points].clone(), likelihood)
    return (
        Model(
            x.expand(outputs, -1, -1), y, inducing, likelihood=likelihood, batch=shape
        )
        .double()
        .eval()
    )
