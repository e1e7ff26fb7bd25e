"""RotorPy's Hummingbird, compiled.

Its equations with its parameters (Folk, Paulos and Kumar, 2023).

RotorPy computes derivatives in Python and calls ``scipy.integrate.solve_ivp`` for every
step of 0.01 s, which takes a millisecond. Here the motors' commands of its velocity
controller and the derivatives are compiled, and a step is four of the classical
Runge-Kutta method of fourth order, each half the motors' time constant long; that takes
a fortieth. ``compiled_hummingbird`` compares both with RotorPy's own at random states
before anything flies.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit

Array = np.ndarray
STEP = 0.01
SUBSTEPS = 4
GRAVITY = 9.81
HOVER = np.array(
    [0, 0, 1.0] + [0.0] * 3 + [0, 0, 0, 1.0] + [0.0] * 10
)  # without the rotors' speeds


class Parameters(NamedTuple):
    """Of the vehicle, in RotorPy's words and SI units."""

    mass: float
    inertia: Array  # (3, 3)
    inverse: Array  # of the inertia
    drag: Array  # of the body, diagonal (3,)
    rotor_drag: Array  # diagonal (3,)
    arms: Array  # positions of the rotors (4, 3)
    directions: Array  # in which they turn (4,)
    coefficients: tuple[float, float, float]  # k_eta, k_m, k_h
    allocation: Array  # thrust and torques to the rotors' thrusts (4, 4)
    gains: tuple[float, float, float]  # k_v, kp_att, kd_att
    speeds: tuple[float, float]  # the least and the greatest [rad/s]
    motor: float  # time constant [s]


@njit(cache=True)
def _rotation(q):
    x, y, z, w = q / math.sqrt((q * q).sum())
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@njit(cache=True)
def commanded_speeds(s, velocity, p):
    """Returns the speeds (4,) that the velocity controller commands, unlimited."""
    (k_v, k_p, k_d), v, w = p.gains, s[3:6], s[10:13]
    R = _rotation(s[6:10])
    force = p.mass * (-k_v * (v - velocity) + np.array([0.0, 0.0, GRAVITY]))
    b3 = force / math.sqrt((force * force).sum())
    b2 = np.cross(b3, np.array([1.0, 0.0, 0.0]))
    b2 /= math.sqrt((b2 * b2).sum())
    attitude = np.stack((np.cross(b2, b3), b2, b3))  # in its rows
    S = 0.5 * (attitude @ R - R.T @ attitude.T)
    error = np.array([-S[1, 2], S[0, 2], -S[0, 1]])
    torque = p.inertia @ (-k_p * error - k_d * w) + np.cross(w, p.inertia @ w)
    squares = (
        p.allocation
        @ np.array([(force * R[:, 2]).sum(), torque[0], torque[1], torque[2]])
        / p.coefficients[0]
    )
    return np.sign(squares) * np.sqrt(np.abs(squares))


@njit(cache=True)
def derivative(s, commands, p):
    """Returns the parts of a state (20,).

    Position, velocity, quaternion, rates, wind and the rotors' speeds.
    """
    v, (x, y, z, c), w, wind, speeds = s[3:6], s[6:10], s[10:13], s[13:16], s[16:]
    k_eta, k_m, k_h = p.coefficients
    R = _rotation(s[6:10])
    air = R.T @ (v - wind)
    force = -math.sqrt((air * air).sum()) * p.drag * air
    torque = np.zeros(3)
    for r in range(4):
        local = air + np.cross(w, p.arms[r])
        f = -speeds[r] * p.rotor_drag * local
        f[2] += k_eta * speeds[r] ** 2 + k_h * (local[0] ** 2 + local[1] ** 2)
        force += f
        torque += np.cross(p.arms[r], f)
        torque[2] += p.directions[r] * k_m * speeds[r] ** 2
    ds = np.zeros(20)
    ds[:3] = v
    ds[3:6] = R @ force / p.mass
    ds[5] -= GRAVITY
    ds[6] = 0.5 * (c * w[0] - z * w[1] + y * w[2])
    ds[7] = 0.5 * (z * w[0] + c * w[1] - x * w[2])
    ds[8] = 0.5 * (-y * w[0] + x * w[1] + c * w[2])
    ds[9] = -0.5 * (x * w[0] + y * w[1] + z * w[2])
    ds[10:13] = p.inverse @ (torque - np.cross(w, p.inertia @ w))
    ds[16:] = (commands - speeds) / p.motor
    return ds


@njit(cache=True)
def advance(s, velocity, wind, p, steps):
    """Moves a state (20,) on by steps of 0.01 s, in a constant wind."""
    s = s.copy()
    h = STEP / SUBSTEPS
    s[13:16] = wind
    for _ in range(steps):
        commands = np.minimum(
            np.maximum(commanded_speeds(s, velocity, p), p.speeds[0]), p.speeds[1]
        )
        for _ in range(SUBSTEPS):
            k1 = derivative(s, commands, p)
            k2 = derivative(s + 0.5 * h * k1, commands, p)
            k3 = derivative(s + 0.5 * h * k2, commands, p)
            k4 = derivative(s + h * k3, commands, p)
            s += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        s[6:10] /= math.sqrt((s[6:10] ** 2).sum())
        s[16:] = np.minimum(np.maximum(s[16:], p.speeds[0]), p.speeds[1])
    return s


def compiled_hummingbird() -> tuple[Array, Callable[[Array, Array, Array, int], Array]]:
    """Returns a state that hovers (20,), and the function that moves one on.

    Raises:
        RuntimeError: These are not the equations of the RotorPy that is installed.
    """
    from rotorpy.vehicles.hummingbird_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    theirs: Any = Multirotor(quad_params, control_abstraction="cmd_vel")
    p = Parameters(
        theirs.mass,
        theirs.inertia,
        theirs.inv_inertia,
        np.diag(theirs.drag_matrix).copy(),
        np.diag(theirs.rotor_drag_matrix).copy(),
        np.ascontiguousarray(theirs.rotor_geometry),
        theirs.rotor_dir.astype(float),
        (theirs.k_eta, theirs.k_m, theirs.k_h),
        np.ascontiguousarray(theirs.TM_to_f),
        (float(theirs.k_v), float(theirs.kp_att), float(theirs.kd_att)),
        (float(theirs.rotor_speed_min), float(theirs.rotor_speed_max)),
        theirs.tau_m,
    )
    hover = HOVER.copy()
    rng = np.random.default_rng(0)
    hover[16:] = math.sqrt(p.mass * GRAVITY / (4 * theirs.k_eta))
    for _ in range(20):
        s = hover + rng.normal(0, 1, 20) * np.repeat(
            [1.0, 0.2, 1.0, 2.0, 100.0], [6, 4, 3, 3, 4]
        )
        s[6:10] /= np.linalg.norm(s[6:10])
        velocity = rng.normal(0, 1, 3)
        commands = rng.uniform(300, 900, 4)
        their_speeds = theirs.get_cmd_motor_speeds(
            Multirotor._unpack_state(s), {"cmd_v": velocity}
        )
        pairs = (
            (commanded_speeds(s, velocity, p), their_speeds),
            (derivative(s, commands, p), theirs._s_dot_fn(0, s, commands)),
        )
        if any(
            np.abs(one - other).max() > 1e-9 * np.abs(other).max()
            for one, other in pairs
        ):
            raise RuntimeError(
                "the equations of the installed RotorPy are others than those of "
                "benchmarks/hummingbird"
            )
    return hover, lambda s, velocity, wind, steps: advance(s, velocity, wind, p, steps)
