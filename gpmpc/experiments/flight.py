"""Problem: one controller in one loop is flown once, in a process of its own, and comes back as plain numbers.

A ``Row`` says which controller, with which settings; a ``Task``, what it flies; together with a seed they are a
``Flight``, and ``fly`` flies it.
"""

import inspect
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gpmpc.compiling import tell_of_compiling
from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.gp import GPPosterior, Scaling, load_posterior
from gpmpc.metrics import tracking_error, violation_rate
from gpmpc.mpc.controller import Controller, Reference
from gpmpc.mpc.convex_mpc import ConvexMPC
from gpmpc.mpc.nmpc import NMPC
from gpmpc.mpc.nonlinear_mpc import NonlinearGPMPC
from gpmpc.mpc.tracking import StateBounds, TrackingProblem
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.simulation import ModelLoop, Noise, Rollout, closed_loop, rehearse
from gpmpc.systems import Plant
from gpmpc.systems.quadrotor import GRAVITY

PROPAGATIONS = {"moment_matching": MomentMatching, "linearization": Linearization}
CONTROLLERS = {"nmpc": NMPC, "nonlinear": NonlinearGPMPC, "convex": ConvexMPC}
LOOPS = ("model", "plant")
SUBSYSTEMS = ("translational", "rotational")
PRICES = ("l1", "l2")  # of unkept state bounds, among a row's settings
ALL = 0  # ``size`` of a row that learns from all samples
AT_BOUND = 1e-6  # [m, m/s] distance of a plan to a bound that is none


@dataclass(frozen=True)
class Row:
    """One controller in one loop.

    Attributes:
        loop: ``"model"`` or ``"plant"``.
        controller: ``"nmpc"`` (on the true plant), ``"nonlinear"`` or ``"convex"``.
        R: Input weights, the diagonal (m,).
        Q: State weights, the diagonal (n,).
        penalized: What R weighs; see ``TrackingProblem``.
        bounded: Whether the inputs are bounded.
        horizon: H, or several.
        propagation: ``"moment_matching"`` or ``"linearization"``: how the controller's belief moves.
        process_noise: Whether the learned noise counts as part of the predicted state; chance constraints with a
            noisy plant in the loop need it.
        data: What the GP learned from: a name in ``Flights.data``.
        size: Training transitions, or several; 0 for all.
        confidence: eta of the state bounds of the trajectory, or several; None without state bounds.
        subsystems: Which are flown; the plant in the loop is translational.
        trials: Seeds, for plants; None takes the experiment's.
        settings: Further arguments of the controller.
        title: What it is called in tables and figures; its name by default.

    Raises:
        SettingError: An unknown loop, controller or propagation, or a model loop with the true plant's controller.
    """

    loop: str
    controller: str
    R: Sequence[float]
    Q: Sequence[float] = (1, 1, 1, 1, 1, 1)
    penalized: str = "deviations"
    bounded: bool = True
    horizon: Any = 1
    propagation: str = "moment_matching"
    process_noise: bool = False
    data: str = "data"
    size: Any = ALL
    confidence: Any = None
    subsystems: Sequence[str] = ("translational",)
    trials: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    title: str = ""

    def __post_init__(self) -> None:
        known = (("loop", LOOPS), ("controller", CONTROLLERS), ("propagation", PROPAGATIONS))
        for key, possible in known:
            if getattr(self, key) not in possible:
                raise SettingError(key, f"must be one of {', '.join(possible)}; got {getattr(self, key)!r}")
        if self.loop == "model" and self.controller == "nmpc":
            raise SettingError("controller", "nmpc knows the true plant and needs it in the loop; got loop model")
        taken = {*inspect.signature(CONTROLLERS[self.controller]).parameters, *PRICES}
        for key in self.settings:
            if key not in taken:
                raise SettingError(f"settings.{key}", f"controller {self.controller} takes no such setting")
        for subsystem in self.subsystems:
            if subsystem not in SUBSYSTEMS:
                raise SettingError("subsystems", f"must be among {', '.join(SUBSYSTEMS)}; got {subsystem!r}")
        for key, least in (("horizon", 1), ("size", 0)):
            for value in _several(getattr(self, key)):
                check_number(key, value, least=least, whole=True)

    def variants(self) -> list["Row"]:
        """One row for every combination of the settings that are given as lists."""
        keys = ("horizon", "size", "confidence")
        combinations = itertools.product(*(_several(getattr(self, key)) for key in keys))
        return [replace(self, **dict(zip(keys, values, strict=True))) for values in combinations]


@dataclass(frozen=True)
class Flight:
    """One row on one trajectory with one seed; ``fingerprint`` names everything that its numbers depend on."""

    name: str
    row: Row
    trajectory: str
    subsystem: str
    trial: int
    seed: int
    task: "Task"
    fingerprint: str


@dataclass(frozen=True)
class Task:
    """What a flight needs besides its row.

    Attributes:
        posterior: File of the trained GPs; None where none are needed.
        reference: In the units of the model.
        scaling: Of the states, to the units of the data.
        lower: Bounds of the inputs (m,), in the units of the model.
        upper: (m,).
        state_lower: Bounds of the states (n,).
        state_upper: (n,).
        plant: The true plant.
        noise: Standard deviation of the process noise, every state.
        steps: Of the flight.
    """

    posterior: Path | None
    reference: Reference
    scaling: Scaling
    lower: Sequence[float]
    upper: Sequence[float]
    state_lower: Sequence[float] | None
    state_upper: Sequence[float] | None
    plant: Plant
    noise: float
    steps: int


def problem_of(
    row: Row,
    lower: Sequence[float],
    upper: Sequence[float],
    state_lower: Sequence[float] | None,
    state_upper: Sequence[float] | None,
) -> TrackingProblem:
    """The tracking problem of a row between bounds of the inputs and states, as ``Task`` has them."""
    bounds = {"input_lower": lower, "input_upper": upper} if row.bounded else {}
    limits = None
    if state_lower is not None:
        prices = {key: row.settings[key] for key in PRICES if key in row.settings}
        limits = StateBounds(state_lower, state_upper, confidence=row.confidence, **prices)
    return TrackingProblem(row.Q, row.R, row.penalized, state_bounds=limits, **bounds)


def controller_of(row: Row, task: Task) -> Controller:
    """The controller of a row, for one flight."""
    problem = problem_of(row, task.lower, task.upper, task.state_lower, task.state_upper)
    settings = {key: value for key, value in row.settings.items() if key not in PRICES}
    known = task.reference.inputs
    at_first = np.array([task.plant.dynamics.mass * GRAVITY, 0.0, 0.0]) if known is None else known[0]
    at_first = np.clip(at_first, problem.input_lower, problem.input_upper)
    if row.controller == "nmpc":
        return NMPC(task.plant, problem, row.horizon, at_first, **settings)
    model, propagator = _loaded(task.posterior), PROPAGATIONS[row.propagation](process_noise=row.process_noise)
    return CONTROLLERS[row.controller](model, propagator, problem, row.horizon, at_first, **settings)


@tell_of_compiling()
def fly(flight: Flight) -> dict:
    """Flies one flight, in a worker process."""
    torch.set_num_threads(1)
    row, task = flight.row, flight.task
    record = {key: getattr(flight, key) for key in ("name", "trajectory", "subsystem", "trial", "seed")}
    record["name"] = row.title or flight.name
    record |= {key: getattr(row, key) for key in ("loop", "controller", "horizon", "size", "confidence", "bounded")}
    try:
        controller = controller_of(row, task)
        if row.loop == "model":
            system = ModelLoop(_loaded(task.posterior), MomentMatching())
            noise = None
        else:
            system, noise = task.plant, Noise(process=[task.noise] * 6)
        start = task.reference.states[0]
        rehearse(system, controller, task.reference, start)
        rollout = closed_loop(
            system, controller, task.reference, start, task.steps,
            noise=noise, on_failure="previous_plan", seed=flight.seed,
        )  # fmt: skip
    except GpmpcError as error:  # of this flight; the others go on
        return record | {"error": str(error)}
    return record | _measured(rollout, flight, controller.problem.state_bounds)


def _measured(rollout: Rollout, flight: Flight, limits: StateBounds | None) -> dict:
    task, scale = flight.task, flight.task.scaling
    states, references = (scale.restore(torch.from_numpy(x)).numpy() for x in (rollout.states, rollout.references))
    error = tracking_error(states, references)
    inside = violation_rate(rollout.inputs, task.lower, task.upper, tolerance=1e-8)
    measured = {
        "rmse": error.axes.tolist(),
        "total": error.total,
        "input_excess": inside.worst if flight.row.bounded else None,
        "failures": [[k, status.name] for k, status in rollout.failures],
        "iterations": float(rollout.iterations.mean()),
        "seconds": np.round(rollout.seconds, 7).tolist(),
    }
    if limits is not None:
        states, expected = rollout.states[1:], rollout.predicted_means
        sd = np.sqrt(rollout.predicted_covariances.diagonal(axis1=1, axis2=2))
        beyond = np.maximum(limits.lower - states, states - limits.upper).max(axis=1)
        planned = limits.kappa * sd + np.maximum(limits.lower - expected, expected - limits.upper)
        margin = planned.max(axis=1)  # of the program's own promise; NaN where nothing was solved
        at_bound = np.abs(margin) <= AT_BOUND
        measured["violations"] = [int((beyond > 0).sum()), len(states)]
        measured["at_bound"] = [int(((beyond > 0) & at_bound).sum()), int(at_bound.sum())]
        measured["paid"] = int((margin > AT_BOUND).sum())
        measured["worst"] = float(beyond.max())
    if flight.trial == 0:  # the one that is drawn
        shown = {"states": states, "references": references, "inputs": rollout.inputs}
        if rollout.covariances.any():
            shown["deviations"] = np.sqrt(rollout.covariances.diagonal(axis1=1, axis2=2)) * scale.factor.numpy()
        if task.reference.inputs is not None:
            shown["reference_inputs"] = task.reference.inputs[: task.steps]
        measured["drawn"] = {key: np.round(value, 9).tolist() for key, value in shown.items()}
        measured["bounds"] = [list(task.lower), list(task.upper)]
    return measured


@lru_cache(maxsize=8)
def _loaded(path: Path) -> GPPosterior:
    return load_posterior(path)


def _several(value: Any) -> list:
    return list(value) if isinstance(value, list | tuple) else [value]
