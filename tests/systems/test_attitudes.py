"""The attitudes of a trajectory are those with which a vehicle would really fly it."""

import numpy as np
import pytest

from gpmpc.systems import GRAVITY, System, Translational, step
from gpmpc.systems._quadrotor import (
    approach_attitudes,
    attitudes_along,
    rotational_states_along,
    thrust_direction,
)
from gpmpc.trajectories import Elliptical, Hover, Lorenz, states_along


@pytest.mark.parametrize(
    "trajectory", [Elliptical(), Lorenz()], ids=["elliptical", "lorenz"]
)
@pytest.mark.parametrize("outer_step", [0.5, 1.0])
def test_thrust_along_them_follows_the_reference_velocities(trajectory, outer_step):
    vehicle = Translational()
    plant = System(vehicle, outer_step, 1)
    states = states_along(trajectory, outer_step * np.arange(31))
    for k, (roll, pitch) in enumerate(attitudes_along(trajectory, 30, outer_step)):
        ux, uy, vertical = thrust_direction(roll, pitch, 0.0)
        climb = (states[k + 1, 5] - states[k, 5]) / outer_step
        thrust = vehicle.mass * (GRAVITY - climb) / vertical  # [N]
        reached = step(plant, states[k], np.array([thrust, ux, uy]))
        assert reached[1::2] == pytest.approx(states[k + 1, 1::2], abs=1e-9)


def test_hovering_is_level():
    assert not rotational_states_along(Hover(), 50, 0.05).any()


def test_an_attitude_is_approached_with_its_rate_at_first_order():
    angles = np.array([[0.1, -0.2], [0.3, 0.0]])
    states = approach_attitudes(angles, 8, 4, 0.05, 0.1)
    assert np.array_equal(
        states[:5, [0, 2]], np.tile(angles[0], (5, 1))
    )  # it begins where it is to be
    left = np.exp(-0.05 * np.arange(4) / 0.1)[:, None]
    assert states[4:, [0, 2]] == pytest.approx(
        angles[1] + left * (angles[0] - angles[1])
    )
    assert states[4:, [1, 3]] == pytest.approx(left * (angles[1] - angles[0]) / 0.1)
    assert not states[:, 4:].any()


def test_each_is_asked_for_from_one_outer_step_to_the_next():
    states = rotational_states_along(Lorenz(), 61, 0.05)
    ends = states[[20, 40, 60]][:, [0, 2]]  # almost reached, after twenty inner steps
    assert ends == pytest.approx(attitudes_along(Lorenz(), 3), abs=1e-4)
