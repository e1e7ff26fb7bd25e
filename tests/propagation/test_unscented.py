"""The unscented transform on a quadratic function, where the moments by sigma points
and the exact ones are known."""

import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.propagation import Unscented


class Quadratic:
    """x+ = g'x + 1/2 x'H x, one function of n states, without noise."""

    dtype = torch.float64
    device = torch.device("cpu")
    output_dim = 1
    input_dim = 0

    def __init__(self, g, H):
        self.g = g
        self.H = H
        self.state_dim = len(g)
        self.noise_covariance = torch.zeros(1, 1)

    def predict(self, state, input=None):
        mean = state @ self.g + ((state @ self.H) * state).sum(-1) / 2
        return Gaussian(mean[..., None], torch.zeros(*mean.shape, 1, 1))


@pytest.mark.parametrize("alpha", [1e-2, 0.3, 1.0, 1.7])
@pytest.mark.parametrize("curvature", [0.0, 1.0, -3.0])
def test_with_beta_two_a_quadratic_is_exact_for_any_alpha(alpha, curvature):
    """Which is what beta is for (van der Merwe, 2004): Var[g x + 1/2 h x^2] = g^2 s +
    1/2 h^2 s^2 about zero."""
    model = Quadratic(torch.tensor([0.7]), torch.tensor([[curvature]]))
    s = 0.4
    propagation = Unscented(alpha, beta=2.0).propagate(
        model, Gaussian(torch.zeros(1), torch.tensor([[s]]))
    )
    assert float(propagation.belief.mean) == pytest.approx(curvature * s / 2, rel=1e-9)
    assert float(propagation.belief.covariance) == pytest.approx(
        0.49 * s + curvature**2 * s**2 / 2, rel=1e-9
    )
    assert float(propagation.cross_covariance) == pytest.approx(0.7 * s, rel=1e-9)


@pytest.mark.parametrize(
    ("alpha", "beta", "kappa"),
    [(1.0, 0.0, 0.0), (0.5, 2.0, 1.0), (0.1, 1.0, -1.5), (2.0, -0.5, 3.0)],
)
def test_moments_of_a_quadratic_are_those_worked_out_by_hand(alpha, beta, kappa):
    """Along the columns r_j of the root, d_j = 1/2 r_j'H r_j: the mean is sum d_j = 1/2
    tr(H S) for all parameters.

    The variance is g'S g + (n + lambda) sum d_j^2 + (beta - alpha^2) (sum d_j)^2.
    """
    g = torch.randn(3)
    root = torch.randn(3, 3)
    H = root + root.T
    root = root @ root.T / 4  # symmetric, and so the root of its square
    S = root @ root
    propagation = Unscented(alpha, beta, kappa).propagate(
        Quadratic(g, H), Gaussian(torch.zeros(3), S)
    )
    d = torch.stack([r @ H @ r for r in root]) / 2
    assert float(propagation.belief.mean) == pytest.approx(
        float((H * S).sum() / 2), rel=1e-9
    )
    variance = (
        g @ S @ g + alpha**2 * (3 + kappa) * d @ d + (beta - alpha**2) * d.sum() ** 2
    )
    assert float(propagation.belief.covariance) == pytest.approx(
        max(0.0, float(variance)), rel=1e-8
    )
    assert float(propagation.deficit) == pytest.approx(
        max(0.0, -float(variance)), rel=1e-8
    )
    assert torch.allclose(propagation.cross_covariance[:, 0], S @ g, rtol=1e-9)


@pytest.mark.parametrize("setting", ["alpha", "beta", "kappa"])
@pytest.mark.parametrize("value", [torch.nan, "1", None])
def test_what_is_no_number_is_refused(setting, value):
    with pytest.raises(SettingError, match=f"{setting}: must be a number"):
        Unscented(**{setting: value})
