"""s+ = A s + B u + c with s = [mu; vec(Sigma^1/2)]: against finite differences, limits,
batches and rollouts."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian, square_root
from gpmpc.propagation import MomentMatching, linearize, rollout
from gpmpc.signals import Signals
from tests.propagation.test_propagators import ALL, DETERMINISTIC, belief, gp, linear

MODELS = {
    "next_state": lambda: gp(),
    "difference": lambda: gp(predicts="difference"),
    "autonomous": lambda: gp(n=3, m=0),
    "residual": linear,
}


def extended_state(at):
    return torch.cat([at.mean, square_root(at.covariance).flatten(-2)], dim=-1)


def F(propagator, model, s, u):
    """The next extended state, by the propagator's beliefs alone."""
    n = model.state_dim
    S = s[n:].unflatten(0, (n, n))
    next_belief = propagator(model, Gaussian(s[:n], S @ S.T), u)
    return torch.cat([next_belief.mean, square_root(next_belief.covariance).flatten()])


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())
@pytest.mark.parametrize("name", ALL)
def test_the_local_model_is_the_derivative_of_the_step(name, make):
    model = make()
    propagator = ALL[name]()
    n = model.state_dim
    m = model.input_dim
    at = belief(n)
    u = torch.full((m,), 0.3)
    step = 1e-6
    local = linearize(propagator, model, at, u)
    s = extended_state(at)
    assert local.A.shape == (n + n * n, n + n * n)
    assert local.B.shape == (n + n * n, m)
    assert torch.allclose(local(s, u), F(propagator, model, s, u), atol=1e-10)
    for j in range(m):
        du = step * torch.eye(m)[j]
        numeric = (
            F(propagator, model, s, u + du) - F(propagator, model, s, u - du)
        ) / (2 * step)
        assert torch.allclose(local.B[:, j], numeric, atol=1e-6)
    for j in range(n + n * n):
        ds = step * torch.eye(n + n * n)[j]
        numeric = (
            F(propagator, model, s + ds, u) - F(propagator, model, s - ds, u)
        ) / (2 * step)
        assert torch.allclose(local.A[:, j], numeric, atol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_from_a_measured_state_the_columns_for_the_root_vanish(name):
    model = gp()
    u = torch.tensor([0.2])
    at = Gaussian(torch.tensor([0.3, -0.1]), torch.zeros(2, 2))
    local = linearize(ALL[name](), model, at, u)
    assert not local.A[:, 2:].any()
    for part in (local.A, local.B, local.c):
        assert torch.isfinite(part).all()
    _, by_state, by_input = model.predict_with_jacobian(at.mean, u)
    assert torch.allclose(local.A[:2, :2], by_state, atol=1e-10)
    assert torch.allclose(local.B[:2], by_input, atol=1e-10)


@pytest.mark.parametrize("name", ALL)
def test_a_plan_of_stages_is_the_loop_over_them(name):
    model = gp(predicts="difference")
    propagator = ALL[name]()
    H = 4
    means = torch.randn(H, 2)
    inputs = torch.randn(H, 1)
    covariances = torch.stack([belief(scale=0.2 * k).covariance for k in range(H)])
    together = linearize(propagator, model, Gaussian(means, covariances), inputs)
    for k in range(H):
        alone = linearize(
            propagator, model, Gaussian(means[k], covariances[k]), inputs[k]
        )
        for part in ("A", "B", "c"):
            assert torch.allclose(
                getattr(together, part)[k], getattr(alone, part), atol=1e-9
            )
        assert torch.allclose(
            together.next.covariance[k], alone.next.covariance, atol=1e-12
        )


@pytest.mark.parametrize("name", ALL)
def test_linearising_along_inputs_follows_the_rollout(name):
    model = gp()
    propagator = ALL[name]()
    inputs = 0.5 * torch.randn(3, 5, 1)
    at = Gaussian(0.3 * torch.randn(3, 2), belief().covariance.expand(3, 2, 2))
    beliefs = rollout(propagator, model, at, inputs)
    before = [
        torch.cat([now[:, None], later[:, :-1]], dim=1)
        for now, later in ((at.mean, beliefs.mean), (at.covariance, beliefs.covariance))
    ]
    local = linearize(propagator, model, Gaussian(*before), inputs)
    assert beliefs.mean.shape == (3, 5, 2)
    assert local.A.shape == (3, 5, 6, 6)
    assert torch.allclose(local.next.mean, beliefs.mean, atol=1e-12)
    assert torch.allclose(local.next.covariance, beliefs.covariance, atol=1e-12)
    s = extended_state(at)
    for k in range(
        5
    ):  # the chain of local models reproduces the beliefs it was made along
        s = (local.A[:, k] @ s[..., None] + local.B[:, k] @ inputs[:, k, :, None])[
            ..., 0
        ] + local.c[:, k]
        expected = extended_state(
            Gaussian(beliefs.mean[:, k], beliefs.covariance[:, k])
        )
        assert torch.allclose(s, expected, atol=1e-9)


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_an_autonomous_model_needs_no_input(name):
    model = gp(m=0)
    propagator = DETERMINISTIC[name]()
    local = linearize(propagator, model, belief())
    assert local.B.shape == (6, 0)
    assert rollout(propagator, model, belief(), torch.zeros(3, 0)).mean.shape == (3, 2)


@pytest.mark.parametrize("name", ALL)
def test_no_belief_at_all_has_local_models_of_the_right_shape(name):
    for batch in ((0,), (2, 0)):
        at = Gaussian(torch.zeros(*batch, 2), torch.zeros(*batch, 2, 2))
        local = linearize(ALL[name](), gp(), at, torch.zeros(*batch, 1))
        assert local.A.shape == (*batch, 6, 6)
        assert local.B.shape == (*batch, 6, 1)
        assert local.c.shape == (*batch, 6)


def test_inputs_without_a_horizon_are_refused():
    for inputs in (torch.zeros(1), torch.zeros(0, 1)):
        with pytest.raises(
            ShapeError,
            match=r"inputs must be \(\*batch, H, m\) with H of 1 or more; got",
        ):
            rollout(MomentMatching(), gp(), belief(), inputs)
    with pytest.raises(SettingError, match="inputs: must be a torch tensor; got list"):
        rollout(MomentMatching(), gp(), belief(), [[0.1]])


@pytest.mark.parametrize("name", ALL)
def test_a_belief_of_other_names_is_refused_by_every_door(name):
    propagator = ALL[name]()
    model = replace(gp(), signals=Signals(["angle", "rate"], ["torque"]))
    u = torch.zeros(1)
    for step in (propagator.propagate, partial(linearize, propagator)):
        same = step(model, replace(belief(), names=("angle", "rate")), u)
        assert same is not None
        with pytest.raises(SettingError, match="rate, angle"):
            step(model, replace(belief(), names=("rate", "angle")), u)


def test_the_symmetric_root_is_semidefinite_and_squares_back():
    root = torch.randn(5, 3, 3)
    S = root @ root.mT
    R = square_root(S)
    assert torch.allclose(R @ R, S, atol=1e-12)
    assert torch.allclose(R, R.mT, atol=1e-13)
    assert float(torch.linalg.eigvalsh(R).min()) >= 0


@pytest.mark.parametrize(
    "eigenvalues",
    [(1.0, 2.0, 5.0), (2.0, 2.0, 2.0), (1.0, 1.0, 3.0), (1e-6, 1.0, 1.0)],
    ids=["distinct", "all equal", "two equal", "nearly singular"],
)
def test_the_roots_derivative_agrees_with_finite_differences(eigenvalues):
    U = torch.linalg.qr(torch.randn(3, 3)).Q
    S = U @ torch.diag(torch.tensor(eigenvalues)) @ U.T
    change = torch.randn(3, 3)
    change = change + change.T
    step = 1e-3 * min(eigenvalues)
    _, derivative = torch.func.jvp(square_root, (S,), (change,))
    numeric = (square_root(S + step * change) - square_root(S - step * change)) / (
        2 * step
    )
    assert torch.allclose(derivative, numeric, rtol=1e-4, atol=1e-4)
    by_reverse = (torch.func.jacrev(square_root)(S) * change).sum((-2, -1))
    assert torch.allclose(by_reverse, derivative, atol=1e-9 / min(eigenvalues) ** 0.5)


@pytest.mark.parametrize(
    "eigenvalues",
    [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 2.0, 2.0), (-1e-17, 1.0, 1.0)],
)
def test_a_missing_derivative_is_finite_and_0_in_the_null_space(eigenvalues):
    U = torch.linalg.qr(torch.randn(3, 3)).Q
    S = U @ torch.diag(torch.tensor(eigenvalues)) @ U.T
    S = (S + S.T) / 2 if any(eigenvalues) else torch.zeros(3, 3)
    derivative = torch.func.jacrev(square_root)(S)
    assert torch.isfinite(derivative).all()
    if not any(eigenvalues):
        assert not derivative.any()
    assert torch.isfinite(square_root(S)).all()
