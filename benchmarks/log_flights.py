"""Flies what ``gpmpc learn`` made of the logs of simulated plants.

Each plant of ``log_plants`` has a task. It is flown as ``gpmpc run`` does, twice by the
same controller: with the model of the noisy log, and with GPs trained by
``gpmpc.models.train`` on transitions of the same run as they were without noise.
``benchmarks.log_models --fly`` flies every model that it learns. What a flight cost is
that of the problem, of what was flown (``Rollout.paid``).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from benchmarks.log_plants import GRAVITY, RATE, Plant
from gpmpc._dynamics import DynamicsModel
from gpmpc.gp import Trainer, Transitions, standardize
from gpmpc.logs import IdentifiedModel, load_flyable, save_learned
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.systems import System

MOST = 1.2  # of the cost with the model of clean transitions
ROWS = 400  # of clean transitions


@dataclass(frozen=True)
class Task:
    """A set point that a plant is to be brought to."""

    goal: tuple[float, ...]
    Q: tuple[float, ...]
    R: tuple[float, ...]
    horizon: int
    steps: int
    #: what the plant is not told by its own description
    changes: Mapping[str, Any] = field(default_factory=dict)


TASKS = {
    "pendulum": Task(goal=(0.0, 0.0), Q=(1.0, 0.01), R=(0.01,), horizon=150, steps=500),
    "lagging pendulum": Task(
        goal=(np.pi, 0.0), Q=(1.0, 0.01), R=(0.01,), horizon=60, steps=400
    ),
    "cart-pole": Task(
        goal=(0.0, 0.0, 0.0, 0.0),
        Q=(1.0, 0.01, 1.0, 0.01),
        R=(0.01,),
        horizon=100,
        steps=500,
    ),
    "quadruple tank": Task(
        goal=(12.4, 12.7, 1.8, 1.4),
        Q=(1.0, 1.0, 0.0, 0.0),
        R=(0.01, 0.01),
        horizon=100,
        steps=1500,
    ),
    "two-link arm": Task(
        goal=(1.0, -0.8, 0.0, 0.0),
        Q=(1.0, 1.0, 0.01, 0.01),
        R=(0.001, 0.001),
        horizon=40,
        steps=200,
    ),
    "quadrotor": Task(
        goal=(0.5, -0.4, 1.4, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0),
        Q=(10.0,) * 3 + (1.0,) * 4 + (1.0,) * 3 + (0.1,) * 3,
        R=(0.1,) * 4,
        horizon=40,
        steps=300,
        changes={"initial_input": [0.5 * GRAVITY / 4] * 4},
    ),
}


class FlightCost(NamedTuple):
    """What a flight cost, and how it ended."""

    cost: float
    end: tuple[float, ...]  # its last state
    judgement: str
    milliseconds: float  # of a decision, median


def clean_model(plant: Plant, seed: int) -> DynamicsModel:
    """Trains GPs on transitions of a plant's run, without noise."""
    table = replace(plant, noise=tuple(0.0 for _ in plant.noise)).log(seed)
    system = plant.system()
    states = table[list(system.state_names)].to_numpy(copy=True)
    inputs = table[list(system.input_names)].to_numpy()[:-1]
    for i in system.angle_indices:
        states[:, i] = np.unwrap(states[:, i])
    rows = np.random.default_rng(seed).permutation(len(inputs))[:ROWS]
    transitions = Transitions(states[rows], inputs[rows], states[rows + 1])
    trainer = Trainer(predicts="difference", scaling=standardize)
    return train(transitions, system=system, trainer=trainer, seed=seed).posterior


def learned_model(learned: IdentifiedModel) -> DynamicsModel:
    """Returns the model that ``gpmpc run model=FILE`` flies."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        save_learned(learned, path)
        return load_flyable(path).model


def fly(plant: Plant, model: DynamicsModel, seed: int = 0) -> FlightCost:
    """Flies a plant to its task with a model."""
    task = TASKS[plant.name]
    system: System = replace(
        plant.system(), goal=list(task.goal), start=list(plant.start), **task.changes
    )
    angles = system.angle_indices
    problem = Problem(
        Tracking(list(task.Q), list(task.R), penalized="deviations", angles=angles),
        inputs=Box(system.input_lower, system.input_upper),
    )
    experiment = Experiment(
        data=None,  # type: ignore[arg-type]  # the model is trained
        trajectory=None,
        system=system,
        train=Trainer(),
        controller=partial(
            GPMPC,
            propagator=Linearization(),
            problem=problem,
            horizon=task.horizon,
            initial_input=system.initial_input,
        ),
        steps=task.steps,
        seed=seed,
        model=model,
    )
    rollout = run_trial(experiment).rollout
    resting = np.asarray(system.initial_input, dtype=float)
    paid = rollout.paid(
        problem.cost,
        resting,
        reference_inputs=np.tile(resting, (len(rollout.inputs), 1)),
    )
    seconds = [timing.total for timing in rollout.timings]
    judgement = rollout.judgement
    return FlightCost(
        cost=float(paid.sum()),
        end=tuple(rollout.states[-1].round(3).tolist()),
        judgement=f"{judgement.level} {judgement.reason}".strip(),
        milliseconds=1e3 * float(np.median(seconds)),
    )


def compare(plant: Plant, learned: IdentifiedModel, seed: int) -> dict[str, Any]:
    """Flies a learned model and one of clean transitions; prints and returns both."""
    models = {"learned": learned_model(learned), "clean": clean_model(plant, seed)}
    flights = {}
    for name, model in models.items():
        flight = fly(plant, model, seed)
        flights[name] = flight
        print(
            f"  {name:8s} cost {flight.cost:.4g}, {flight.milliseconds:.1f} ms, "
            f"ends at {flight.end}; {flight.judgement}",
            flush=True,
        )
    ratio = flights["learned"].cost / flights["clean"].cost
    fault = "" if ratio <= MOST else "  COSTS MORE"
    print(f"  flown at {ratio:.3f} of the cost{fault}")
    return {
        "case": f"{plant.name}, seed {seed}",
        "rate": RATE,
        "ratio": ratio,
        "flights": {name: flight._asdict() for name, flight in flights.items()},
    }
