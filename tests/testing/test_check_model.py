"""The check itself.

Our own models pass, and each broken promise is found out and named.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, ResidualModel, linearize_by_autograd
from gpmpc.testing import check_model


def posterior(n=2, m=1, predicts="next_state"):
    features = 3 * torch.rand(20, n + m) - 1.5
    targets = features[:, :n].sin() + features[:, -1:]
    return GPPosterior.from_hyperparameters(
        features,
        targets,
        0.7 + torch.rand(n, n + m),
        1 + torch.rand(n),
        torch.full((n,), 1e-3),
        m,
        predicts,
    )


def residual(affine=True):
    nominal = Affine(
        torch.tensor([[1.0, 0.1], [0.0, 0.9]]),
        torch.tensor([[0.0, 0.1], [0.2, 0.0]]),
        torch.ones(2),
    )
    gp = posterior(n=1, m=1, predicts="value")
    # Of nonlinear code: torch follows it.
    return ResidualModel(
        nominal if affine else pendulum, gp, torch.tensor([[0.5], [1.0]]), [1], [0], 2
    )


def pendulum(x, u):
    return torch.stack(
        [x[..., 0] + 0.1 * x[..., 1], x[..., 1] - x[..., 0].sin() + u.sum(-1)], dim=-1
    )


@pytest.mark.parametrize(
    "make",
    [
        posterior,
        lambda: posterior(predicts="difference"),
        lambda: posterior(n=3, m=0),
        lambda: posterior(n=1, m=2, predicts="value"),
        lambda: posterior().to(dtype=torch.float32),
        residual,
        lambda: residual(affine=False),
        lambda: residual().to(dtype=torch.float32),
    ],
    ids=[
        "next_state",
        "difference",
        "autonomous",
        "value",
        "float32",
        "residual",
        "nonlinear residual",
        "residual32",
    ],
)
def test_the_packages_own_models_pass(make):
    check_model(make())


def test_queries_of_the_users_scale_are_taken():
    check_model(
        posterior(), states=100 + 1e-3 * torch.randn(3, 2), inputs=torch.zeros(3, 1)
    )


@dataclass
class Honest:
    """A model that is no GP: a pendulum with a state-dependent spread."""

    state_dim = 2
    input_dim = 1
    output_dim = 2
    dtype = torch.float64
    device = torch.device("cpu")
    noise_covariance = torch.diag(torch.tensor([0.1, 0.2], dtype=torch.float64))

    def predict(self, state, input=None):
        root = torch.stack(
            [torch.stack([0.1 + state[..., 0] ** 2, 0 * state[..., 0]], -1), state], -2
        )
        return Gaussian(pendulum(state, input), root @ root.mT)

    def linearize(self, states, inputs, covariance=True):
        return linearize_by_autograd(self, states, inputs, covariance)


def test_an_outsiders_honest_model_passes():
    check_model(Honest())


class ForgetsItsBatch(Honest):
    def predict(self, state, input=None):
        belief = super().predict(state, input)
        return Gaussian(
            belief.mean,
            belief.covariance.reshape(-1, 2, 2)[0].expand(belief.covariance.shape),
        )


class MovesTheMean(Honest):
    def predict(self, state, input=None):
        belief = super().predict(state, input)
        return (
            Gaussian(belief.mean - belief.mean.mean(0), belief.covariance)
            if state.dim() > 1
            else belief
        )


class WrongShape(Honest):
    def predict(self, state, input=None):
        belief = super().predict(state, input)
        return Gaussian(belief.mean[..., :1], belief.covariance[..., :1, :1])


class Lopsided(Honest):
    def predict(self, state, input=None):
        belief = super().predict(state, input)
        return Gaussian(
            belief.mean, belief.covariance + torch.tensor([[0.0, 1e-6], [0.0, 0.0]])
        )


class Indefinite(Honest):
    def predict(self, state, input=None):
        belief = super().predict(state, input)
        return Gaussian(belief.mean, belief.covariance - 0.5 * torch.eye(2))


class Scribbles(Honest):
    def predict(self, state, input=None):
        state += 1e-9
        return super().predict(state, input)


class Dices(Honest):
    def predict(self, state, input=None):
        belief = super().predict(state, input)
        return Gaussian(belief.mean + 1e-12 * torch.randn(2), belief.covariance)


class WrongSlope(Honest):
    def linearize(self, states, inputs, covariance=True):
        linearized = super().linearize(states, inputs, covariance)
        return linearized._replace(A=linearized.A + 1e-3)


class TransposedSlope(Honest):
    def linearize(self, states, inputs, covariance=True):
        linearized = super().linearize(states, inputs, covariance)
        return linearized._replace(B=np.ascontiguousarray(linearized.B.mT))


class FortranOrder(Honest):
    def linearize(self, states, inputs, covariance=True):
        linearized = super().linearize(states, inputs, covariance)
        return linearized._replace(A=np.asfortranarray(linearized.A))


class AnotherPrediction(Honest):
    def linearize(self, states, inputs, covariance=True):
        linearized = super().linearize(states, inputs)
        return linearized._replace(
            covariance=linearized.covariance + self.noise_covariance.numpy()
            if covariance
            else None
        )


class AlwaysCovariance(Honest):
    def linearize(self, states, inputs, covariance=True):
        return super().linearize(states, inputs)


class FallsToSinglePrecision(Honest):
    def predict(self, state, input=None):
        belief = super().predict(state, input)
        return Gaussian(belief.mean.float(), belief.covariance.float())


class NoiseOfAnotherShape(Honest):
    noise_covariance = torch.ones(2, dtype=torch.float64)


class NoDimension(Honest):
    output_dim = None


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (
            ForgetsItsBatch,
            "a batch is the loop over its members; the covariance is off by",
        ),
        (MovesTheMean, "a batch is the loop over its members; the mean is off by"),
        (
            WrongShape,
            r"mean \(\*batch, k\) and covariance .*; "
            r"got \(\(4, 1\), \(4, 1, 1\)\), should be \(\(4, 2\), ",
        ),
        (
            Lopsided,
            "the covariance is symmetric; "
            "an entry and its mirror image differ by 1.00e-06",
        ),
        (
            Indefinite,
            "the covariance is positive semidefinite; its lowest eigenvalue is -",
        ),
        (Scribbles, "the caller's state and input are left as they are"),
        (Dices, "the same arguments give the same result"),
        (
            WrongSlope,
            "linearize: A agrees with finite differences of predict; "
            "it is off by 1.00e-03",
        ),
        (
            TransposedSlope,
            r"B is a C-contiguous float64 array of shape \(4, 2, 1\); "
            r"got float64 \(4, 1, 2\)",
        ),
        (FortranOrder, "A is a C-contiguous float64 array"),
        (
            AnotherPrediction,
            "its mean and covariance are predict's; the covariance is off by",
        ),
        (AlwaysCovariance, "no covariance where it is not wanted"),
        (
            FallsToSinglePrecision,
            "type and device are the model's, torch.float64 on cpu; got torch.float32",
        ),
        (
            NoiseOfAnotherShape,
            r"noise_covariance is a torch.float64 tensor of shape \(2, 2\); "
            r"got Tensor .* \(2,\)",
        ),
        (NoDimension, "output_dim is a whole number, 1 or more; got None"),
    ],
)
def test_each_broken_promise_is_found_and_named(broken, message):
    with pytest.raises(AssertionError, match=message):
        check_model(broken())
