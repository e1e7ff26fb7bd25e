"""A quadrotor in MuJoCo on the paper's two paths.

What its flights teach, beside NMPC on the rigid body fitted to them.

    .venv/bin/python -m benchmarks.mujoco_quadrotor [--seeds 20]

The vehicle of ``system=mujoco_quadrotor``: rotors that lag by 25 ms, drag, measurements
with noise, 25 Hz. A seed is one vehicle's history: three dithered flights of 8 s with
the data sheet's rigid body, along random curves. To their 597 steps a rigid body is
fitted (mass and three moments of inertia, least squares), and GPs on 200 of them learn
what it misses. Both are flown for 12 s along the ellipse and the Lorenz path, which
begin at rest, and again with a fifth more mass in a wind of 4 m/s. NMPC is solved to a
KKT point of 1e-6 at every step, without an estimate of disturbances: the nominal
controller. The rigid body with ``disturbance_gain=0.3``, and the learned model with it,
are flown by one quadratic program a step. The flights of a seed are a line of
``outputs/benchmarks/mujoco_quadrotor.jsonl``, where a run of the same code goes on.
"""

import argparse
from dataclasses import replace

import numpy as np
import pandas
import torch
from scipy.optimize import least_squares

from benchmarks.timing import RESULTS, describe, machine, own_source
from gpmpc.gp import Trainer, Transitions, standardize
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import CasadiFunction, KnownModel, ResidualModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise, Rollout, closed_loop
from gpmpc.studies.study import TrialStore, fingerprint, one_thread
from gpmpc.systems import System, step_many
from gpmpc.systems.mujoco_quadrotor import RigidBody, mujoco_quadrotor
from gpmpc.trajectories import Elliptical, Lorenz

PATHS = {"ellipse": Elliptical(climb_rate=0.25), "Lorenz": Lorenz()}
VEHICLES = {
    "as learned": {},
    "0.1 kg more, wind of 4 m/s": {"mass": 0.6, "wind": (4.0, 0.0, 0.0)},
}
CONTROLLERS = (
    ("NMPC", "fitted", 0.0),
    ("body, estimate", "fitted", 0.3),
    ("learned", "learned", 0.3),
)
# stages, [-], [s], [s]
HORIZON = 20
STEPS = 300
STEP = 0.04
RAMP = 2.0
MEASURED = (
    np.tile([0.003, 0.01], 3).tolist() + np.tile([0.002, 0.02], 3).tolist()
)  # [m, m/s], [rad, rad/s]
HOVER = [0.5 * 9.81 / 4] * 4  # [N]
MOVED = [1, 3, 5, 7, 9, 11]  # velocities and rates, which forces and moments act on
PROBLEM = Problem(
    Tracking([10, 1, 10, 1, 10, 1, 0.3, 0.3, 0.3, 0.3, 1, 0.3], [5.0] * 4),
    Box([0.0] * 4, [3.0] * 4),
)
Array = np.ndarray


def reference(positions: Array) -> Array:
    """States (K, 12) of positions (K, 3) [m] that begin at the vehicle's own."""
    states = np.zeros((len(positions), 12))
    states[:, 0:6:2] = positions - positions[0] + [0.0, 0.0, 1.0]
    states[:, 1:6:2] = np.gradient(states[:, 0:6:2], STEP, axis=0)
    return states


def along(path: str) -> Array:
    """States of a path that is entered from rest within two seconds."""
    t = STEP * np.arange(STEPS + HORIZON + 1)
    return reference(PATHS[path](np.where(t < RAMP, t**2 / (2 * RAMP), t - RAMP / 2)))


def excitation(rng: np.random.Generator) -> Array:
    """States of a sum of sines, 8 s long."""
    t = STEP * np.arange(200 + HORIZON + 1)[:, None]
    return reference(
        np.minimum(t / RAMP, 1) * [2.0, 2.0, 0.8] * np.sin(rng.uniform(0.6, 2.0, 3) * t)
    )


def known(body: System) -> KnownModel:
    """The model of a rigid body."""
    return KnownModel(CasadiFunction(successor_function(body)), 12, 4)


def fly(
    vehicle: System,
    model,
    states: Array,
    seed: int,
    gain: float = 0.0,
    dither: float = 0.0,
) -> Rollout:
    """Flies once.

    A rigid body with neither estimate nor dither is flown by NMPC, else by one program
    a step.
    """
    is_rigid_body = isinstance(model, KnownModel)
    solved = gain == dither == 0.0
    settings = PredictionSettings(
        covariance="none" if is_rigid_body else "zero_order", disturbance_gain=gain
    )
    controller = GPMPC(
        model,
        Linearization(),
        PROBLEM,
        HORIZON,
        HOVER,
        settings,
        iterations=30 if solved else 1,
    )
    noise = Noise(measurement=MEASURED, input=[dither] * 4)
    steps = len(states) - HORIZON - 1
    return closed_loop(
        vehicle,
        controller,
        Reference(states),
        None,
        steps,
        noise=noise,
        on_failure="previous_plan",
        seed=seed,
    )


def learn(seed: int) -> tuple[System, ResidualModel]:
    """The rigid body that is fitted to three flights, and the GPs on what it misses."""
    rng = np.random.default_rng(seed)
    vehicle = mujoco_quadrotor()
    rows = []
    for k in range(3):
        flown = fly(
            vehicle, known(vehicle.nominal), excitation(rng), 100 * seed + k, dither=0.1
        )
        rows.append((flown.measured[:-1], flown.inputs[:-1], flown.measured[1:]))
    x, u, after = (np.concatenate(part) for part in zip(*rows, strict=True))

    def body(numbers: Array) -> System:
        return replace(
            vehicle.nominal, dynamics=RigidBody(numbers[0], tuple(numbers[1:]))
        )

    def missed(logarithms: Array) -> Array:
        error = step_many(body(np.exp(logarithms)), x, u) - after
        return (error / MEASURED)[:, MOVED].ravel()

    start = np.log([0.4, 0.0025, 0.0025, 0.0045])
    fitted = body(np.exp(least_squares(missed, start, loss="soft_l1").x))
    chosen = np.sort(rng.permutation(len(x))[:200])
    B = torch.eye(12, dtype=torch.float64)[:, MOVED]
    trainer = Trainer(predicts="difference", scaling=standardize, restarts=0)
    seen_states = [1, 3, 5, 6, 7, 8, 9, 10, 11]
    data = Transitions(x[chosen], u[chosen], after[chosen])
    return fitted, ResidualModel.train(
        known(fitted).function, data, B, seen_states, trainer=trainer, seed=seed
    )


def flights(seed: int) -> list[dict]:
    """All flights of one seed, as plain data."""
    fitted, learned = learn(seed)
    rows = []
    for name, changed in VEHICLES.items():
        for path in PATHS:
            for controller, model, gain in CONTROLLERS:
                model = known(fitted) if model == "fitted" else learned
                flown = fly(mujoco_quadrotor(**changed), model, along(path), seed, gain)
                errors = (flown.states - flown.references)[:, 0:6:2]
                milliseconds = 1e3 * flown.seconds
                rows.append(
                    {
                        "seed": seed,
                        "vehicle": name,
                        "path": path,
                        "controller": controller,
                        "rmse": float(np.sqrt((errors**2).sum(axis=1).mean())),
                        "median_ms": float(np.median(milliseconds)),
                        "p99_ms": float(np.quantile(milliseconds, 0.99)),
                        "failures": len(flown.failures),
                        "mass": fitted.dynamics.mass,
                    }
                )
    return rows


def summary(rows: list[dict]) -> str:
    """A line for each vehicle and path.

    Errors [m], their ratio (median, worst seed) and times [ms].
    """
    table = pandas.DataFrame(rows)
    table["failures"] = table.groupby(["vehicle", "path"])["failures"].transform("sum")
    wide = table.pivot(
        index=["vehicle", "path", "seed", "failures"],
        columns="controller",
        values="rmse",
    ).reset_index()
    wide["ratio"] = wide["learned"] / wide["NMPC"]
    lines = wide.groupby(["vehicle", "path"]).agg(
        seeds=("seed", "count"),
        nominal=("NMPC", "median"),
        estimate=("body, estimate", "median"),
        learned=("learned", "median"),
        ratio=("ratio", "median"),
        worst=("ratio", "max"),
        failures=("failures", "first"),
    )
    times = table.groupby("controller")[["median_ms", "p99_ms"]].median()
    return f"{lines.round(4).to_string()}\n\n{times.round(2).to_string()}"


def main() -> None:
    """Flies what is missing, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    store = TrialStore(RESULTS / "mujoco_quadrotor.jsonl")
    rows = []
    for seed in range(arguments.seeds):
        name = fingerprint([own_source(__file__), seed])
        if name not in store.records:
            with one_thread():
                store.append(name, {"flights": flights(seed)})
            print(f"seed {seed} done", flush=True)
        rows += store.records[name]["flights"]
    print(f"{describe(machine())}\n\n{summary(rows)}")


if __name__ == "__main__":
    main()
