import tracemalloc

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime

from benchmarks.gpytorch_likelihood import GPyTorchLikelihood
from gpmpc.gp._likelihood import NegativeLogMarginalLikelihood


def problem(size, d=4, outputs=2, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(size, d))
    y = np.column_stack([np.sin(x[:, 0]) + x[:, 1] ** 2, x[:, 2] * x[:, 3]])[
        :, :outputs
    ] + 0.01 * rng.normal(size=(size, outputs))
    theta = np.column_stack(
        [
            rng.normal(0.3, 0.4, size=(outputs, d)),
            rng.normal(0.5, 0.3, outputs),
            rng.uniform(1, 4, outputs),
        ]
    )
    return x, y, theta


@pytest.mark.parametrize("size", [1, 2, 10, 64, 65, 189, 300])
def test_the_closed_form_is_gpytorchs_marginal_likelihood(size):
    x, y, theta = problem(size)
    for a in range(2):
        expected, slopes = GPyTorchLikelihood(x, y[:, a])(theta[a])
        value, gradient = NegativeLogMarginalLikelihood(x, y[:, a])(theta[a])
        assert value == pytest.approx(expected, rel=1e-10, abs=1e-9)
        assert np.allclose(
            gradient, slopes, rtol=1e-7, atol=1e-8 * (1 + np.abs(slopes).max())
        )


def test_the_gradient_is_that_of_the_value():
    x, y, theta = problem(40)
    likelihood = NegativeLogMarginalLikelihood(x, y[:, 0], in_place=False)
    numeric = approx_fprime(theta[0], lambda t: likelihood(t)[0], 1e-6)
    assert np.allclose(likelihood(theta[0])[1], numeric, rtol=2e-5, atol=1e-4)


def test_the_value_is_minus_the_log_of_the_gaussian_density():
    x, y, theta = problem(15)
    length = np.exp(theta[0, :4])
    sf2 = np.exp(2 * theta[0, 4])
    squares = (((x[:, None] - x[None]) / length) ** 2).sum(-1)
    covariance = sf2 * np.exp(-squares / 2) + np.exp(
        2 * (theta[0, 4] - theta[0, 5])
    ) * np.eye(15)
    density = torch.distributions.MultivariateNormal(
        torch.zeros(15), torch.from_numpy(covariance)
    )
    assert NegativeLogMarginalLikelihood(x, y[:, 0], in_place=False)(theta[0])[
        0
    ] == pytest.approx(-float(density.log_prob(torch.from_numpy(y[:, 0]))))


def test_an_indefinite_kernel_matrix_has_an_infinite_likelihood():
    x = np.zeros((5, 2))
    value, gradient = NegativeLogMarginalLikelihood(x, np.ones(5))(
        np.array([0.0, 0.0, 0.0, 20.0])
    )  # five equal points without noise
    assert value == np.inf
    assert not gradient.any()


@pytest.mark.parametrize("size", [1, 2, 255, 256, 257, 600])
def test_the_in_place_likelihood_is_the_same_at_every_call(size):
    x, y, theta = problem(size)
    in_place = NegativeLogMarginalLikelihood(x, y[:, 0], in_place=True)
    separate = NegativeLogMarginalLikelihood(x, y[:, 0], in_place=False)
    for point in (theta[0], theta[1], theta[0]):
        (value, gradient), (expected, slopes) = in_place(point), separate(point)
        assert value == pytest.approx(expected, rel=1e-10, abs=1e-9)
        assert np.allclose(
            gradient, slopes, rtol=1e-8, atol=1e-8 * (1 + np.abs(slopes).max())
        )


def test_the_in_place_likelihood_recovers_from_indefiniteness():
    x, y, theta = problem(30)
    x[1] = x[0]
    likelihood = NegativeLogMarginalLikelihood(x, y[:, 0], in_place=True)
    value, gradient = likelihood(np.append(theta[0][:-1], 40.0))
    assert value == np.inf
    assert not gradient.any()
    assert likelihood(theta[0])[0] == pytest.approx(
        NegativeLogMarginalLikelihood(x, y[:, 0], in_place=False)(theta[0])[0],
        rel=1e-10,
    )


def test_the_in_place_likelihood_takes_one_matrix_and_blocks():
    x, y, theta = problem(1500)
    tracemalloc.start()
    NegativeLogMarginalLikelihood(x, y[:, 0], in_place=True)(theta[0])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 1.0 < peak / (8 * 1500**2) < 1.8
