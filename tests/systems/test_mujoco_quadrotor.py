"""The package's quadrotor in MuJoCo moves as its rigid body says, but for drag, wind
and the lag of its rotors."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from gpmpc.exceptions import SettingError
from gpmpc.studies.flight import metrics, run_trial
from gpmpc.systems import step
from gpmpc.systems.mujoco_quadrotor import RigidBody, mujoco_quadrotor
from tests.systems.experiments import experiment


def test_states_and_joint_positions_are_of_one_attitude(rng):
    vehicle = mujoco_quadrotor().dynamics
    for _ in range(5):
        state = np.zeros(12)
        state[0:6:2] = rng.normal(size=3)
        state[6::2] = rng.uniform([-3, -1.5, -3], [3, 1.5, 3])
        vehicle.data.qpos[:] = vehicle.positions(state)
        vehicle.data.qvel[:] = 0
        vehicle.mujoco.mj_forward(vehicle.model, vehicle.data)
        assert vehicle._measure() == pytest.approx(state, abs=1e-9)


def test_without_drag_and_with_little_lag_it_is_the_rigid_body():
    flown = mujoco_quadrotor(mass=0.6, substeps=1)
    model = flown.dynamics.model
    model.dof_damping[:] = 0
    model.actuator_dynprm[:, 0] = 0.004
    body = replace(flown.nominal, dynamics=RigidBody(0.6, (0.0032, 0.0032, 0.0055)))
    state = rigid = flown.dynamics.reset(0)
    thrusts = np.add(flown.initial_input, [0.03, -0.03, 0.02, -0.01])
    for _ in range(60):
        state = step(flown, state, thrusts)
        rigid = step(body, rigid, thrusts)
    assert np.abs(state[6:]).max() > 0.1
    assert state == pytest.approx(rigid, abs=0.02)


def test_wind_pushes_by_drag_and_thrusts_may_act_late():
    windy = mujoco_quadrotor(wind=(4.0, 0.0, 0.0), substeps=1)
    state = step(windy, windy.dynamics.reset(0), np.array(windy.initial_input))
    assert state[1] == pytest.approx(0.25 * 4 / 0.5 * 0.005, rel=0.01)
    lifted = mujoco_quadrotor(wind=(0.0, 0.0, 2.0))
    state = lifted.dynamics.reset(0)
    for _ in range(600):  # 24 s
        state = step(lifted, state, np.array(lifted.initial_input))
    assert state[5] == pytest.approx(2.0, abs=0.01)  # as fast as the air
    late = mujoco_quadrotor(input_delay=2)
    state = late.dynamics.reset(0)
    speeds = []
    for _ in range(3):
        state = step(late, state, np.full(4, 2.0))
        speeds.append(state[5])
    assert np.abs(speeds[:2]).max() < 1e-9 < 0.05 < speeds[2]
    with pytest.raises(SettingError, match="mass: must be a number above 0"):
        mujoco_quadrotor(mass=0.0)


def test_it_is_flown_from_the_command_line_on_its_data_sheet():
    chosen = experiment("system=mujoco_quadrotor", "data.samples=60", "steps=60")
    flown = run_trial(chosen)
    figures = metrics(chosen, flown)
    assert figures["lost"] is None
    assert figures["error_at_end"] < 0.03
    assert flown.training.posterior.nominal is not None
