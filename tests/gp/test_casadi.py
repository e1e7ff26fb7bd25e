"""The CasADi function is ``predict``, values and derivatives, and IPOPT can work with
it."""

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import UnsupportedModel
from gpmpc.gp import GPPosterior
from gpmpc.gp.casadi_ import casadi_function
from gpmpc.models import ResidualModel, linearize
from tests.gp.small_models import posterior, residual_model

CASES = {
    "next_state": lambda: posterior(),
    "difference": lambda: posterior(predicts="difference"),
    "value": lambda: posterior(n=1, m=1, predicts="value"),
    "autonomous": lambda: posterior(m=0),
    "one output": lambda: posterior(n=1, m=0, size=1),
    "the paper's size": lambda: posterior(size=189, n=6, m=3, predicts="difference"),
    "residual": residual_model,
}


@pytest.mark.parametrize("make", CASES.values(), ids=CASES.keys())
def test_values_and_jacobians_are_those_of_predict(make):
    model = make()
    n = model.state_dim
    m = model.input_dim
    function = casadi_function(model)
    assert (function.name(), function.name_in(), function.name_out()) == (
        "gp",
        ["state", "input"],
        ["mean", "variance"],
    )
    x = casadi.MX.sym("x", n)
    u = casadi.MX.sym("u", m)
    mean, variance = function(x, u)
    q = casadi.vertcat(x, u)
    everything = casadi.Function(
        "all",
        [x, u],
        [mean, variance, casadi.jacobian(mean, q), casadi.jacobian(variance, q)],
    )
    for _ in range(5):
        state = torch.randn(n)
        control = torch.randn(m)
        (mean,), (A,), (B,), (V,) = linearize(
            model, state.numpy()[None], control.numpy()[None]
        )
        # The variance at a query that is one vector, whose derivatives torch can
        # follow.
        spread = torch.autograd.functional.jacobian(
            lambda joint: model.predict(joint[:n], joint[n:]).variance,
            torch.cat([state, control]),
        )
        expected = [
            mean[:, None],
            np.diag(V)[:, None],
            np.hstack([A, B]),
            spread.numpy(),
        ]
        for ours, theirs in zip(
            everything(state.numpy(), control.numpy()), expected, strict=True
        ):
            assert np.abs(ours.full() - theirs).max() < 1e-10


def test_ill_conditioning_loses_no_more_digits_than_torch():
    gp = posterior(size=60)
    gp = GPPosterior.from_hyperparameters(
        gp.features,
        gp.targets,
        2 * gp.lengthscales,
        gp.signal_variance,
        torch.full((2,), 1e-9),
        1,
    )
    assert float(torch.linalg.cond(gp.cholesky).max()) > 1e4
    state = 0.3 * torch.ones(2)
    control = torch.zeros(1)
    mean, variance = casadi_function(gp)(state.numpy(), control.numpy())
    at = gp.predict(state, control)
    assert np.abs(mean.full()[:, 0] - at.mean.numpy()).max() < 1e-8 * float(
        gp.weights.abs().sum()
    )
    assert np.abs(variance.full()[:, 0] - at.variance.numpy()).max() < 1e-10


def test_the_variance_on_a_noiseless_point_is_never_negative():
    gp = GPPosterior.from_hyperparameters(
        torch.tensor([[0.5, 0.2]]),
        torch.ones(1, 1),
        torch.ones(1, 2),
        torch.ones(1),
        torch.tensor([1e-16]),
        1,
    )
    assert float(casadi_function(gp)(0.5, 0.2)[1]) == 0.0


def test_the_graph_does_not_grow_with_the_data():
    few, many = (
        casadi_function(posterior(size=size)).n_instructions() for size in (5, 150)
    )
    assert few == many < 60


def test_the_function_can_be_stored_expanded_and_compiled(tmp_path, monkeypatch):
    function = casadi_function(posterior())
    monkeypatch.chdir(tmp_path)  # CasADi writes C into the present folder only
    function.generate("gp.c")
    assert "int gp(" in (tmp_path / "gp.c").read_text()
    for other in (function.expand(), casadi.Function.deserialize(function.serialize())):
        for ours, theirs in zip(
            other([0.1, 0.2], 0.3), function([0.1, 0.2], 0.3), strict=True
        ):
            assert np.abs(ours.full() - theirs.full()).max() < 1e-13


def test_ipopt_steers_through_the_model():
    gp = posterior(size=40, predicts="difference", n=1)
    dynamics = casadi_function(gp)
    horizon = 4
    x = casadi.MX.sym("x", 1, horizon)
    u = casadi.MX.sym("u", 1, horizon)
    start = 0.3
    before = casadi.horzcat(start, x[:, :-1])
    next_means, variance = dynamics.map(horizon)(before, u)
    reachable = float(gp.predict(torch.tensor([start]), torch.tensor([0.4])).mean)
    cost = (
        casadi.sumsqr(x - reachable) + 1e-3 * casadi.sumsqr(u) + casadi.sum2(variance)
    )
    problem = {"x": casadi.veccat(x, u), "f": cost, "g": casadi.vec(next_means - x)}
    solver = casadi.nlpsol(
        "solver", "ipopt", problem, {"ipopt.print_level": 0, "print_time": 0}
    )
    solution = solver(x0=0.0, lbg=0.0, ubg=0.0)
    assert solver.stats()["success"]
    path = np.append(start, solution["x"].full()[:horizon, 0])
    for k, control in enumerate(solution["x"].full()[horizon:, 0]):
        following = gp.predict(torch.tensor([path[k]]), torch.tensor([control])).mean
        assert float(following) == pytest.approx(path[k + 1], abs=1e-7)


def test_a_model_of_code_is_refused():
    model = residual_model()
    model = ResidualModel(
        lambda x, u: x,
        model.residual,
        model.B,
        model.states,
        model.inputs,
        model.input_dim,
    )
    with pytest.raises(
        UnsupportedModel, match="got ResidualModel of a nominal function"
    ):
        casadi_function(model)
