"""What a system's description says is known, and not learned."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.calibration import Recording, calibrate
from gpmpc.datasets import RandomData
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gp import GPPosterior, SparseTrainer, Trainer, Transitions, standardize
from gpmpc.models import Affine, ResidualModel, train
from gpmpc.propagation import Linearization
from gpmpc.signals import Signals
from gpmpc.systems import (
    System,
    cart_pole,
    double_integrator,
    pendulum,
    step_many,
)

QUICK = {"restarts": 0, "tolerance": 1e-4}


def rows(system, size=120, noise=1e-3, seed=0):
    width = np.subtract(*reversed(system.region))
    return RandomData(samples=size, noise=noise * width, seed=seed).transitions(system)


def one_step_error(model, data):
    predicted = model.predict(data.states, data.inputs).mean
    return float((predicted - data.next_states).square().mean().sqrt())


def test_names_angles_and_rates_of_a_system_enter_its_model():
    plant = cart_pole()
    data = rows(plant)
    anonymous = Transitions(data.states, data.inputs, data.next_states)
    model = train(anonymous, system=plant, **QUICK).posterior
    assert isinstance(model, ResidualModel)
    assert model.signals == plant.signals
    assert list(model.angles) == [2]
    # half of what velocity and rate gain within a step moves position and angle
    h = plant.time_step
    assert model.B.T.tolist() == [[h / 2, 1, 0, 0], [0, 0, h / 2, 1]]
    learned = train(data, system=plant, kinematics="learned", **QUICK).posterior
    fresh = rows(plant, noise=0.0, seed=1)
    assert one_step_error(model, fresh) < 1.05 * one_step_error(learned, fresh)
    # A position that is integrated has as much noise as one that is learned.
    noise = model.noise_covariance.diagonal() / learned.noise_covariance.diagonal()
    assert noise.sqrt().tolist() == pytest.approx([1.0] * 4, rel=0.2)


def shown_within_a_turn(states):
    angle, rate = states.T
    return torch.stack([torch.atan2(angle.sin(), angle.cos()), rate], dim=1)


def test_wrapped_angles_are_learned_without_their_turns():
    plant = pendulum()
    data = rows(plant)
    seen = replace(
        data,
        states=shown_within_a_turn(data.states),
        next_states=shown_within_a_turn(data.next_states),
    )
    assert (seen.next_states - seen.states)[:, 0].abs().max() > 5  # jumps
    state = torch.tensor([[3.1, 4.0]], dtype=torch.float64)
    input = torch.tensor([[0.5]], dtype=torch.float64)
    as_it_moves, as_a_sensor_shows_it = (
        train(each, system=plant, **QUICK).posterior.predict(state, input).mean
        for each in (data, seen)
    )
    assert torch.allclose(as_it_moves, as_a_sensor_shows_it, atol=1e-6)


class Euler:
    """A mass whose position moves by its new velocity, as in many simulators."""

    state_names = ("position", "velocity")
    input_names = ("force",)

    def successor(self, x, u):
        velocity = x[1] + 0.1 * u[0]
        return [x[0] + 0.1 * velocity, velocity]


class Drifting(Euler):
    """A position that a current moves as well: its rate is not all of it."""

    def __init__(self, drift):
        self.drift = drift

    def successor(self, x, u):
        velocity = x[1] + 0.1 * u[0]
        return [x[0] + 0.1 * velocity + self.drift * np.sin(x[0]), velocity]


def euler_system(dynamics):
    return System(
        dynamics,
        time_step=0.1,
        input_lower=[-1.0],
        input_upper=[1.0],
        rates={"velocity": "position"},
        region=[[-2.0, -1.0], [2.0, 1.0]],
    )


def test_how_a_position_follows_is_seen_in_the_data():
    smooth = train(rows(double_integrator()), system=double_integrator(), **QUICK)
    assert smooth.posterior.B.ravel().tolist() == [0.05, 1.0]
    plant = euler_system(Euler())
    semi_implicit = train(rows(plant, noise=1e-4), system=plant, **QUICK).posterior
    assert semi_implicit.B.ravel().tolist() == pytest.approx([0.1, 1.0], rel=0.01)
    plant = euler_system(Drifting(0.2))
    drifting = train(rows(plant), system=plant, **QUICK).posterior
    assert drifting.residual.output_dim == 2  # what the rate does not explain
    fresh = rows(plant, noise=0.0, seed=1)
    assert one_step_error(drifting, fresh) < 0.01


def test_a_small_error_that_adds_up_is_learned():
    # A third of the variance of a step, and most of that of ten.
    plant = euler_system(Drifting(0.004))
    model = train(rows(plant, size=300), system=plant, **QUICK).posterior
    assert model.residual.output_dim == 2
    fresh = Recording.chained(rows(plant, size=150, seed=1))
    calibration = calibrate(model, fresh, Linearization(), 10, levels=[0.95])
    assert float(calibration.coverage[[0, 9], 0].min()) > 0.9


def test_noise_alone_is_not_learned():
    plant = euler_system(Euler())
    for seed in range(5):
        data = rows(plant, size=60, seed=seed)
        assert train(data, system=plant, **QUICK).posterior.residual.output_dim == 1


class Jerk:
    state_names = ("a", "v", "p")
    input_names = ("u",)

    def derivative(self, x, u):
        return [u[0], x[0], x[1]]


def jerk_system(time_step):
    return System(
        Jerk(),
        time_step,
        input_lower=[-1.0],
        input_upper=[1.0],
        rates={"a": "v", "v": "p"},
        region=[[-1.0] * 3, [1.0] * 3],
    )


def test_accelerations_move_velocities_and_these_positions():
    plant = jerk_system(0.1)
    model = train(rows(plant), system=plant, **QUICK).posterior
    assert model.residual.output_dim == 1
    fresh = rows(plant, noise=0.0, seed=1)
    assert one_step_error(model, fresh) < 2e-3


def test_noise_of_a_velocity_moves_its_position():
    rng = np.random.default_rng(0)
    h = 0.5
    a, v, p = states = rng.uniform(-1, 1, (3, 300))
    u = rng.uniform(-1, 1, 300)
    next_a = a + h * u
    next_v = v + h * (a + next_a) / 2 + rng.normal(0, 0.1, 300)
    next_p = p + h * (v + next_v) / 2 + rng.normal(0, 0.001, 300)
    after = np.column_stack([next_a, next_v, next_p])
    data = Transitions(states.T, u[:, None], after)
    model = train(data, system=jerk_system(h), **QUICK).posterior
    assert model.B.shape == (3, 1)
    deviations = [0.1, h / 2 * 0.1]  # the second nearly all from the first
    found = model.noise.diagonal()[1:].sqrt()
    assert found.tolist() == pytest.approx(deviations, rel=0.1)


def test_what_a_nominal_model_misses_is_learned():
    heavy = pendulum(mass=1.3)
    plant = replace(heavy, nominal=pendulum())
    model = train(rows(plant, size=60), system=plant, **QUICK).posterior
    assert model.residual.output_dim == 1
    fresh = rows(heavy, noise=0.0, seed=1)
    known = step_many(pendulum(), fresh.states.numpy(), fresh.inputs.numpy())
    miss = np.sqrt(np.mean((known - fresh.next_states.numpy()) ** 2))
    assert one_step_error(model, fresh) < 0.2 * miss


def test_without_a_system_states_are_numbers():
    data = rows(double_integrator(), size=30)
    model = train(data, seed=1, **QUICK).posterior
    assert isinstance(model, GPPosterior)
    assert model.predicts == "next_state"
    trainer = Trainer(predicts="next_state", scaling=standardize, **QUICK)
    plain = train(data, system=double_integrator(), trainer=trainer).posterior
    assert isinstance(plain, GPPosterior)


@pytest.mark.parametrize("told", [{"predicts": "difference"}, {}], ids=["told", ""])
def test_a_sparse_trainer_serves_as_well(told):
    trainer = SparseTrainer(inducing=20, scaling=standardize, **told)
    plant = pendulum()
    training = train(rows(plant), system=plant, trainer=trainer)
    assert isinstance(training.posterior, ResidualModel)
    assert training.posterior.residual.output_dim == 1
    assert training.posterior.angles == [0]


def test_a_nominal_model_that_is_not_used_is_said_in_the_log(caplog):
    plant = replace(pendulum(), nominal=pendulum())
    trainer = Trainer(predicts="next_state", **QUICK)
    train(rows(plant, size=20), system=plant, trainer=trainer)
    assert "the nominal model of pendulum is not used" in caplog.text


def test_what_does_not_belong_together_is_refused():
    data = rows(double_integrator(), size=20)
    plant = double_integrator()
    with pytest.raises(SettingError, match="restart: is no argument .*restarts"):
        train(data, system=plant, restart=2)
    with pytest.raises(SettingError, match="restarts: are settings of a Trainer"):
        train(data, system=plant, trainer=Trainer(), restarts=2)
    with pytest.raises(SettingError, match="system: must be a System"):
        train(data, system=Euler())
    with pytest.raises(SettingError, match="kinematics: must be"):
        train(data, system=plant, kinematics="known")
    with pytest.raises(ShapeError, match="its 4 states and 1 inputs; got 2 and 1"):
        train(data, system=cart_pole())
    other = replace(data, signals=Signals(["x", "v"], ["u"], 0.1))
    with pytest.raises(SettingError, match="the data has the states x, v"):
        train(other, system=plant)
    elsewhere = replace(data)
    object.__setattr__(elsewhere, "states", data.states.to("meta"))
    for learn in (
        lambda: train(elsewhere, system=plant),
        lambda: ResidualModel.train(Affine.identity(2, 1), elsewhere),
    ):
        with pytest.raises(SettingError, match="states: must be in host memory for tr"):
            learn()
