"""Flights of a multirotor as tables of a log, with noise like that of real ones."""

from dataclasses import dataclass, replace

import numpy as np
import pandas
from scipy.spatial.transform import Rotation

GRAVITY = 9.80665
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD = np.diag([1.0, -1.0, -1.0])
MAPPING = {
    "time": "t",
    "model": "rigid_body",
    "states": {
        "position": {"columns": ["px", "py", "pz"], "unit": "m"},
        "attitude": {
            "columns": ["qx", "qy", "qz", "qw"],
            "kind": "quaternion",
            "order": "xyzw",
        },
        "velocity": {"columns": ["vx", "vy", "vz"], "unit": "m/s", "frame": "world"},
        "rate": {"columns": ["wx", "wy", "wz"], "unit": "rad/s", "frame": "body"},
    },
    "inputs": {"thrust": ["u"]},
}


@dataclass(frozen=True)
class Flight:
    """Measured states of K rows in ENU and FLU axes."""

    t: np.ndarray  # [s] (K,)
    p: np.ndarray  # [m] (K, 3)
    q: np.ndarray  # x, y, z, w, body to world (K, 4)
    v: np.ndarray  # [m/s], world (K, 3)
    w: np.ndarray  # [rad/s], body (K, 3)

    def change(self, **arrays):
        return replace(self, **arrays)

    @property
    def attitude(self):
        return Rotation.from_quat(self.q)

    def to_pandas(self):
        columns = np.column_stack([self.t, self.p, self.q, self.v, self.w])
        names = "t px py pz qx qy qz qw vx vy vz wx wy wz".split()  # noqa: SIM905
        table = pandas.DataFrame(columns, columns=names)
        return table.assign(u=np.sin(9 * self.t))


def fly(
    seconds=24.0,
    rate=100.0,
    seed=0,
    size=1.0,
    turning=0.6,
    heading=0.4,
    noise=1.0,
    offset=0.0,
):
    """A flight along sums of sines; the thrust points along the body's z.

    ``size`` [m] of the curve, ``turning`` [rad] of the heading, ``heading`` [rad/s] of
    a steady turn, ``noise`` over that of a motion capture, ``offset`` of the rates
    [rad/s].
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / rate)
    p = np.zeros((len(t), 3))
    v = np.zeros((len(t), 3))
    a = np.zeros((len(t), 3))
    for axis in range(3):
        for frequency in rng.uniform(0.8, 3.0, 4):
            phase = rng.uniform(0, 2 * np.pi)
            high = size * rng.uniform(0.3, 0.7) / frequency * (0.6 if axis == 2 else 1)
            angle = frequency * t + phase
            p[:, axis] += high * np.sin(angle)
            v[:, axis] += high * frequency * np.cos(angle)
            a[:, axis] -= high * frequency**2 * np.sin(angle)
    yaw = heading * t + turning * np.sin(0.9 * t + 1)
    # Drag pulls the body back, so that its axis z is not quite that of a + g.
    up = a + 0.2 * v + [0, 0, GRAVITY]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(t))])
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    axes = np.stack([np.cross(left, up), left, up], axis=2)
    attitude = Rotation.from_matrix(axes)
    turn = (attitude[:-2].inv() * attitude[2:]).as_rotvec() * rate / 2
    w = np.vstack([turn[:1], turn, turn[-1:]])
    shake = Rotation.from_rotvec(noise * 0.002 * rng.normal(size=(len(t), 3)))
    return Flight(
        t=t,
        p=p + [0, 0, 2.0] + noise * 5e-4 * rng.normal(size=p.shape),
        q=(attitude * shake).as_quat(),
        v=v + noise * 0.01 * rng.normal(size=p.shape),
        w=w + offset + noise * 0.08 * rng.normal(size=p.shape),
    )


def late(values, rows):
    """Values that come some rows late."""
    return np.concatenate([np.repeat(values[:1], rows, axis=0), values[:-rows]])


def measure(t, p, attitude, seed=0, noise=1.0):
    """What a motion capture measures of a motion: positions (K, 3) and attitudes."""
    rng = np.random.default_rng(seed)
    step = t[1] - t[0]
    turn = (attitude[:-2].inv() * attitude[2:]).as_rotvec() / (2 * step)
    shake = Rotation.from_rotvec(noise * 0.002 * rng.normal(size=p.shape))
    return Flight(
        t=t,
        p=p + noise * 5e-4 * rng.normal(size=p.shape),
        q=(attitude * shake).as_quat(),
        v=np.gradient(p, step, axis=0) + noise * 0.01 * rng.normal(size=p.shape),
        w=np.vstack([turn[:1], turn, turn[-1:]])
        + noise * 0.08 * rng.normal(size=p.shape),
    )


def drive(seconds=30.0, seed=0):
    """A car on a hilly road: nothing carries it to where it tilts, and it leans out."""
    t = np.arange(0, seconds, 0.01)
    heading = 0.8 * np.sin(0.5 * t) + 0.2 * t
    speed = 6 + 2 * np.sin(0.7 * t)
    v = speed[:, None] * np.column_stack(
        [np.cos(heading), np.sin(heading), 0.1 * np.sin(0.9 * t)]
    )
    p = np.cumsum(v, axis=0) * 0.01
    roll = 0.01 * speed * np.gradient(heading, 0.01)
    pitch = -0.1 * np.sin(0.9 * t) - 0.01 * np.gradient(speed, 0.01)
    angles = np.column_stack([heading, pitch, roll])
    return measure(t, p, Rotation.from_euler("ZYX", angles), seed)


def soar(seconds=60.0, seed=0):
    """An aeroplane that banks in its turns and pitches up to climb."""
    t = np.arange(0, seconds, 0.02)
    turning = 0.5 * np.sin(0.3 * t) + 0.2
    heading = np.cumsum(turning) * 0.02
    climb = 0.15 * np.sin(0.5 * t)
    v = 14 * np.column_stack(
        [
            np.cos(heading) * np.cos(climb),
            np.sin(heading) * np.cos(climb),
            np.sin(climb),
        ]
    )
    bank = -np.arctan(14 * turning / GRAVITY)
    angles = np.column_stack([heading, -climb - 0.06, bank])
    return measure(t, np.cumsum(v, axis=0) * 0.02, Rotation.from_euler("ZYX", angles))


def tumble(seconds=20.0, seed=0):
    """A body that is thrown, or carried by hand, and turns about every axis."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 0.01)
    attitude = Rotation.identity()
    turns = []
    phases = rng.uniform(0, 6, 3)
    for moment in t:
        turns.append(attitude)
        rate = 2.5 * np.sin(np.array([0.7, 1.1, 0.9]) * moment + phases)
        attitude = attitude * Rotation.from_rotvec(0.01 * rate)
    p = np.column_stack([np.sin(1.3 * t), np.cos(1.7 * t + 1), np.sin(2.1 * t + 2)])
    return measure(t, p, Rotation.concatenate(turns), seed)


def loop(seconds=20.0, seed=0):
    """A multirotor that flies loops, half of the time on its back."""
    t = np.arange(0, seconds, 0.01)
    angle = 4.0 * t + 0.8 * np.sin(t)
    p = np.column_stack(
        [1.5 * np.sin(angle), 0.4 * np.sin(1.3 * t), -1.5 * np.cos(angle)]
    )
    a = np.gradient(np.gradient(p, 0.01, axis=0), 0.01, axis=0)
    up = a + np.array([0, 0, GRAVITY])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = np.cross(up, np.cross([0.0, 1.0, 0.0], up))
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    axes = np.stack([np.cross(left, up), left, up], axis=2)
    return measure(t, p, Rotation.from_matrix(axes), seed)


def sail(seconds=60.0, seed=0):
    """A boat in waves, which rolls on its own."""
    t = np.arange(0, seconds, 0.05)
    heading = 0.1 * t
    roll = 0.2 * np.sin(1.1 * t) + 0.05 * np.sin(2.3 * t)
    pitch = 0.1 * np.sin(1.4 * t + 1)
    p = np.column_stack(
        [20 * np.sin(heading), 20 * np.cos(heading), 0.4 * np.sin(1.4 * t)]
    )
    angles = np.column_stack([heading, pitch, roll])
    return measure(t, p, Rotation.from_euler("ZYX", angles), seed, noise=4)
