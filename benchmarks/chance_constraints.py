"""Counts how often a bound is violated that may be with probability 1 - eta.

Counted are decisions whose plan touches it.

    .venv/bin/python -m benchmarks.chance_constraints [--plants ...] [--ways ...]
    [--allowed 10 5 1] [--seeds 20]

Each plant is learned from 200 of its rows and sent to set points beyond a bound of one
of its states:

- the pendulum of ``benchmarks.estimation`` (angle), its noise Gaussian, of heavy tails
  (Student's t, 3 degrees of freedom) or an AR(1) process (correlation 0.6), of equal
  variance;
- the same pendulum, whose noise grows with its rate, sent from side to side every
  second at a bounded rate;
- gymnasium's InvertedPendulum-v5, its noise Gaussian: the cart is sent from side to
  side every 25 steps, and the angle of the pole is bounded to both sides, which bounds
  how fast the cart speeds up and brakes;
- the quadrotor of ``gpmpc/systems/quadrotor.xml`` in MuJoCo and RotorPy's Hummingbird
  (``pip install rotorpy``; see ``benchmarks/hummingbird.py``): climbing at a bounded
  speed by velocity commands, which an inner controller follows, in a wind that changes
  as an AR(1) process of 1 s. Attitude, rotors and wind are not among the states, which
  are the three velocities.

Compared: the noise that the GP learned by its evidence; the one estimated from all
rows; a noise that varies with state and input where these rows show that it does
(``estimate_varying_noise``); the constant one with an adaptive conformal tube that
begins with a Gaussian's quantiles, counts the predictions that touch the bound, and
aims so low that the upper limit of all decisions is allowed (at a rate of 0.02 for the
Hummingbird, whose errors on the log are four times those at the bound: at the default
for 1 %, 0.002, the flights end before it is as near); and the true noise with its true
quantile (of the quadrotors: those of the errors of another flight of the kind). Printed
for eta = 90, 95 and 99 %: violations per hundred decisions at an active bound, the
exact upper 95 % limit of the rate (Clopper and Pearson, 1934; for independent
decisions), the mean distance to the bound [mrad, mm/s], the mean cost of a step, and
the decisions. Writes ``outputs/benchmarks/chance_constraints.json`` after every cell;
what it holds of other cells stays.
"""

import argparse
import itertools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import beta, t

from benchmarks.estimation import HORIZON, LIMIT, NOISE, pendulum, random_motion
from benchmarks.hummingbird import compiled_hummingbird
from benchmarks.timing import RESULTS, own_source, write_results
from gpmpc.estimation import (
    AdaptiveTube,
    ConformalTube,
    estimate_process_noise,
    estimate_varying_noise,
)
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc import GPMPC, Box, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.studies.study import fingerprint
from gpmpc.systems.gymnasium_ import gymnasium_system

WAYS = (
    "learned noise",
    "estimated noise",
    "varying noise",
    "estimated noise, adaptive",
    "true noise",
)
ALLOWED, ROWS, SCORES = (10.0, 5.0, 1.0), 600, 399
RATE = 0.4  # of velocity commands, from one to the next [m/s]
QUADROTOR = Path(__file__).parents[1] / "gpmpc" / "systems" / "quadrotor.xml"
Array = np.ndarray


@dataclass
class Plant:
    """A plant with a bound on one of its states, and a set point beyond.

    Attributes: successor: The next state from a state, an input and the disturbance of
        the step. disturbances: Of every step of a flight, from a number of steps and a
        generator. begin: Puts the plant where a flight begins; returns the state (n,).
        log: States (T, n), inputs (T, m) and next states to learn from. goal: The set
        point (n,). turn: Steps after which the set point changes its sign; it stays by
        default. bound: Index of the bounded state, and its bound. weights: Of states
        and inputs. limits: Of the inputs (m,), both sides. quantile: Of the noise of a
        step, in its standard deviations; None where nobody knows it. noise: Its
        standard deviations (n,); None likewise. angles: Indices of states that the GP
        sees as sine and cosine. stages: With a bound; all by default. rate: Of the
        inputs, from one to the next. adaptation: Rate of the adaptive tube; its default
        by default. sides: To which the state is bounded: 1 is above. steps: Of each of
        20 flights, after the first 50. share: Of these that touch the bound at least,
        roughly.
    """

    successor: Callable[[Array, Array, Array], Array]
    disturbances: Callable[[int, np.random.Generator], Array]
    begin: Callable[[], Array]
    log: Callable[[], tuple[Array, Array, Array]]
    goal: Sequence[float]
    bound: tuple[int, float]
    weights: tuple[Sequence[float], Sequence[float]]
    limits: Sequence[float]
    quantile: Callable[[float], float] | None = None
    noise: Array | None = None
    angles: Sequence[int] = ()
    stages: Any = None
    turn: int | None = None
    rate: float = np.inf
    adaptation: float | None = None
    sides: Sequence[float] = (1,)
    steps: int = 1100
    share: float = 0.9


def pendulum_plant(kind: str) -> Plant:
    """The pendulum with a kind of noise."""

    def noise(steps: int, rng: np.random.Generator) -> Array:
        if kind == "heavy tails":
            return NOISE * rng.standard_t(3, (steps, 2)) / np.sqrt(3)
        return correlated(steps, rng, 0.6 if kind == "AR(1)" else 0.0, NOISE)

    def successor(x: Array, u: Array, w: Array) -> Array:
        return pendulum(x, u) + w

    def log() -> tuple[Array, Array, Array]:
        _, inputs = random_motion(ROWS, 0)
        return logged(
            successor, np.zeros(2), inputs, noise(ROWS, np.random.default_rng(1))
        )

    heavy, normal = (
        (lambda eta: float(t.ppf(eta, 3) / np.sqrt(3))),
        NormalDist().inv_cdf,
    )
    return Plant(
        successor,
        noise,
        lambda: np.array([0.5, 0.0]),
        log,
        goal=[0.9, 0.0],
        bound=(0, 0.6),
        weights=([10.0, 0.1], [1e-2]),
        limits=[LIMIT],
        noise=NOISE,
        angles=[0],
        stages=[1],
        quantile=heavy if kind == "heavy tails" else normal,
    )


def pendulum_of_rate() -> Plant:
    """The pendulum with a noise that grows with its rate.

    At the bound it is larger than on average.
    """

    def successor(x: Array, u: Array, w: Array) -> Array:
        return pendulum(x, u) + w * math.hypot(0.5, x[1])

    def noise(steps: int, rng: np.random.Generator) -> Array:
        return correlated(steps, rng, 0.0, NOISE)

    def log() -> tuple[Array, Array, Array]:
        inputs = 0.17 * random_motion(2 * ROWS, 0)[1]
        return logged(
            successor, np.zeros(2), inputs, noise(2 * ROWS, np.random.default_rng(1))
        )

    return Plant(
        successor,
        noise,
        lambda: np.zeros(2),
        log,
        goal=[0.9, 0.0],
        bound=(1, 2.5),
        sides=(1, -1),
        turn=20,
        weights=([10.0, 0.1], [1e-2]),
        limits=[LIMIT],
        noise=NOISE * math.hypot(0.5, 2.5),
        angles=[0],
        stages=[1],
        quantile=NormalDist().inv_cdf,
        steps=4000,
        share=0.2,
    )


def cart_pole() -> Plant:
    """Gymnasium's cart with a pole, learned from single steps all over its region."""
    environment, scale = (
        gymnasium_system("InvertedPendulum-v5").dynamics,
        np.array([1e-3, 1e-3, 0.01, 0.01]),
    )
    environment.reset(0)

    def successor(x: Array, u: Array, w: Array) -> Array:
        return environment.successor(x, u) + w

    def noise(steps: int, rng: np.random.Generator) -> Array:
        return correlated(steps, rng, 0.0, scale)

    def log() -> tuple[Array, Array, Array]:
        rng = np.random.default_rng(1)
        states = rng.uniform(-1, 1, (ROWS, 4)) * [0.8, 0.3, 1.5, 2.0]
        inputs = rng.uniform(-1, 1, (ROWS, 1))
        after = [
            successor(x, u, w)
            for x, u, w in zip(states, inputs, noise(ROWS, rng), strict=True)
        ]
        return states, inputs, np.array(after)

    return Plant(
        successor,
        noise,
        lambda: np.zeros(4),
        log,
        goal=[0.2, 0.0, 0.0, 0.0],
        bound=(1, 0.04),
        sides=(1, -1),
        turn=25,
        weights=([10.0, 1.0, 0.3, 0.1], [0.03]),
        limits=[3.0],
        quantile=NormalDist().inv_cdf,
        noise=scale,
        steps=3400,
        share=0.3,
    )


def climbing(
    begin: Callable[[], Array], move: Callable[[Array, Array], Array]
) -> Plant:
    """A quadrotor steered by velocity commands at 5 Hz, in a changing wind."""

    def wind(steps: int, rng: np.random.Generator) -> Array:
        return correlated(steps, rng, math.exp(-0.2), np.array([1.0, 1.0, 0.5]))

    def successor(_: Array, u: Array, w: Array) -> Array:
        return move(u, w)

    def log() -> tuple[Array, Array, Array]:
        rng = np.random.default_rng(1)
        commands = [np.zeros(3)]
        for k in range(1, ROWS):
            change = rng.uniform(-RATE, RATE, 3) if k % 3 == 0 else 0.0
            commands.append(np.clip(commands[-1] + change, -0.7, 0.7))
        return logged(successor, begin(), np.array(commands), wind(ROWS, rng))

    return Plant(
        successor,
        wind,
        begin,
        log,
        goal=[0.0, 0.0, 0.8],
        bound=(2, 0.5),
        weights=([1.0, 1.0, 1.0], [0.3] * 3),
        limits=[1.0] * 3,
        stages=[1],
        rate=RATE,
    )


def mujoco_quadrotor() -> Plant:
    """The examples' quadrotor in MuJoCo, with a controller of velocities."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(QUADROTOR))
    data, lever = mujoco.MjData(model), 0.12
    signs = np.array(
        [[1, 1, 1, 1], [1, -1, -1, 1], [-1, -1, 1, 1], [-1, 1, -1, 1]]
    )  # of thrust, roll, pitch, yaw
    mixer = np.linalg.inv(signs * np.array([1, lever, lever, 0.016])[:, None])

    def state() -> Array:
        return data.sensordata[7:10].copy()

    def begin() -> Array:
        mujoco.mj_resetData(model, data)
        data.act[:] = data.ctrl[:] = 0.5 * 9.81 / 4
        mujoco.mj_forward(model, data)
        return state()

    def move(command: Array, wind: Array) -> Array:
        for _ in range(40):
            attitude, rate = (
                Rotation.from_quat(data.sensordata[[4, 5, 6, 3]]),
                data.sensordata[10:13],
            )
            force = 0.5 * (4.0 * (command - data.sensordata[7:10]) + [0, 0, 9.81])
            up = force / np.linalg.norm(force)
            error = np.cross(attitude.inv().apply(up), [0, 0, 1]) * -1.0 - [
                0,
                0,
                0.2 * attitude.as_rotvec()[2],
            ]
            torque = np.array([0.0032, 0.0032, 0.0055]) * (150.0 * error - 20.0 * rate)
            data.ctrl[:] = np.clip(
                mixer @ np.r_[force @ attitude.apply([0, 0, 1]), torque], 0, 3
            )
            data.qfrc_applied[:3] = (
                model.dof_damping[:3] * wind
            )  # linear drag acts on the air's velocity
            mujoco.mj_step(model, data)
        return state()

    return climbing(begin, move)


def hummingbird() -> Plant:
    """RotorPy's Hummingbird with its own velocity controller and aerodynamics."""
    hover, advance = compiled_hummingbird()
    now = hover.copy()

    def begin() -> Array:
        now[:] = hover
        return now[3:6].copy()

    def move(command: Array, wind: Array) -> Array:
        now[:] = advance(now, command, wind, 20)
        return now[3:6].copy()

    return replace(climbing(begin, move), adaptation=0.02)


PLANTS = {
    "pendulum, Gaussian": lambda: pendulum_plant("Gaussian"),
    "pendulum, heavy tails": lambda: pendulum_plant("heavy tails"),
    "pendulum, AR(1)": lambda: pendulum_plant("AR(1)"),
    "pendulum, of its rate": pendulum_of_rate,
    "cart-pole": cart_pole,
    "MuJoCo quadrotor": mujoco_quadrotor,
    "Hummingbird": hummingbird,
}


def correlated(steps: int, rng: np.random.Generator, rho: float, scale: Array) -> Array:
    """An AR(1) process (steps, n) of given standard deviations."""
    noise = rng.normal(0, scale, (steps, len(scale)))
    for k in range(1, steps):
        noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
    return noise


def logged(
    successor: Callable, x: Array, inputs: Array, disturbances: Array
) -> tuple[Array, Array, Array]:
    """States, inputs and next states of one run."""
    states = [x]
    for u, w in zip(inputs, disturbances, strict=True):
        states.append(successor(states[-1], u, w))
    return np.array(states[:-1]), inputs, np.array(states[1:])


@dataclass
class Flights:
    """What came of the decisions at the bound, and of all steps."""

    violations: int
    active: int
    distance: float
    costs: list[float]  # mean of a step, of each flight
    # of the predictions of the next bounded state, in their standard deviations (T,)
    errors: Array


def fly(
    plant: Plant,
    model: ResidualModel,
    eta: float,
    quantile: float | None,
    steps: int,
    seeds: int,
) -> Flights:
    """Flies with a fixed quantile, or with an adaptive tube."""
    i, upper = plant.bound
    n, m = model.state_dim, model.input_dim
    top, sides = np.where(np.arange(n) == i, upper, np.inf), np.array(plant.sides)
    box = Box(
        -top if -1 in sides else [-np.inf] * n,
        top,
        probability=eta,
        stages=plant.stages,
    )
    cost = Tracking(*plant.weights, penalized="increments")
    problem = Problem(
        cost,
        Box([-u for u in plant.limits], list(plant.limits)),
        Box([-plant.rate] * m, [plant.rate] * m),
        [box],
    )
    controller = GPMPC(model, Linearization(), problem, HORIZON, [0.0] * m)
    tube, rows = None, sides[:, None] * np.eye(n)[i]
    if quantile is None:
        quantiles = [
            NormalDist().inv_cdf((j + 1) / (SCORES + 1)) for j in range(SCORES)
        ]
        scores, decisions = (
            np.tile(quantiles, (HORIZON, 1)).T,
            int(plant.share * steps * seeds),
        )
        tube = AdaptiveTube(
            ConformalTube(scores, rows), eta, plant.adaptation, decisions=decisions
        )
    goal, Q = np.array(plant.goal), np.array(plant.weights[0])
    violations, distances, costs, errors = 0, [], [0.0] * seeds, []
    for seed in range(seeds):
        x, last = plant.begin(), None
        for _ in range(
            HORIZON * (tube is not None)
        ):  # no plan of the flight before is compared with this one
            tube.observe(np.full(n, np.nan))
        for k, w in enumerate(
            plant.disturbances(steps + 50, np.random.default_rng(seed))
        ):
            ahead = np.arange(k, k + HORIZON + 1)[:, None]
            target = goal * (-1.0) ** (
                0 * ahead if plant.turn is None else ahead // plant.turn
            )
            kappas = (
                np.full(HORIZON, quantile) if tube is None else tube.observe(x).copy()
            )
            last = controller.control(
                Gaussian.certain(x), Reference(target, kappas=kappas), last
            )
            deviations = np.sqrt(last.covariances[1:, i, i])
            touches = (
                sides * last.means[1:, [i]]
                >= upper - (kappas * deviations)[:, None] - 1e-5
            )
            if tube is not None:
                tube.remember(last.means, last.covariances, touches)
            x = plant.successor(x, last.input, w)
            if k < 50:  # on its way to the bound
                continue
            costs[seed] += float(Q @ (x - target[1]) ** 2) / steps
            errors.append((x[i] - last.means[1, i]) / deviations[0])
            if touches[0].any():
                distances.append(upper - max(sides[touches[0]] * x[i]))
                violations += int(distances[-1] < 0)
    return Flights(
        violations, len(distances), float(np.mean(distances)), costs, np.array(errors)
    )


def main() -> None:
    """Learns, flies and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plants", nargs="+", default=list(PLANTS), choices=PLANTS)
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=WAYS)
    parser.add_argument(
        "--allowed", nargs="+", type=float, default=ALLOWED, help="[%%]"
    )
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    code = fingerprint(own_source(__file__))
    path = RESULTS / "chance_constraints.json"
    results = json.loads(path.read_text())["results"] if path.exists() else []
    print(
        f"{'plant':23}{'way':26}"
        + "".join(
            f"{w:>9}" for w in ("allowed", "%", "limit", "10^-3", "cost", "active")
        )
    )
    for name in arguments.plants:
        plant = PLANTS[name]()
        rows = Transitions(*plant.log())
        picked = rows[
            sorted(np.random.default_rng(0).permutation(len(rows))[:200].tolist())
        ]
        nominal = Affine.identity(rows.state_dim, rows.input_dim)
        learned = ResidualModel.train(
            nominal, picked, angles=plant.angles, trainer=Trainer(restarts=1)
        )
        estimated = replace(
            learned, noise=torch.diag(estimate_process_noise(learned, rows).variance)
        )
        varying = (
            estimate_varying_noise(learned, rows).model
            if "varying noise" in arguments.ways
            else estimated
        )
        for way, allowed in itertools.product(arguments.ways, arguments.allowed):
            eta = 1 - allowed / 100
            quantile = None if "adaptive" in way else NormalDist().inv_cdf(eta)
            model = {"learned noise": learned, "varying noise": varying}.get(
                way, estimated
            )
            if (
                way == "true noise"
                and plant.noise is not None
                and plant.quantile is not None
            ):
                model = replace(learned, noise=torch.diag(torch.tensor(plant.noise**2)))
                quantile = plant.quantile(eta)
            elif way == "true noise":  # of flights with other disturbances
                other = replace(
                    plant,
                    disturbances=lambda T, rng, p=plant: p.disturbances(
                        T, rng.spawn(1)[0]
                    ),
                )
                quantile = float(
                    np.quantile(
                        fly(other, model, eta, quantile, plant.steps, 4).errors, eta
                    )
                )
            outcome = fly(plant, model, eta, quantile, plant.steps, arguments.seeds)
            bad, active = outcome.violations, outcome.active
            limit = (
                float(beta.ppf(0.95, bad + 1, active - bad)) if bad < active else 1.0
            )
            cell = {"plant": name, "way": way, "eta": eta, "seeds": arguments.seeds}
            cell["code"] = code  # rows of other code stay beside those of this one
            numbers = {"violations": bad, "active": active, "upper_limit": limit}
            numbers |= {
                "distance": outcome.distance,
                "cost": float(np.mean(outcome.costs)),
                "costs": outcome.costs,
            }
            results = [
                row for row in results if row.items() & cell.items() != cell.items()
            ] + [cell | numbers]
            text = f"{allowed:9g}{100 * bad / max(active, 1):9.2f}"
            text += f"{100 * limit:9.2f}{1e3 * outcome.distance:9.2f}"
            print(
                f"{name:23}{way:26}{text}{numbers['cost']:9.4f}{active:9}", flush=True
            )
            write_results("chance_constraints", results)


if __name__ == "__main__":
    main()
