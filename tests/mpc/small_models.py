"""Small models that the controllers' tests share."""

import torch

from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior

# The choices of PredictionSettings.
FORMS = ("trajectory", "velocity")
COVARIANCES = ("full", "diagonal", "zero_order", "none")


class LinearGaussian:
    """x+ = A x + B u + c + w, w ~ N(0, W)."""

    dtype = torch.float64
    device = torch.device("cpu")

    def __init__(self, A, B, c=None, W=None):
        self.A = torch.tensor(A)
        self.B = torch.tensor(B)
        n, m = self.B.shape
        self.c = torch.zeros(n) if c is None else torch.tensor(c)
        self.W = torch.zeros(n, n) if W is None else torch.tensor(W)
        self.state_dim = n
        self.output_dim = n
        self.input_dim = m
        self.noise_covariance = torch.zeros(n, n)

    def predict(self, state, input=None):
        mean = state @ self.A.mT + input @ self.B.mT + self.c
        return Gaussian(mean, self.W.expand(*mean.shape, self.output_dim))

    def predict_with_jacobian(self, state, input=None):
        batch = state.shape[:-1]
        return (
            self.predict(state, input),
            self.A.expand(*batch, *self.A.shape),
            self.B.expand(*batch, *self.B.shape),
        )


def double_integrator(**arguments):
    return LinearGaussian([[1.0, 0.5], [0.0, 1.0]], [[0.125], [0.5]], **arguments)


def pendulum_posterior(size=40, noise=1e-4, seed=0):
    """A GP on the differences of a damped pendulum (angle, rate; torque), time step
    0.2."""
    generator = torch.Generator().manual_seed(seed)
    features = (2 * torch.rand(size, 3, generator=generator) - 1) * torch.tensor(
        [2.5, 3.0, 4.0]
    )
    angle, rate, torque = features.T
    acceleration = -4 * torch.sin(angle) - 0.3 * rate + torque
    targets = torch.stack([0.2 * rate + 0.02 * acceleration, 0.2 * acceleration], dim=1)
    return GPPosterior.from_hyperparameters(
        features,
        targets + noise**0.5 * torch.randn(size, 2, generator=generator),
        lengthscales=torch.tensor([[2.0, 6.0, 12.0], [2.0, 8.0, 12.0]]),
        signal_variance=torch.tensor([0.5, 1.5]),
        noise_variance=torch.full((2,), noise),
        input_dim=1,
        predicts="difference",
    )
