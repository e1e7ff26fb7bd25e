"""Pendulums of one and two links and a cart-pole swing up from hanging with the
settings that their files bring."""

import numpy as np
import pytest
import torch

from gpmpc.studies.flight import metrics, run_trial
from gpmpc.studies.study import one_thread
from tests.systems.experiments import experiment


def flown_up(name, *words):
    """What was flown, with the largest error of an angle over the last second."""
    chosen = experiment(f"system={name}", "model.restarts=0", *words)
    with one_thread():
        flown = run_trial(chosen)
    system = chosen.system
    last = round(1 / chosen.system.time_step)
    errors = (
        flown.rollout.states[-last:, system.angle_indices]
        - np.array(system.goal)[system.angle_indices]
    )
    return chosen, flown, np.abs((errors + np.pi) % (2 * np.pi) - np.pi).max()


def test_a_pendulum_swings_up_whichever_turn_it_starts_in():
    chosen, flown, error = flown_up("pendulum")
    assert error < 0.05
    figures = metrics(chosen, flown)
    assert figures["error_at_end"] < 0.05 < 0.5 < figures["rmse"]["total"]
    model = flown.training.posterior
    cost = flown.controller.problem.cost
    assert (model.angles, cost.angles) == ([0], (0,))
    x = torch.tensor([[0.5, 1.0]], dtype=torch.float64)
    u = torch.tensor([[0.3]], dtype=torch.float64)
    turn = torch.tensor([[2 * np.pi, 0.0]], dtype=torch.float64)
    assert torch.allclose(
        model.predict(x + turn, u).mean - turn, model.predict(x, u).mean, atol=1e-9
    )


def test_a_cart_pole_swings_up_and_is_where_it_started():
    _, flown, error = flown_up("cart_pole", "data.samples=300")
    assert error < 0.05
    assert abs(flown.rollout.states[-1, 0]) < 0.05


@pytest.mark.slow
def test_an_acrobot_swings_up_by_its_elbow_alone():
    _, _, error = flown_up("acrobot")
    assert error < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("actuated", "most"), [("elbow", 0.35), ("shoulder", 0.01)])
def test_a_double_pendulum_swings_up_by_either_motor(actuated, most):
    _, _, error = flown_up("double_pendulum", f"system.actuated={actuated}")
    assert error < most


def test_the_papers_protocol_keeps_angles_which_can_be_set():
    chosen = experiment(
        "system=pendulum", "model=exact_gp", "model.restarts=0", "data.samples=12"
    )
    training = chosen.learn(chosen.training_rows(), 0)
    assert training.posterior.features.shape == (12, 3)
    chosen = experiment("system=cart_pole", "controller.problem.cost.angles=[]")
    assert chosen.controller.keywords["problem"].cost.angles == ()


def test_a_nominal_model_leaves_less_to_learn():
    fresh = experiment("system=pendulum", "data.seed=7").training_rows()

    def error(*words):
        chosen = experiment(
            "system=pendulum", "model.restarts=0", "data.samples=20", *words
        )
        model = chosen.learn(chosen.training_rows(), 0).posterior
        return float(
            (model.predict(fresh.states, fresh.inputs).mean - fresh.next_states)
            .pow(2)
            .mean()
            .sqrt()
        )

    assert error("nominal={mass: 0.8}") < 0.3 * error()
    assert error("nominal={}") == error()
