"""Computes the attitudes that a flight along a trajectory needs, the references of the rotational subsystem.

Between two outer steps the velocity has to change by v[k+1] - v[k], so the thrust has to give the mean acceleration
a = (v[k+1] - v[k]) / T beside the weight. With z downwards

    U1 / m = |a - g e_z|,   ux = a_x / (U1 / m),   uy = a_y / (U1 / m),

and eq. (2) of Cao, Lai and Alam (2017), inverted, makes roll and pitch of that direction, at a yaw of zero. The inner
loop approaches each at first order, (angle_d - angle) / response time, as ``gpmpc.simulation.Cascade`` asks it to.
"""

import numpy as np

from gpmpc.exceptions import SettingError
from gpmpc.trajectories import Trajectory

GRAVITY = 9.81  # [m/s^2]
ATTITUDES = ("paper", "exact")  # how thrust direction becomes attitude
OUTER_STEP = 1.0  # [s] for which an attitude is asked for
RESPONSE_TIME = 0.1  # [s]


def attitudes_along(trajectory: Trajectory, count: int, outer_step: float = OUTER_STEP) -> np.ndarray:
    """Roll and pitch (count, 2) [rad], one an outer step, that point the thrust where the trajectory needs it."""
    velocities = trajectory.velocity(outer_step * np.arange(count + 1))
    force = np.diff(velocities, axis=0) / outer_step - [0.0, 0.0, GRAVITY]  # over the mass [m/s^2]
    direction = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)  # of a free fall: none
    return attitude_for_thrust_direction(direction[:, 0], direction[:, 1])


def approach_attitudes(angles: np.ndarray, count: int, hold: int, time_step: float, response_time: float) -> np.ndarray:
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
    return approach_attitudes(angles, count, hold, time_step, RESPONSE_TIME)


def attitude_for_thrust_direction(ux: np.ndarray, uy: np.ndarray, convention: str = "exact") -> np.ndarray:
    """Roll and pitch that point the thrust along (ux, uy) at psi = 0; Cao, Lai and Alam (2017), eq. (2) inverted.

    ux = cos(phi) sin(theta) and uy = -sin(phi) give phi = -asin(uy) and theta = asin(ux / cos(phi)). The authors' data
    hold theta = sign(phi) asin(ux) instead. Arguments outside [-1, 1] saturate.

    Args:
        ux: Thrust direction along x, any shape [-].
        uy: Thrust direction along y, same shape [-].
        convention: ``"exact"``, or ``"paper"`` for the authors' formula.

    Returns:
        Roll and pitch [rad], stacked along a new last axis of length 2.

    Raises:
        SettingError: The convention is neither of the two.
    """
    phi = -np.arcsin(np.clip(uy, -1, 1))
    if convention == "paper":
        theta = np.sign(phi) * np.arcsin(np.clip(ux, -1, 1))
    elif convention == "exact":
        horizontal = np.cos(phi)
        ratio = np.divide(ux, horizontal, out=np.zeros_like(horizontal), where=horizontal > 1e-12)
        theta = np.arcsin(np.clip(ratio, -1, 1))
    else:
        raise SettingError("attitude", f"must be 'paper' or 'exact'; got {convention!r}")
    return np.stack([phi, theta], axis=-1)
