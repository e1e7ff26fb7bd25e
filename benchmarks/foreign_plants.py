"""Flies plants of other packages at a bound, and counts how often it is violated.

    pip install pcgym rotorpy crazyflow
    .venv/bin/python -m benchmarks.foreign_plants [--plants ...] [--steps 300]
    [--seeds 5]

Nothing of these plants is known here: each is stepped by its own package, learned from
400 of its rows by ``gpmpc.models.train``, and sent to a set point beyond a bound of one
of its states. A plant whose package is missing is left out, and a line says so.

- pc-gym's stirred tank with an exothermic reaction (Bloor et al., 2024): the
  temperature is bounded; that of the feed changes at random, which is a disturbance of
  pc-gym's own;
- RotorPy's Crazyflie (Folk, Paulos and Kumar, 2023) with RotorPy's velocity controller,
  aerodynamics and motors: it climbs at a bounded speed, in a wind that changes as an
  AR(1) process. Attitude, rotors and wind are not among the states, which are three
  velocities;
- crazyflow's Crazyflie with brushless motors, its attitude controller and rotors, by
  pitch [rad] and thrust (of its weight) at 5 Hz, while random forces act on it: it
  climbs at a bounded speed. The rotors are not among the states; the pitch enters as
  sine and cosine. It wants ``SCIPY_ARRAY_API=1`` in the environment.

A decision counts where its plan touches the bound one step ahead, and is violated where
the plant then is beyond it. Printed for 10 and 5 % allowed, with the noise that the GP
has learned and with an adaptive conformal tube: violations of decisions, their rate
with its exact 95 % interval (Clopper and Pearson, 1934; for independent decisions), and
the mean distance to the bound.
"""

import argparse
import math
from collections.abc import Callable
from importlib.util import find_spec
from statistics import NormalDist
from typing import Any

import numpy as np
import torch

from benchmarks.chance_constraints import Flights, Plant, climbing, fly, logged
from gpmpc.gp import Transitions, standardize
from gpmpc.metrics import binomial_interval
from gpmpc.models import train
from gpmpc.systems import System

ROWS = 400
ALLOWED = (0.10, 0.05)
WAYS = ("learned noise", "adaptive tube")
FEED = 3.0  # standard deviation of the feed's temperature [K]
GUST = 0.02  # standard deviation of the force on crazyflow's drone [N]
Array = np.ndarray
Flown = tuple[Plant, System]  # what is flown, and what is said of it


class Described:
    """Dynamics that are another package's: their names alone."""

    def __init__(self, state_names: tuple[str, ...], input_names: tuple[str, ...]):
        self.state_names = state_names
        self.input_names = input_names

    def successor(self, x: Any, u: Any) -> Any:
        """Stays where it is; nothing here is stepped."""
        return [x[i] for i in range(len(self.state_names))]


def _reactor() -> Any:
    """Returns pc-gym's environment, for as many steps as all flights take."""
    import casadi
    from pcgym import make_env

    # pc-gym integrates by CasADi, whose note on NumPy is the same at every call.
    casadi.GlobalOptions.setNumpyMode(-1)
    steps = 10_000
    return make_env(
        {
            "model": "cstr",
            "N": steps,
            "tsim": 0.1 * steps,
            "x0": np.array([0.88, 324.0, 0.8]),
            "SP": {"Ca": [0.8] * steps},
            "a_space": {"low": np.array([290.0]), "high": np.array([310.0])},
            "o_space": {
                "low": np.array([0.0, 290.0, 0.0]),
                "high": np.array([1.0, 390.0, 1.0]),
            },
            "normalise_a": True,
            "normalise_o": False,
            "disturbances": {"Ti": np.full(steps + 2, 350.0)},
            "disturbance_bounds": {
                "low": np.array([330.0]),
                "high": np.array([370.0]),
            },
        }
    )


def stirred_tank() -> Flown:
    """pc-gym's tank: concentration [mol/L] and temperature [K], by its coolant."""
    reactor = _reactor()

    def begin() -> Array:
        return reactor.reset()[0][:2].copy()

    def successor(_: Array, u: Array, feed: Array) -> Array:
        reactor.disturbances["Ti"][reactor.t + 1] = 350.0 + feed[0]
        return reactor.step(np.array(u))[0][:2].copy()

    def feeds(count: int, rng: np.random.Generator) -> Array:
        return rng.normal(0.0, FEED, (count, 1))

    plant = Plant(
        successor=successor,
        disturbances=feeds,
        begin=begin,
        log=lambda: _log(successor, begin, feeds, lower=[-1.0], upper=[0.5]),
        goal=[0.8, 336.0],
        bound=(1, 328.0),
        weights=([10.0, 0.1], [0.1]),
        limits=[1.0],
    )
    names = Described(
        state_names=("concentration", "temperature"),
        input_names=("coolant",),
    )
    return plant, System(names, time_step=0.1)


def rotorpy_crazyflie() -> Flown:
    """RotorPy's Crazyflie by velocity commands at 5 Hz."""
    from rotorpy.vehicles.crazyflie_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    drone = Multirotor(quad_params, control_abstraction="cmd_vel")
    state: dict[str, Array] = {}

    def begin() -> Array:
        state.update({key: np.array(v) for key, v in drone.initial_state.items()})
        state["x"] = np.array([0.0, 0.0, 10.0])
        return np.array(state["v"], dtype=float)

    def move(command: Array, wind: Array) -> Array:
        for _ in range(10):
            state["wind"] = wind
            state.update(drone.step(state, {"cmd_v": np.array(command)}, 0.02))
        return np.array(state["v"])

    names = Described(
        state_names=("vx", "vy", "vz"),
        input_names=("cx", "cy", "cz"),
    )
    return climbing(begin, move), System(names, time_step=0.2)


def crazyflow_crazyflie() -> Flown:
    """A drone of crazyflow in a vertical plane, by pitch and thrust at 5 Hz."""
    from crazyflow.control import Control
    from crazyflow.sim import Sim
    from scipy.spatial.transform import Rotation

    sim: Any = Sim(control=Control.attitude)
    sim.reset()
    weight = 9.81 * float(np.ravel(sim.data.params.mass)[0])

    def observed() -> Array:
        states = sim.data.states
        velocity = np.ravel(states.vel).astype(float)
        pitch = Rotation.from_quat(np.ravel(states.quat)).as_euler("xyz")[1]
        return np.array([velocity[0], velocity[2], pitch, np.ravel(states.ang_vel)[1]])

    def set_states(**arrays: list[float]) -> None:
        values = {key: np.array([[v]], np.float32) for key, v in arrays.items()}
        sim.data = sim.data.replace(states=sim.data.states.replace(**values))

    def begin() -> Array:
        sim.reset()
        set_states(pos=[0.0, 0.0, 1000.0])
        return observed()

    def successor(_: Array, u: Array, force: Array) -> Array:
        command = [0.0, float(u[0]), 0.0, weight * (1.0 + float(u[1]))]
        sim.attitude_control(np.array([[command]], np.float32))
        set_states(force=[float(force[0]), 0.0, float(force[1])])
        sim.step(100)
        return observed()

    def forces(count: int, rng: np.random.Generator) -> Array:
        return rng.normal(0.0, GUST, (count, 2))

    plant = Plant(
        successor=successor,
        disturbances=forces,
        begin=begin,
        log=lambda: _log(
            successor, begin, forces, lower=[-0.2, -0.2], upper=[0.2, 0.2]
        ),
        goal=[0.0, 1.0, 0.0, 0.0],
        bound=(1, 0.5),
        weights=([1.0, 1.0, 0.1, 0.01], [1.0, 1.0]),
        limits=[0.2, 0.2],
    )
    names = Described(
        state_names=("vx", "vz", "pitch", "pitch_rate"),
        input_names=("command", "thrust"),
    )
    system = System(
        names,
        time_step=0.2,
        angles=["pitch"],
        rates={"pitch_rate": "pitch"},
    )
    return plant, system


#: by name: the package, and what makes the plant
PLANTS: dict[str, tuple[str, Callable[[], Flown]]] = {
    "pc-gym, stirred tank": ("pcgym", stirred_tank),
    "RotorPy, Crazyflie": ("rotorpy", rotorpy_crazyflie),
    "crazyflow, Crazyflie": ("crazyflow", crazyflow_crazyflie),
}


def _log(
    successor: Callable[[Array, Array, Array], Array],
    begin: Callable[[], Array],
    disturbances: Callable[[int, np.random.Generator], Array],
    lower: list[float],
    upper: list[float],
) -> tuple[Array, Array, Array]:
    """Records runs of 50 steps under inputs that are drawn anew at every third."""
    rng = np.random.default_rng(1)
    runs = []
    for _ in range(ROWS // 50):
        drawn = rng.uniform(lower, upper, (math.ceil(50 / 3), len(lower)))
        inputs = np.repeat(drawn, 3, axis=0)[:50]
        runs.append(logged(successor, begin(), inputs, disturbances(50, rng)))
    states, all_inputs, next_states = (
        np.concatenate(parts) for parts in zip(*runs, strict=True)
    )
    return states, all_inputs, next_states


def model_of(plant: Plant, system: System) -> Any:
    """Learns a plant from its rows."""
    rows = Transitions(*plant.log(), signals=system.signals)[:ROWS]
    if system.angles:
        return train(rows, system=system).posterior
    return train(rows, predicts="difference", scaling=standardize).posterior


def main() -> None:
    """Learns, flies and prints the table of the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plants", nargs="+", default=list(PLANTS), choices=PLANTS)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("| plant | noise | allowed | violated | rate, 95 % interval | distance |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in arguments.plants:
        package, make = PLANTS[name]
        if find_spec(package) is None:
            print(f"{name} is left out: pip install {package}")
            continue
        plant, system = make()
        model = model_of(plant, system)
        for way in WAYS:
            for allowed in ALLOWED:
                eta = 1.0 - allowed
                flights = fly(
                    plant=plant,
                    model=model,
                    eta=eta,
                    quantile=NormalDist().inv_cdf(eta) if way == WAYS[0] else None,
                    steps=arguments.steps,
                    seeds=arguments.seeds,
                )
                print(
                    f"| {name} | {way} | {allowed:.0%} | {_cells(flights)} |",
                    flush=True,
                )


def _cells(flights: Flights) -> str:
    """Returns how often a bound was violated, and the distance, as cells of a table."""
    count = flights.active
    low, high = binomial_interval(flights.violations, count)
    rate = flights.violations / max(count, 1)
    return (
        f"{flights.violations} of {count} | {rate:.1%} ({low:.1%} to {high:.1%}) | "
        f"{flights.distance:.3g}"
    )


if __name__ == "__main__":
    main()
