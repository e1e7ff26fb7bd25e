"""A log of one's own becomes a model, judged on a flight that it never saw.

Run as `python examples/own_log.py FOLDER` (the present folder by default). Three
simulated flights of a quadrotor at 100 Hz stand for the log: motors that a controller
drives, gaps of 0.3 s, time stamps that jitter, samples of the position that repeat, and
half a second on the ground. It writes flight_1.csv to flight_3.csv and own_log.png.
"""

import sys
from pathlib import Path

import numpy as np
import pandas
from scipy.spatial.transform import Rotation

from gpmpc.logs import judge, learn, read_log
from gpmpc.plotting import judgement_figure

# [s], [m/s2] of all motors at full signal, [1/s]
STEP = 0.01
THRUST = 20.0
DRAG = 0.3
MIXER = (
    np.array([[1, 1, -1], [1, -1, 1], [-1, -1, -1], [-1, 1, 1]]) / 4
)  # motors' u^2 by roll, pitch, yaw
TORQUE = np.array([120.0, 120.0, 40.0])  # [rad/s2] by that mixture
# [m/s2], [rad/s2], white at every step
FORCE_NOISE = 0.6
TORQUE_NOISE = 6.0
NAMES = [
    "t",
    "px",
    "py",
    "pz",
    "qx",
    "qy",
    "qz",
    "qw",
    "vx",
    "vy",
    "vz",
    "wx",
    "wy",
    "wz",
    "m1",
    "m2",
    "m3",
    "m4",
]
MAPPING = {
    "time": "t",
    "max_gap": 0.015,
    "model": "rigid_body",
    "states": {
        "position": {"columns": NAMES[1:4], "unit": "m"},
        "attitude": {"columns": NAMES[4:8], "kind": "quaternion", "order": "xyzw"},
        "velocity": {"columns": NAMES[8:11], "unit": "m/s", "frame": "world"},
        "rate": {"columns": NAMES[11:14], "unit": "rad/s", "frame": "body"},
    },
    "inputs": {"motors": {"columns": NAMES[14:]}},
}


def simulate_flights(flights: int, rows: int, seed: int = 0) -> list[pandas.DataFrame]:
    """Flies a quadrotor along sums of sines under white force and torque noise."""
    rng = np.random.default_rng(seed)
    p, v, w = (np.zeros((flights, 3)) for _ in range(3))
    attitude = Rotation.identity(flights)
    frequencies = rng.uniform(0.5, 2.0, (2, flights, 3))
    phases = rng.uniform(0, 6, (2, flights, 3))
    tables = np.empty((flights, rows, len(NAMES)))
    for k in range(rows):
        target = 0.7 * np.sin(frequencies * k * STEP + phases).sum(axis=0)
        force = 2.0 * (target - p) - 2.5 * v + [0, 0, 9.81]
        up = attitude.inv().apply(force / np.linalg.norm(force, axis=1, keepdims=True))
        rates = 6 * np.column_stack([-up[:, 1], up[:, 0], np.zeros(flights)])
        moment = (
            12 * (rates - w) + rng.normal(0, 8, (flights, 3))
        ) / TORQUE  # the noise makes the motors informative
        collective = np.clip(
            np.linalg.norm(force, axis=1, keepdims=True) / THRUST, 0.1, 0.9
        )
        motors = np.sqrt(np.clip(collective + moment @ MIXER.T, 0.01, 1))
        tables[:, k] = np.column_stack(
            [np.full(flights, k * STEP), p, attitude.as_quat(), v, w, motors]
        )
        body_force = np.column_stack(
            [np.zeros((flights, 2)), THRUST * (motors**2).mean(axis=1)]
        )
        body_force += rng.normal(
            0, FORCE_NOISE, (flights, 3)
        ) - DRAG * attitude.inv().apply(v)
        torque = motors**2 @ MIXER * 4 * TORQUE / 4 + rng.normal(
            0, TORQUE_NOISE, (flights, 3)
        )
        for _ in range(4):
            w = w + STEP / 4 * torque
            attitude = attitude * Rotation.from_rotvec(STEP / 4 * w)
            v = v + STEP / 4 * (attitude.apply(body_force) - [0, 0, 9.81])
            p = p + STEP / 4 * v
    return [pandas.DataFrame(table, columns=NAMES) for table in tables]


def spoil(table: pandas.DataFrame, rng: np.random.Generator) -> pandas.DataFrame:
    """Makes a log of a flight.

    Missing rows, stamps that jitter, samples that repeat, a start on the ground.
    """
    table = table.assign(t=table["t"] + rng.uniform(-5e-4, 5e-4, len(table)) + 5)
    for row in rng.choice(len(table) - 100, 8, replace=False):
        table.loc[row + 1, ["px", "py", "pz"]] = table.loc[
            row, ["px", "py", "pz"]
        ].to_numpy(dtype=float)
    for row in np.arange(400, len(table), 700):
        table = table.drop(index=range(row, row + 30))
    ground = pandas.DataFrame(0.0, index=range(50), columns=NAMES).assign(
        t=4.4 + STEP * np.arange(50), qw=1.0
    )
    return pandas.concat([ground, table])


def main(folder: Path) -> None:
    """Writes the log, learns from two flights and judges on the third."""
    for number, flight in enumerate(simulate_flights(3, 1500), start=1):
        spoil(flight, np.random.default_rng(number)).to_csv(
            folder / f"flight_{number}.csv", index=False
        )

    # With a log of one's own it starts here.
    log = read_log(sorted(folder.glob("flight_*.csv")), MAPPING)
    print(log)
    for finding in log.findings:
        print(f"  {finding.run}: {finding.kind}: {finding.text}")
    train, held_out = log.split(["flight_3"])
    learned = learn(train, points=60)
    judgement = judge(learned, held_out, train)
    print(next(candidate.name for candidate in learned.candidates if candidate.chosen))
    for name, value, error in learned.fit.to_rows()[:3]:
        print(f"  {name} {value:.3f} +- {error:.3f}")
    print(
        judgement.to_pandas()
        .query("predictor == 'model'")
        .round(4)
        .to_string(index=False)
    )

    figure = judgement_figure(judgement)
    figure.savefig(folder / "own_log.png", dpi=150)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
