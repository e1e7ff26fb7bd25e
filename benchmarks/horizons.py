"""Finds the shortest horizon that holds a set point, in theory and in flight.

    .venv/bin/python -m benchmarks.horizons [tank pendulum cart_pole ...] [--seeds 3]

``known before`` is ``GPMPC.stability(goal).shortest_horizon``. ``measured`` is found by
flights: two that begin a millionth of a unit apart, on the plant, with the same
controller; from the horizon on where they come nearer to each other and from there on
do so, by bisection. Of the true model, and of GPs that were learned from random data
(seeds). The tank is the quadruple tank in its setting of non-minimum phase (Johansson,
2000): each pump fills the lower tank that it does not seem to, and a horizon of a
minute or two sees the wrong sign. Writes ``outputs/benchmarks/horizons.json``.
"""

import argparse
import math
from typing import Any

import numpy as np

from benchmarks.timing import write_results
from gpmpc._dynamics import DynamicsModel
from gpmpc.datasets import RandomData
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import Affine, CasadiFunction, KnownModel, ResidualModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.systems import System, acrobot, cart_pole, double_pendulum, pendulum, step

Array = np.ndarray

APART = 1e-6  # of two flights at first
AWAY = 0.02  # from the goal in the end, in the units of the states
STEPS = 400
SATURATED = (
    1e-6  # from a bound of the inputs: no flight that stays at its goal is there
)
TANK_GOAL = [12.4, 13.2, 4.73, 4.99]  # [cm]
VOLTAGES = [3.15, 3.15]  # [V]


class QuadrupleTank:
    """Four tanks and two pumps (Johansson, 2000), non-minimum phase (P+)."""

    state_names = ("h1", "h2", "h3", "h4")
    input_names = ("v1", "v2")
    areas = (28.0, 32.0, 28.0, 32.0)  # [cm^2]
    outlets = (0.071, 0.057, 0.071, 0.057)  # [cm^2]
    pumps = (3.14, 3.29)  # [cm^3/(V s)]
    below = (0.43, 0.34)  # share of a pump that flows into a lower tank
    gravity = 981.0  # [cm/s^2]

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """Rates of the levels [cm/s]; an empty tank lets nothing out."""
        out = []
        for level, outlet in zip([x[i] for i in range(4)], self.outlets, strict=True):
            root = level / (level * level + 1e-4) ** 0.25
            out.append(outlet * math.sqrt(2.0 * self.gravity) * root)
        first = self.pumps[0] * u[0]
        second = self.pumps[1] * u[1]
        return [
            (out[2] + self.below[0] * first - out[0]) / self.areas[0],
            (out[3] + self.below[1] * second - out[1]) / self.areas[1],
            ((1.0 - self.below[1]) * second - out[2]) / self.areas[2],
            ((1.0 - self.below[0]) * first - out[3]) / self.areas[3],
        ]


def quadruple_tank(time_step: float = 10.0) -> System:
    """The tanks about their operating point."""
    return System(
        QuadrupleTank(),
        time_step=time_step,
        substeps=4,
        units=dict.fromkeys(QuadrupleTank.state_names, "cm"),
        input_lower=[0.0, 0.0],
        input_upper=[10.0, 10.0],
        initial_input=VOLTAGES,
        goal=TANK_GOAL,
        region=([8.0, 8.0, 2.0, 2.0], [18.0, 18.0, 8.0, 8.0]),
    )


def plants() -> dict[str, tuple[System, Tracking, int]]:
    """Returns systems with their costs and numbers of random samples.

    The number is 0 where only the true model flies.
    """
    swing = {"R": [0.01], "penalized": "inputs"}
    return {
        "tank": (quadruple_tank(), Tracking([1.0, 1.0, 0.0, 0.0], [0.1, 0.1]), 200),
        "tank, 5 s": (
            quadruple_tank(5.0),
            Tracking([1.0, 1.0, 0.0, 0.0], [0.01, 0.01]),
            200,
        ),
        "pendulum": (pendulum(), Tracking([1.0, 0.01], **swing), 400),
        "cart_pole": (cart_pole(), Tracking([1.0, 0.01, 1.0, 0.01], **swing), 500),
        "acrobot": (
            acrobot(),
            Tracking([1.0, 0.1, 0.1, 0.1], terminal=[30.0, 10.0, 30.0, 10.0], **swing),
            0,
        ),
        "double_pendulum": (
            double_pendulum(),
            Tracking([10.0, 0.1, 10.0, 0.1], **swing),
            0,
        ),
    }


def true_model(system: System) -> KnownModel:
    """The system as a known model."""
    function = CasadiFunction(successor_function(system))
    return KnownModel(function, len(system.state_names), len(system.input_names))


def learned_model(system: System, samples: int, seed: int) -> ResidualModel:
    """A model of random steps, whose angles are seen as sine and cosine."""
    data = RandomData(samples=samples, seed=seed).transitions(system, None, "random")
    n = data.state_dim
    m = data.input_dim
    return ResidualModel.train(
        Affine.identity(n, m),
        data,
        angles=system.angle_indices,
        trainer=Trainer(restarts=0),
    )


def controller(
    system: System, model: DynamicsModel, cost: Tracking, horizon: int
) -> GPMPC:
    """The plain controller of the means."""
    bounds = Box(system.input_lower, system.input_upper)
    return GPMPC(
        model,
        Linearization(),
        Problem(cost, inputs=bounds),
        horizon,
        system.initial_input,
        PredictionSettings(covariance="none"),
    )


def parts(system: System, flown: GPMPC, state: Array) -> bool:
    """Whether two flights that begin at the goal part, or leave it.

    A loop that is unstable there may settle elsewhere, or at the bounds of its inputs.
    """
    goal = Reference(np.array(system.goal))
    weighed = np.diagonal(flown.problem.cost.Q) > 0
    states = [state, state + APART]
    plans: list[Any] = [None, None]
    distances = []
    for _ in range(STEPS):
        for i in range(2):
            belief = Gaussian.certain(states[i])
            plans[i] = flown.control(belief, goal, plans[i])
            states[i] = step(system, states[i], plans[i].input)
            lower = plans[i].input - system.input_lower
            upper = system.input_upper - plans[i].input
            if min(lower.min(), upper.min()) < SATURATED:
                return True
        distances.append(float(np.linalg.norm(states[1] - states[0])))
        if not distances[-1] < 1e3 * APART:
            return True
    if np.abs(weighed * (states[0] - system.goal)).max() > AWAY:
        return True
    quarter = STEPS // 4
    if distances[-1] < 1e-3 * APART:
        return False
    return max(distances[-quarter:]) > max(distances[-2 * quarter : -quarter])


def measured_horizon(
    system: System, model: DynamicsModel, cost: Tracking, longest: int
) -> int | None:
    """Bisects for the shortest horizon with which flights do not part."""
    too_short = 0
    long_enough = longest
    state = np.array(system.goal)
    if parts(system, controller(system, model, cost, longest), state):
        return None
    while long_enough - too_short > 1:
        middle = (too_short + long_enough) // 2
        if parts(system, controller(system, model, cost, middle), state):
            too_short = middle
        else:
            long_enough = middle
    return long_enough


def main() -> None:
    """Judges, flies and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("plants", nargs="*", default=list(plants()))
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    results = []
    for name in arguments.plants:
        system, cost, samples = plants()[name]
        models: dict[str, DynamicsModel] = {"true": true_model(system)}
        for seed in range(arguments.seeds if samples else 0):
            models[f"learned, seed {seed}"] = learned_model(system, samples, seed)
        for kind, model in models.items():
            judged = controller(system, model, cost, 10).stability(system.goal)
            predicted = judged.shortest_horizon
            longest = 2 * (predicted or 100)
            measured = measured_horizon(system, model, cost, longest)
            results.append(
                {"plant": name, "model": kind, "known": predicted, "measured": measured}
            )
            print(f"{name}, {kind}: known before {predicted}, measured {measured}")
    write_results("horizons", {"results": results})


if __name__ == "__main__":
    main()
