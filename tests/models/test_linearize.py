"""Linearisations of K points are the derivatives of the predictions."""

import logging

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import (
    Affine,
    CasadiFunction,
    Linearized,
    ResidualModel,
    linearize,
    linearize_by_autograd,
)

N = 3
M = 2


def draw(seed, *shape):
    return torch.randn(
        *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


def posterior(predicts="next_state", n=N, m=M, k=N):
    size = 21
    ones = torch.ones(k, dtype=torch.float64)
    lengthscales = 1 + draw(3, k, n + m).abs()
    return GPPosterior.from_hyperparameters(
        draw(1, size, n + m),
        draw(2, size, k),
        lengthscales,
        ones,
        0.01 * ones,
        m,
        predicts,
        0.1 * draw(4, k),
    )


class Bare:
    """Has nothing but what every model must have."""

    state_dim = N
    input_dim = M
    output_dim = N
    dtype = torch.float64
    device = torch.device("cpu")
    noise_covariance = torch.zeros(N, N, dtype=torch.float64)

    def predict(self, state, input):
        mean = torch.sin(state) + input.sum(-1, keepdim=True) * state
        return Gaussian(mean, torch.diag_embed(0.1 + state.square()))


def pendulum(x, u):
    return x + 0.1 * torch.stack(
        [torch.sin(x[..., 1]), x[..., 2] * u[..., 0], u[..., 1] - x[..., 0]], dim=-1
    )


def residual(nominal):
    B = torch.tensor([[0.0, 0.0], [1.0, 0.5], [0.0, 2.0]], dtype=torch.float64)
    return ResidualModel(nominal, posterior("value", 2, 1, 2), B, [2, 0], [1], M)


MODELS = {
    "next states": lambda: posterior(),
    "differences": lambda: posterior("difference"),
    "residual of an affine model": lambda: residual(
        Affine(draw(5, N, N), draw(6, N, M), draw(7, N))
    ),
    "residual of a torch model": lambda: residual(pendulum),
    "predict alone": Bare,
}


@pytest.mark.parametrize("points", [1, 2, 7])
@pytest.mark.parametrize("name", MODELS)
def test_an_expansion_is_the_derivative_of_the_prediction(name, points):
    model = MODELS[name]()
    x = draw(8, points, N)
    u = draw(9, points, M)
    linearized = linearize(model, x.numpy(), u.numpy())
    belief = model.predict(x, u)
    A, B = torch.func.vmap(
        torch.func.jacrev(lambda x, u: model.predict(x, u).mean, argnums=(0, 1))
    )(x, u)
    for got, expected in zip(
        linearized, (belief.mean, A, B, belief.covariance), strict=True
    ):
        assert got.flags.c_contiguous
        assert got.dtype == np.float64
        np.testing.assert_allclose(got, expected.numpy(), atol=1e-11)
    without = linearize(model, x.numpy(), u.numpy(), covariance=False)
    assert without.covariance is None
    for got, expected in zip(without[:3], linearized[:3], strict=True):
        np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize(
    "name", ["next states", "residual of an affine model", "residual of a torch model"]
)
def test_a_float32_model_converts_by_itself(name):
    model = MODELS[name]()
    x = draw(8, 4, N).numpy()
    u = draw(9, 4, M).numpy()
    for got, expected in zip(
        model.to(dtype=torch.float32).linearize(x, u),
        model.linearize(x, u),
        strict=True,
    ):
        assert got.dtype == np.float64
        np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-3)


def test_what_is_slow_is_logged_once(caplog):
    class Slow(Bare):
        pass

    x = np.zeros((2, N))
    u = np.zeros((2, M))
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            linearize_by_autograd(Slow(), x, u)
    assert [record.getMessage() for record in caplog.records] == [
        "Slow has no linearize() of its own: torch autograd linearises it, which "
        "takes longer"
    ]


def test_the_models_own_method_is_used():
    class Own(Bare):
        def linearize(self, states, inputs, covariance=True):
            return Linearized("mean", "A", "B", covariance)

    assert linearize(Own(), np.zeros((1, N)), np.zeros((1, M)), False) == (
        "mean",
        "A",
        "B",
        False,
    )


def test_points_that_do_not_fit_are_an_error():
    with pytest.raises(
        ShapeError,
        match=r"states \(H, 3\) and inputs \(H, 2\); got \(2, 3\) and \(1, 2\)",
    ):
        posterior().linearize(np.zeros((2, N)), np.zeros((1, M)))


def test_a_nominal_model_in_casadi_is_the_one_in_torch():
    x = casadi.SX.sym("x", N)
    u = casadi.SX.sym("u", M)
    after = x + 0.1 * casadi.vertcat(casadi.sin(x[1]), x[2] * u[0], u[1] - x[0])
    theirs = residual(CasadiFunction(casadi.Function("f", [x, u], [after])))
    ours = residual(pendulum)
    points = draw(8, 5, N)
    inputs = draw(9, 5, M)
    for _ in range(2):
        for got, expected in zip(
            theirs.linearize(points.numpy(), inputs.numpy()),
            ours.linearize(points.numpy(), inputs.numpy()),
            strict=True,
        ):
            assert got.flags.c_contiguous
            np.testing.assert_allclose(got, expected, atol=1e-12)
    predicted = theirs.predict(points.reshape(5, 1, N), inputs.reshape(5, 1, M))
    assert torch.allclose(
        predicted.mean, ours.predict(points, inputs).mean[:, None], atol=1e-13
    )
    with pytest.raises(
        UnsupportedModel,
        match=r"must map vectors of \(3, 2\) entries to a matrix of \(3, 1\)",
    ):
        residual(CasadiFunction(casadi.Function("f", [x], [x])))
