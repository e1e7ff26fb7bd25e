"""Functions that users wrote with numpy or math get the name to use."""

import cmath
import math
from dataclasses import replace
from math import cos

import numpy as np
import pytest
import torch

from gpmpc.estimation import KalmanFilter, Measurement
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import Affine, KnownModel, ResidualModel
from gpmpc.models._nominal import lost_derivative
from gpmpc.mpc import GPMPC, Inequality, LeastSquares, Problem, Reference, Tracking
from gpmpc.mpc.baselines import NMPC
from gpmpc.propagation import Linearization
from gpmpc.systems import System, step, step_many
from tests.gp.small_models import posterior

F = torch.float64
MODEL = KnownModel(Affine.identity(2, 1), 2, 1)
STATE = np.array([0.3, -0.1])
TRACKING = Tracking([1.0, 1.0], [1.0], penalized="inputs")


def decide(horizon=3, parameters=None, **parts):
    problem = Problem(TRACKING, **parts)
    controller = GPMPC(MODEL, Linearization(), problem, horizon, [0.0])
    reference = Reference(np.ones(2))
    return controller.control(Gaussian.certain(STATE), reference, parameters=parameters)


def norm(x):
    return np.linalg.norm(x, axis=1)


def over_lines(x):
    sine = torch.sin(x[:, 0])
    return torch.add(
        sine,
        math.fabs(x[:, 1]),
    )


class Distance:
    def __call__(self, x, u):
        return u[:, 0] + self.of(x)

    def of(self, x):
        return np.hypot(x[:, 0], x[:, 1])


WRITTEN = {
    "numpy": (lambda x: np.sin(x[:, 0]), "torch.sin for np.sin"),
    "math": (lambda x: math.sin(x[:, 0]), "torch.sin for math.sin"),
    "a name of math": (lambda x: cos(x[:, 0]), "torch.cos for cos"),
    "a part of numpy": (norm, "torch.linalg.norm for np.linalg.norm"),
    "over lines": (over_lines, "torch.abs for math.fabs"),
    "a method": (Distance(), "torch.hypot for np.hypot"),
    "cmath": (lambda x: cmath.exp(x[:, 0]), "torch.exp for cmath.exp"),
    "an array": (
        lambda x: np.array([x[0, 0], x[1, 0]]),
        r"torch.stack \(of numbers torch.tensor\) for np.array",
    ),
    "numpy itself": (np.sin, "torch.sin for numpy.sin"),
    "math itself": (math.cos, "torch.cos for math.cos"),
    "no name": (lambda x: x[:, 0].numpy(), "takes numbers out of a tensor"),
    "float": (lambda x: float(x[:, 0]) * x[:, 1], "takes numbers out of a tensor"),
}
LOST = {
    "detached": lambda x: torch.tensor(np.sin(x.detach().numpy()))[:, 0],
    "made anew": lambda x: torch.tensor([row[0].item() for row in x], dtype=F),
}


@pytest.mark.parametrize("horizon", [1, 3])
@pytest.mark.parametrize("written", WRITTEN)
def test_constraints_and_outputs_get_the_rule_and_the_name(written, horizon):
    function, advice = WRITTEN[written]
    with pytest.raises(SettingError, match=f"h: must be written with torch.*{advice}"):
        decide(horizon, constraints=[Inequality(function)])
    with pytest.raises(SettingError, match=f"y: must be written with torch.*{advice}"):
        decide(horizon, outputs=[LeastSquares(function, [1.0])])


@pytest.mark.parametrize("horizon", [1, 3])
@pytest.mark.parametrize("written", LOST)
def test_a_function_that_loses_its_derivative_is_refused(written, horizon):
    function = LOST[written]
    parameters = np.zeros((horizon, 1))
    for parts in (
        {"constraints": [Inequality(function)]},
        {"outputs": [LeastSquares(function, [1.0])]},
        {
            "constraints": [Inequality(lambda x, u, p: function(x))],
            "parameters": parameters,
        },
    ):
        with pytest.raises(SettingError, match="and their derivatives are lost"):
            decide(horizon, **parts)


@pytest.mark.parametrize("horizon", [1, 3])
def test_functions_of_parameters_alone_need_no_derivative(horizon):
    for function, parameters in (
        (lambda x: torch.ones(len(x), dtype=F), None),
        (lambda x, u, p: p[:, 0], np.arange(3.0)[:horizon, None]),
        (lambda x: torch.sin(x[:, 0]) + np.pi + math.sqrt(2.0), None),
        (lambda x: np.float64(2.0) * x[:, 0], None),
    ):
        decision = decide(horizon, parameters, constraints=[Inequality(function)])
        assert decision.status.solved


def test_a_fault_of_its_own_is_left_to_the_function():
    with pytest.raises(IndexError):
        decide(constraints=[Inequality(lambda x: x[:, 7])])
    with pytest.raises(NameError):
        decide(constraints=[Inequality(lambda x: undefined(x))])  # noqa: F821


def transitions():
    generator = torch.Generator().manual_seed(0)
    x, u = (torch.randn(12, k, generator=generator, dtype=F) for k in (2, 1))
    return Transitions(x, u, x + 0.1 * u)


def test_training_refuses_a_nominal_model_of_numpy():
    trainer = Trainer(restarts=0)
    for nominal, advice in (
        (lambda x, u: np.sin(x), "torch.sin for np.sin"),
        (lambda x, u: x * math.cos(u), "torch.cos for math.cos"),
        (lambda x, u: torch.tensor(np.sin(x.detach().numpy())), "derivatives are lost"),
    ):
        with pytest.raises(SettingError, match=f"nominal: .*{advice}"):
            ResidualModel.train(nominal, transitions(), trainer=trainer)
        states = np.array([[0.1, 0.2], [0.3, 0.4]])
        with pytest.raises(SettingError, match=f"function: .*{advice}"):
            KnownModel(nominal, 2, 1).linearize(states, np.ones((2, 1)))
    effect = torch.ones(2, 1, dtype=F)
    with pytest.raises(SettingError, match=r"B: .*torch.exp for np.exp"):
        ResidualModel.train(
            lambda x, u: x,
            transitions(),
            B=lambda x: effect * np.exp(x[..., :1, None]),
            trainer=trainer,
        )


def test_one_point_of_math_does_not_lose_its_derivative():
    with pytest.raises(SettingError, match=r"torch.cos for math.cos"):
        KnownModel(lambda x, u: x * math.cos(x[..., 0]), 2, 1)
    good = KnownModel(lambda x, u: x * torch.cos(x[..., :1]), 2, 1)
    linearized = good.linearize(STATE[None], np.zeros((1, 1)))
    twice = good.linearize(np.tile(STATE, (2, 1)), np.zeros((2, 1)))
    for one, two in zip(linearized, twice, strict=True):
        assert np.array_equal(one, two[:1])


def test_measurements_get_the_rule_and_the_name():
    for function in (
        lambda x: np.sin(x[..., :1]),
        lambda x: x[..., :1] * math.sin(x[..., 1]),
    ):
        measurement = Measurement(2, torch.eye(1, dtype=F), function)
        belief = Gaussian.certain(STATE)
        with pytest.raises(SettingError, match=r"function: .*torch.sin for (np|math)"):
            KalmanFilter.extended(MODEL, measurement).update(belief, [0.1])


@pytest.mark.parametrize(
    "lost",
    [
        lambda x: x + torch.tensor(np.sin(x.detach().numpy())),
        lambda x: x * torch.cos(x.flip(-1)).detach(),
        lambda x: torch.cat([x[..., :1], x[..., 1:].sqrt().detach()], dim=-1),
    ],
)
def test_a_function_of_a_lost_derivative_is_refused(lost):
    lost_in_part = "function: must be followed by torch as a whole: .* torch finds"
    with pytest.raises(SettingError, match=lost_in_part):
        KnownModel(lambda x, u: lost(x) + u, 2, 1)
    measurement = Measurement(2, torch.eye(2, dtype=F), lost)
    with pytest.raises(SettingError, match=lost_in_part):
        KalmanFilter.extended(MODEL, measurement)
    KalmanFilter.unscented(MODEL, measurement)  # sigma points ask for values alone
    gp = posterior(n=1, m=2, predicts="value")
    good = ResidualModel(
        nominal=lambda x, u: x + u,
        residual=gp,
        B=lambda x: torch.cos(x)[..., None],
        states=[1],
        inputs=[0, 1],
        input_dim=2,
        noise=torch.eye(2, dtype=F),
    )
    for parts, key in (
        ({"nominal": lambda x, u: lost(x) + u}, "nominal"),
        ({"B": lambda x: lost(x)[..., None]}, "B"),
    ):
        with pytest.raises(SettingError, match=f"{key}: must be followed .* as a who"):
            replace(good, **parts)


@pytest.mark.parametrize(
    "whole",
    [
        lambda x: torch.sin(300.0 * x) + x.abs() + torch.relu(x),
        lambda x: 1e4 * (3.0 * x.float() + torch.exp(x.float())).double(),
        lambda x: torch.floor(x) + torch.log(x) / (x - 0.5),
        lambda x: 1e9 + torch.exp(300.0 * x),
        lambda x: x + 1e16 * x / x.norm(dim=-1, keepdim=True) ** 3,
        lambda x: x + 0.01 * torch.sin(2.0 * np.pi * x / 1e-3),
        lambda x: (0.3 * x.float() + 1e5 - 1e5).double(),
        lambda x: x + (x.round() - x).detach(),
    ],
)
def test_kinks_single_precision_and_edges_lose_no_derivative(whole):
    KnownModel(lambda x, u: whole(x) + u, 2, 1)
    KalmanFilter.extended(MODEL, Measurement(2, torch.eye(2, dtype=F), whole))


@pytest.mark.parametrize("width", [1e-2, 5e-4, 1e-6, 0.0])
def test_friction_at_rest_loses_no_derivative(width):
    def sliding(x, u):
        force = torch.tanh(x / width) if width else torch.relu(x)
        return x + 0.01 * (u - 2.0 * force)

    at_rest = np.zeros((2, 1))
    for dtype in (torch.float32, F):
        like = torch.zeros(1, dtype=dtype)
        assert lost_derivative(sliding, like, at_rest, at_rest) is None


def plant(function):
    class Dynamics:
        state_names = ("angle", "rate")
        input_names = ("torque",)

        def derivative(self, x, u):
            return [x[1], function(x[0]) + u[0]]

    return System(Dynamics(), 0.1)


def test_dynamics_of_math_refuse_arrays_and_expressions():
    system = plant(math.sin)
    assert np.isfinite(step(system, STATE, [0.0])).all()
    with pytest.raises(
        SettingError,
        match="dynamics: .*for floats, arrays and CasADi; got NaN, which math",
    ):
        successor_function(system)
    with pytest.raises(SettingError, match="dynamics: .*for floats, arrays and CasADi"):
        NMPC(system, Problem(TRACKING), 2, [0.0])


class OfMath:
    state_names = ("angle", "rate")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [x[1], math.sqrt(math.cos(x[0])) + u[0]]


class OfTorch(OfMath):
    def derivative(self, x, u):
        return [x[1], torch.exp(x[0]) + u[0]]


def test_dynamics_get_the_name_to_use():
    advice = r"gpmpc.systems.sqrt for math.sqrt, gpmpc.systems.cos for math.cos"
    with pytest.raises(SettingError, match=f"dynamics: .*{advice}"):
        step_many(System(OfMath(), 0.1), np.zeros((3, 2)), np.zeros((3, 1)))
    with pytest.raises(SettingError, match=r"dynamics: .*systems.exp for torch.exp"):
        System(OfTorch(), 0.1)
