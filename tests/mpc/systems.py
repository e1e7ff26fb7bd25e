"""Systems that the tests of the controllers share."""

from dataclasses import dataclass

import numpy as np
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.systems import System, Translational, step

QUADROTOR = System(Translational(), time_step=0.5, substeps=1)
HOVER = np.array([7.2594, 0.0, 0.0])  # U1 [N], ux, uy [-]


@dataclass(frozen=True)
class LinearGaussian:
    """x+ = A x + B u + c + w, w ~ N(0, V)."""

    A: torch.Tensor
    B: torch.Tensor
    c: torch.Tensor
    V: torch.Tensor
    dtype = torch.float64
    device = torch.device("cpu")

    @property
    def state_dim(self):
        return len(self.A)

    output_dim = state_dim

    @property
    def input_dim(self):
        return self.B.shape[1]

    @property
    def noise_covariance(self):
        return torch.zeros_like(self.A)

    def predict(self, state, input=None):
        mean = state @ self.A.mT + input @ self.B.mT + self.c
        return Gaussian(mean, self.V.expand(*mean.shape, len(self.A)))

    def predict_with_jacobian(self, state, input=None):
        batch = state.shape[:-1]
        return (
            self.predict(state, input),
            self.A.expand(*batch, *self.A.shape),
            self.B.expand(*batch, *self.B.shape),
        )


def linear_gaussian(n=2, m=1, seed=0):
    rng = np.random.default_rng(seed)
    A = 0.9 * np.linalg.qr(rng.normal(size=(n, n)))[0]
    root = 0.1 * rng.normal(size=(n, n))
    parts = A, rng.normal(size=(n, m)), 0.1 * rng.normal(size=n), root @ root.T
    return LinearGaussian(*map(torch.tensor, parts))


class LinearPlant:
    """The same without noise, as a plant for NMPC."""

    time_step = 1.0

    def __init__(self, model):
        self.A, self.B, self.c = (part.tolist() for part in (model.A, model.B, model.c))
        self.dynamics = self
        self.state_names = tuple(f"x{i}" for i in range(model.state_dim))
        self.input_names = tuple(f"u{i}" for i in range(model.input_dim))

    def successor(self, x, u):
        n = len(self.A)
        m = len(self.B[0])
        return [
            self.c[i]
            + sum(self.A[i][j] * x[j] for j in range(n))
            + sum(self.B[i][j] * u[j] for j in range(m))
            for i in range(n)
        ]


def quadrotor_gp(N=60, seed=0):
    """Six GPs on transitions of the integrated translational quadrotor; the
    hyperparameters are set, not trained."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (N, 6))
    u = HOVER + rng.uniform(-1, 1, (N, 3)) * [3, 0.4, 0.4]
    y = np.array([step(QUADROTOR, a, b) for a, b in zip(x, u, strict=True)])
    lengthscales = torch.tensor([[10.0, 2.0, 10.0, 2.0, 10.0, 2.0, 6.0, 1.0, 1.0]] * 6)
    return GPPosterior.from_hyperparameters(
        torch.tensor(np.hstack([x, u])),
        torch.tensor(y - x),
        lengthscales,
        torch.ones(6),
        torch.full((6,), 1e-4),
        3,
        "difference",
    )
