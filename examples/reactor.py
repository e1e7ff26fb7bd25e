"""Runs a reactor as productively as its temperature allows.

Its model is learned from 350 random steps.

Its cost is economic: what is left of the feed, and the cooling that is paid for. Beside
it stands the tracking of the reactor's operating point. Run as `python
examples/reactor.py FOLDER` (the present folder by default); it writes reactor.png
there.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure

from gpmpc.gp import Transitions, standardize, train
from gpmpc.mpc import GPMPC, Box, LeastSquares, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise, Rollout, closed_loop
from gpmpc.systems import step_many, stirred_tank

# [K], [-]
HOTTEST = 352.0
STEPS = 200
HOTTEST_STATE = [np.inf, HOTTEST]
NOISE = [0.0005, 0.1]  # standard deviations a step [mol/L, K]

reactor = stirred_tank()
rng = np.random.default_rng(0)
states = rng.uniform([0.2, 315.0], [0.95, 360.0], (400, 2))
coolant = rng.uniform(280, 320, (400, 1))
states = states[states[:, 1] + 30 * states[:, 0] < 373]  # no runaway reactions
coolant = coolant[: len(states)]
after = step_many(reactor, states, coolant) + rng.normal(0, NOISE, states.shape)
gp = train(
    Transitions(states, coolant, after), predicts="difference", scaling=standardize
).posterior


def expenses(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """The feed that leaves unconverted [mol/L], and the cooling below 300 K [10 K]."""
    return torch.stack([x[..., 0], (300.0 - u[..., 0]).clamp_min(0.0) / 10.0], dim=-1)


inputs = Box(reactor.input_lower, reactor.input_upper)
bounds = [
    Box(upper=HOTTEST_STATE),
    Box(upper=HOTTEST_STATE, probability=0.95, stages=range(1, 6)),
]
changes = [1e-4]  # the weight of changes of the coolant
problems = {
    "economic cost": Problem(
        Tracking([0.0, 0.0], changes),
        inputs,
        constraints=bounds,
        outputs=[LeastSquares(expenses, weight=[1.0, 0.01])],
    ),
    "operating point": Problem(
        Tracking([1.0, 1e-3], changes), inputs, constraints=bounds
    ),
}
flights = {}
for name, problem in problems.items():
    controller = GPMPC(
        gp,
        Linearization(),
        problem,
        horizon=40,
        initial_input=[300.0],
    )
    flight = closed_loop(
        reactor,
        controller,
        reactor.goal,
        reactor.start,
        STEPS,
        noise=Noise(process=NOISE),
    )
    flights[name] = flight
    left = flight.states[STEPS // 2 :, 0].mean()
    hot = (flight.states[1:, 1] > HOTTEST).mean()
    print(
        f"{name:16} {left:.3f} mol/L of the feed left, "
        f"too hot in {hot:.1%} of the steps"
    )


def figure(flights: dict[str, Rollout]) -> Figure:
    """Draws concentration, temperature and coolant over time."""
    plt.style.use("gpmpc.plotting.gpmpc")
    drawn, axes = plt.subplots(3, sharex=True, figsize=(7, 5.4))
    for (name, flight), color, line in zip(
        flights.items(), ("C0", "C1"), ("-", "--"), strict=True
    ):
        minutes = flight.times / 60
        for axis, values in zip(
            axes,
            (flight.states[:, 0], flight.states[:, 1], flight.inputs[:, 0]),
            strict=True,
        ):
            axis.plot(
                minutes[: len(values)], values, color=color, linestyle=line, label=name
            )
    axes[1].axhline(
        HOTTEST, color="black", linestyle=":", label="hottest allowed, with 95 %"
    )
    for axis, label in zip(
        axes, ("concentration", "temperature", "coolant"), strict=True
    ):
        axis.set_ylabel(f"{label} [{reactor.units[label]}]")
    axes[0].set_title(
        "A reactor under an economic cost, and held at its operating point"
    )
    axes[2].set_xlabel("time [min]")
    drawn.legend(
        *axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=3
    )
    return drawn


figure(flights).savefig(Path(sys.argv[1] if len(sys.argv) > 1 else ".") / "reactor.png")
