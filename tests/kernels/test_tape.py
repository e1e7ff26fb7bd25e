"""A tape gives what CasADi gives, value and derivatives, and says where it cannot."""

import casadi
import numpy as np
import pytest
import torch

from gpmpc._kernels.gp_rollout import Feedback
from gpmpc.gp.casadi_ import tape_of
from gpmpc.models import CasadiFunction, KnownModel, RollOut
from gpmpc.systems import double_pendulum, step

X = casadi.SX.sym("x", 3)
U = casadi.SX.sym("u", 2)
EVERY = casadi.vertcat(
    X[0] / X[1] - casadi.atan2(X[2], U[0]) + casadi.sqrt(1 + X[0] ** 2),
    casadi.exp(-X[1]) * casadi.fmin(X[0], U[1])
    + casadi.fmax(X[2], U[0])
    - casadi.tan(0.3 * X[0]),
    casadi.tanh(X[2]) * casadi.log(2 + casadi.sin(U[0]) ** 2)
    + casadi.atan(U[1])
    + 1 / (3 + casadi.cos(X[0])),
    casadi.fabs(X[0]) ** 1.5 + (2 + X[1] ** 2) ** X[2] - 2 * U[1],
)
FURTHER = casadi.vertcat(
    casadi.asin(0.4 * X[0]) + casadi.acos(0.4 * X[1]) + casadi.erf(X[2]),
    casadi.sinh(X[0]) - casadi.cosh(X[1]) + casadi.asinh(X[2]),
    casadi.acosh(1.5 + X[0]) + casadi.atanh(0.4 * X[1]) + casadi.log1p(X[2]),
    casadi.expm1(X[0]) * casadi.hypot(X[1], X[2]) + casadi.copysign(X[0], X[1] - 1),
    casadi.floor(3 * X[0]) * X[1] + casadi.ceil(2 * X[1]) + casadi.fmod(X[2], 0.7),
    casadi.sign(X[0] - 1) * X[1],
    casadi.if_else(X[0] > X[1], X[2] ** 2, casadi.sin(U[0])),
    casadi.if_else(casadi.logic_and(X[0] <= 1, X[1] != X[2]), X[0], X[1] * U[0]),
    casadi.if_else(casadi.logic_or(X[0] > 1, X[1] == 3), X[0] * X[2], U[1]),
)
MATRIX = casadi.horzcat(
    casadi.vertcat(X[0] * X[1], casadi.sin(X[2])), casadi.vertcat(2.0, X[1] ** 3)
)
FUNCTIONS = (
    casadi.Function("f", [X, U], [EVERY]),
    casadi.Function("f", [X, U], [FURTHER]),
    casadi.Function("f", [X], [MATRIX]),
)


@pytest.mark.parametrize("function", FUNCTIONS, ids=["vector", "further", "matrix"])
def test_a_tape_has_the_values_and_derivatives_of_casadi(function, rng):
    compiled = CasadiFunction(function)
    plain = CasadiFunction(function)
    plain.tape = None
    names = function.name_in()
    plain._expansion = function.factory(
        "e", names, ["o0", *(f"jac:o0:{name}" for name in names)]
    )
    assert compiled.tape is not None
    arguments = [rng.uniform(0.2, 2, (7, size)) for size in (3, 2)[: len(names)]]
    for value, expected in zip(
        compiled.linearize(*arguments), plain.linearize(*arguments), strict=True
    ):
        assert value.shape == expected.shape
        assert np.allclose(value, expected, rtol=1e-12, atol=1e-12)


def test_matrix_expressions_expand_and_other_calls_have_no_tape():
    x = casadi.MX.sym("x", 2)
    assert tape_of(casadi.Function("f", [x], [casadi.sin(x) @ x.T])) is not None
    table = casadi.interpolant(
        "table", "bspline", [[0.0, 1.0, 2.0, 3.0, 4.0]], [0.0, 1.0, 4.0, 9.0, 16.0]
    )
    assert tape_of(casadi.Function("f", [x], [table(x[0])])) is None


def test_what_a_condition_leaves_out_need_not_be_finite():
    x = casadi.SX.sym("x")
    root = casadi.if_else(x > 0, casadi.sqrt(x), 2 * x)
    function = CasadiFunction(casadi.Function("f", [x], [root]))
    values, slopes = function.linearize(np.array([[-1.0], [4.0]]))
    assert values.ravel().tolist() == [-2.0, 2.0]
    assert slopes.ravel().tolist() == [2.0, 0.25]


def test_one_call_rolls_a_known_model_out_within_bounds(rng):
    system = double_pendulum("shoulder")
    H = 12
    x = casadi.SX.sym("x", 4)
    u = casadi.SX.sym("u", 1)
    function = casadi.Function(
        "successor", [x, u], [casadi.vertcat(*system.successor(x, u))]
    )
    model = KnownModel(CasadiFunction(function), 4, 1)
    planned = rng.normal(size=(2, H, 4))
    gains = rng.normal(size=(2, H, 1, 4))
    limits = (
        *(np.full((H, 1), limit) for limit in (-6.0, 6.0, -3.0, 3.0)),
        np.array([0.5]),
    )
    feedback = Feedback(planned, rng.uniform(-4, 4, (2, H, 1)), gains, *limits)
    starts = rng.normal(size=(2, 4))
    gust = np.array([0.0, 0.1, 0.0, 0.0])
    states, inputs = RollOut(model)(starts, feedback, gust)
    for t in range(2):
        state = starts[t]
        last = 0.5
        for k in range(H):
            fed_back = feedback.inputs[t, k, 0] + gains[t, k, 0] @ (
                state - planned[t, k]
            )
            last = np.clip(np.clip(fed_back, last - 3, last + 3), -6, 6)
            assert inputs[t, k, 0] == pytest.approx(last, rel=1e-9, abs=1e-12)
            state = step(system, state, inputs[t, k]) + gust
            assert np.allclose(states[t, k + 1], state, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("count", [1, 3, 8, 9])
def test_roll_outs_of_functions_undefined_at_zero_are_right(count, rng):
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u", 1)
    after = casadi.vertcat(
        x[0] + 0.1 * (u[0] - casadi.sqrt(x[0])),
        x[1] + 0.1 * casadi.log(x[0]) / casadi.atan2(x[0], x[1]),
    )
    function = casadi.Function("f", [x, u], [after])
    starts = rng.uniform(1, 2, (count, 2))
    inputs = rng.uniform(0.5, 1, (count, 5, 1))
    states = RollOut(KnownModel(CasadiFunction(function), 2, 1)).open_loop(
        starts, inputs
    )
    for t in range(count):
        for k in range(5):
            assert np.allclose(
                states[t, k + 1],
                function(states[t, k], inputs[t, k]).full()[:, 0],
                rtol=1e-12,
            )


def test_an_infinite_derivative_is_returned_without_an_error():
    function = CasadiFunction(
        casadi.Function(
            "f", [X], [casadi.vertcat(casadi.sqrt(X[0]), 1 / X[1], casadi.log(X[2]))]
        )
    )
    values, slopes = function.linearize(np.array([[0.0, 2.0, 1.0], [4.0, 0.0, 1.0]]))
    assert values.tolist() == [[0.0, 0.5, 0.0], [2.0, np.inf, 0.0]]
    assert slopes[0, 0, 0] == np.inf
    assert slopes[1, 1, 1] == -np.inf
    assert slopes[1, 0, 0] == 0.25


def test_a_function_without_inputs_is_a_model():
    x = casadi.SX.sym("x", 2)
    no_input = casadi.SX.sym("u", 0)
    function = casadi.Function("f", [x, no_input], [2 * x])
    model = KnownModel(CasadiFunction(function), 2, input_dim=0)
    state = torch.ones(3, 2)
    after = model.predict(state, torch.empty(3, 0)).mean
    assert torch.equal(after, 2 * state)


@pytest.mark.parametrize("dtype", [np.int64, np.float32])
def test_numbers_of_any_type_are_taken_for_what_they_are(dtype):
    function = CasadiFunction(FUNCTIONS[0])
    arguments = (np.array([[1, 2, 3]]), np.array([[1, 2]]))
    expected = function.linearize(*[a.astype(float) for a in arguments])
    for value, right in zip(
        function.linearize(*[a.astype(dtype) for a in arguments]), expected, strict=True
    ):
        assert np.array_equal(value, right)


POLES = {
    "log": (casadi.log, 0.0),
    "log1p": (casadi.log1p, -1.0),
    "atanh": (casadi.atanh, 1.0),
    "atanh below": (casadi.atanh, -1.0),
    "log outside": (casadi.log, -1.0),
    "log1p outside": (casadi.log1p, -2.0),
    "acosh outside": (casadi.acosh, 0.5),
    "a floor": (lambda x: casadi.fmax(-5, casadi.log(x)), 0.0),
    "a floor under nothing": (lambda x: casadi.fmax(casadi.log(x), -5), -1.0),
    "a floor under nothing, first": (lambda x: casadi.fmax(-5, casadi.log(x)), -1.0),
    "a ceiling over nothing": (lambda x: casadi.fmin(casadi.log(x), -5), -1.0),
}


@pytest.mark.parametrize("name", POLES)
def test_values_at_a_pole_and_outside_are_those_of_casadi(name):
    make, point = POLES[name]
    x = casadi.SX.sym("x")
    function = CasadiFunction(casadi.Function("f", [x], [make(x)]))
    value, slope = function.linearize(np.array([[point]]))
    expected = float(function.function(point))
    assert np.array_equal(value.item(), expected, equal_nan=True)
    if np.isnan(expected):
        assert np.isnan(slope).all() or "log" in name  # of which CasADi has 1 / x


def test_a_limit_has_the_slope_of_what_it_takes():
    x = casadi.SX.sym("x")
    for limit in (
        casadi.fmax(-5, casadi.log(x)),
        casadi.fmax(casadi.log(x), -5),
        casadi.fmin(casadi.log(x), -5),
    ):
        function = CasadiFunction(casadi.Function("f", [x], [limit]))
        values, slopes = function.linearize(np.array([[-1.0]]))
        assert (values.item(), slopes.item()) == (-5.0, 0.0)
