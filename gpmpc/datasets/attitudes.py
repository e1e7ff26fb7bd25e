"""Computes the attitudes that a flight along a trajectory needs, the references of the rotational subsystem.

Between two outer steps the velocity has to change by v[k+1] - v[k], so the thrust has to give the mean acceleration
a = (v[k+1] - v[k]) / T beside the weight. With z downwards

    U1 / m = |a - g e_z|,   ux = a_x / (U1 / m),   uy = a_y / (U1 / m),

and eq. (2) of Cao, Lai and Alam (2017), inverted, makes roll and pitch of that direction, at a yaw of zero. The inner
loop approaches each at first order, (angle_d - angle) / response time, as ``gpmpc.mpc.cascade.Cascade`` asks it to.
"""

import numpy as np

from gpmpc.systems import attitude_for_thrust_direction
from gpmpc.systems.quadrotor import GRAVITY
from gpmpc.trajectories import Trajectory

OUTER_STEP = 1.0  # [s] for which an attitude is asked for
RESPONSE_TIME = 0.1  # [s]


def attitudes_along(trajectory: Trajectory, count: int, outer_step: float = OUTER_STEP) -> np.ndarray:
    """Roll and pitch (count, 2) [rad], one an outer step, that point the thrust where the trajectory needs it."""
    velocities = trajectory.velocity(outer_step * np.arange(count + 1))
    force = np.diff(velocities, axis=0) / outer_step - [0.0, 0.0, GRAVITY]  # over the mass [m/s^2]
    direction = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)  # of a free fall: none
    return attitude_for_thrust_direction(direction[:, 0], direction[:, 1])


def approached(angles: np.ndarray, count: int, hold: int, time_step: float, response_time: float) -> np.ndarray:
    """Rotational states (count, 6) that approach attitudes one after another at first order.

    Args:
        angles: Roll and pitch (K, 2) [rad]; the first is where it begins.
        count: Inner steps, K * hold at most.
        hold: Inner steps that an attitude is asked for.
        time_step: Of an inner step [s].
        response_time: Of the approach [s].
    """
    left = np.exp(-time_step / response_time)  # of the way, after one step
    states, at = np.zeros((count, 6)), angles[0]
    for j in range(count):
        wanted = angles[j // hold]
        states[j, [0, 2]], states[j, [1, 3]] = at, (wanted - at) / response_time
        at = wanted + left * (at - wanted)
    return states


def rotational_states_along(trajectory: Trajectory, count: int, time_step: float) -> np.ndarray:
    """Rotational states phi, p, theta, q, psi, r (count, 6) [rad, rad/s], one an inner step, of a flight along it."""
    hold = max(1, round(OUTER_STEP / time_step))
    angles = attitudes_along(trajectory, -(-count // hold))
    return approached(angles, count, hold, time_step, RESPONSE_TIME)
