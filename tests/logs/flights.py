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
