"""One flight of figures 2 to 4: its controller, its loop, and what is measured."""

import inspect
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gpmpc.exceptions import SettingError, check_number
from gpmpc.experiments.slsqp import SLSQP
from gpmpc.experiments.subsystems import SYSTEMS, check_subsystems
from gpmpc.gp import Scaling
from gpmpc.metrics import tracking_error, violation_rate
from gpmpc.mpc import (
    GPMPC,
    Box,
    Controller,
    NonlinearGPMPC,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc._cost import Penalized
from gpmpc.mpc.baselines import NMPC
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.simulation import ModelLoop, Noise, Rollout, closed_loop, rehearse
from gpmpc.studies.study import read_model
from gpmpc.systems import GRAVITY

PROPAGATIONS = {"moment_matching": MomentMatching, "linearization": Linearization}
LEARNING_CONTROLLERS: Mapping[str, Callable[..., Controller]] = {
    "nonlinear": NonlinearGPMPC,
    "slsqp": SLSQP,
    "convex": GPMPC,
}
CONTROLLERS: Mapping[str, Callable[..., Controller]] = {
    "nmpc": NMPC,
    **LEARNING_CONTROLLERS,
}
LOOPS = ("model", "plant")
PLANT = SYSTEMS["translational"]  # the plant in the loop
AT_BOUND = 1e-6  # [m, m/s] distance of a plan to a bound that counts as none


@dataclass(frozen=True)
class Row:
    """One controller in one loop.

    Attributes:
        loop: ``"model"`` or ``"plant"``.
        controller: ``"nmpc"`` (on the true plant), ``"nonlinear"``, ``"slsqp"`` or
            ``"convex"``.
        R: Input weights, the diagonal (m,).
        Q: State weights, the diagonal (n,).
        penalized: What R weighs; see ``Tracking``.
        bounded: Whether the inputs are bounded.
        horizon: H, or several.
        propagation: Propagator of the controller's belief: ``"moment_matching"`` or
            ``"linearization"``.
        process_noise: Whether the learned noise counts as part of the predicted state;
            chance constraints with a noisy plant in the loop need it.
        data: Source of the training data: a name in ``Figures.data``.
        size: Training transitions, or several; 0 for all.
        confidence: eta of the state bounds of the trajectory, or several; None without
            state bounds.
        subsystems: Those that are flown; the plant in the loop is translational.
        trials: Seeds, for plants; None takes the study's.
        settings: Further arguments of the controller, and the ``penalty`` of state
            bounds that cannot be kept.
        title: Its name in tables and figures; that of the row by default.

    Raises:
        SettingError: An unknown loop, controller or propagation, or a model loop with
            the true plant's controller.
    """

    loop: str
    controller: str
    R: Sequence[float]
    Q: Sequence[float] = (1, 1, 1, 1, 1, 1)
    penalized: Penalized = "deviations"
    bounded: bool = True
    horizon: Any = 1
    propagation: str = "moment_matching"
    process_noise: bool = False
    data: str = "data"
    size: Any = 0
    confidence: Any = None
    subsystems: Sequence[str] = ("translational",)
    trials: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    title: str = ""

    def __post_init__(self) -> None:
        _check_choice("loop", self.loop, LOOPS)
        _check_choice("controller", self.controller, CONTROLLERS)
        _check_choice("propagation", self.propagation, PROPAGATIONS)
        if self.loop == "model" and self.controller == "nmpc":
            raise SettingError(
                "controller",
                "nmpc knows the true plant and needs it in the loop; got loop model",
            )
        parameters = inspect.signature(CONTROLLERS[self.controller]).parameters
        for key in self.settings:
            if key not in parameters and key != "penalty":
                raise SettingError(
                    f"settings.{key}",
                    f"controller {self.controller} takes no such setting",
                )
        check_subsystems("subsystems", self.subsystems)
        for horizon in as_list(self.horizon):
            check_number("horizon", horizon, least=1, whole=True)
        for size in as_list(self.size):
            check_number("size", size, least=0, whole=True)

    def variants(self) -> list["Row"]:
        """Returns one row for every combination of settings that are lists."""
        combinations = itertools.product(
            as_list(self.horizon), as_list(self.size), as_list(self.confidence)
        )
        return [
            replace(self, horizon=horizon, size=size, confidence=confidence)
            for horizon, size, confidence in combinations
        ]


def _check_choice(key: str, value: str, choices: Sequence[str] | Mapping) -> None:
    if value not in choices:
        raise SettingError(key, f"must be one of {', '.join(choices)}; got {value!r}")


def as_list(value: Any) -> list:
    """Returns a setting that is one value or a list of them as a list."""
    return list(value) if isinstance(value, list | tuple) else [value]


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds, an entry each; infinite ones leave an entry free."""

    lower: Sequence[float]
    upper: Sequence[float]


@dataclass(frozen=True)
class Condition:
    """A flight, but for its seed.

    Attributes:
        row: The controller and its settings.
        model: File of the trained GPs; None where none are needed.
        reference: In the units of the model.
        scaling: Of the states, to the units of the data.
        inputs: Bounds of the inputs, in the units of the model.
        states: Bounds of the states; None where there are none.
        noise: Standard deviation of the process noise, every state.
        steps: Of the flight.
        drawn: Whether the record holds the curves that are drawn.
    """

    row: Row
    model: Path | None
    reference: Reference
    scaling: Scaling
    inputs: Bounds
    states: Bounds | None
    noise: float
    steps: int
    drawn: bool = False

    def controller(self) -> Controller:
        """Makes the controller."""
        row = self.row
        problem = tracking_problem(row, self.inputs, self.states)
        settings = dict(row.settings)
        settings.pop("penalty", None)  # of the problem
        if "prediction" in settings:
            settings["prediction"] = PredictionSettings(**settings["prediction"])
        initial_input = self._initial_input(problem)
        if self.model is None:
            return NMPC(PLANT, problem, row.horizon, initial_input, **settings)
        return LEARNING_CONTROLLERS[row.controller](
            read_model(self.model),
            PROPAGATIONS[row.propagation](process_noise=row.process_noise),
            problem,
            row.horizon,
            initial_input,
            **settings,
        )

    def _initial_input(self, problem: Problem) -> list[float]:
        """Returns the input before the first step: the reference's, or that of hover.

        It is within the bounds.
        """
        initial_input = np.array([PLANT.dynamics.mass * GRAVITY, 0.0, 0.0])
        if self.reference.inputs is not None:
            initial_input = self.reference.inputs[0]
        bounds = problem.inputs
        return np.clip(initial_input, bounds.lower, bounds.upper).tolist()


def tracking_problem(row: Row, inputs: Bounds, states: Bounds | None) -> Problem:
    """Returns the tracking problem of a row."""
    state_box = chance_box(row, states)
    return Problem(
        Tracking(row.Q, row.R, penalized=row.penalized),
        Box(inputs.lower, inputs.upper) if row.bounded else Box(),
        constraints=[] if state_box is None else [state_box],
    )


def chance_box(row: Row, states: Bounds | None) -> Box | None:
    """Returns the state bounds that hold with a row's confidence, if it has some."""
    if states is None:
        return None
    return Box(
        states.lower,
        states.upper,
        probability=row.confidence,
        penalty=row.settings.get("penalty"),
    )


def fly(condition: Condition, seed: int) -> dict:
    """Flies a condition with one seed and returns its record."""
    controller = condition.controller()
    reference = condition.reference
    if condition.row.loop == "model":
        assert condition.model is not None
        model = read_model(condition.model)
        system = ModelLoop(model, MomentMatching(process_noise=False))
        noise = None
    else:
        system = PLANT
        noise = Noise(process=[condition.noise] * 6)
    rehearse(system, controller, reference, reference.states[0])
    rollout = closed_loop(
        system,
        controller,
        reference,
        reference.states[0],
        condition.steps,
        noise=noise,
        on_failure="previous_plan",
        seed=seed,
    )
    return measure(rollout, condition)


def measure(rollout: Rollout, condition: Condition) -> dict:
    """Returns the record of a flight."""
    restore = condition.scaling.restore
    states = restore(torch.from_numpy(rollout.states)).numpy()
    references = restore(torch.from_numpy(rollout.references)).numpy()
    error = tracking_error(states, references, PLANT.tracked_indices)
    input_excess = None
    if condition.row.bounded:
        lower = np.asarray(condition.inputs.lower, dtype=float)
        upper = np.asarray(condition.inputs.upper, dtype=float)
        rate = violation_rate(rollout.inputs, lower, upper, tolerance=1e-8)
        input_excess = rate.worst
    record = {
        "rmse": error.axes.tolist(),
        "total": error.total,
        "input_excess": input_excess,
        "failures": [[step, status.name] for step, status in rollout.failures],
        "iterations": float(rollout.iterations.mean()),
        "seconds": np.round(rollout.seconds, 7).tolist(),
    }
    state_box = chance_box(condition.row, condition.states)
    if state_box is not None:
        record |= _violations(rollout, state_box)
    if condition.drawn:
        record["drawn"] = _curves(rollout, condition, states, references)
        bounds = condition.inputs
        record["bounds"] = [list(bounds.lower), list(bounds.upper)]
    return record


def _violations(rollout: Rollout, box: Box) -> dict:
    """Counts the steps outside state bounds, and those of them planned at a bound.

    A plan that leads to a bound at once breaks it at the rate that the program
    promises.
    """
    states = rollout.states[1:]
    means = rollout.predicted_means
    std = np.sqrt(rollout.predicted_covariances.diagonal(axis1=1, axis2=2))
    excess = np.maximum(box.lower - states, states - box.upper).max(axis=1)
    broken = excess > 0
    planned_excess = np.maximum(box.lower - means, means - box.upper)
    # of the program's own promise; NaN where nothing was solved
    margin = (box.standard_deviations() * std + planned_excess).max(axis=1)
    at_bound = np.abs(margin) <= AT_BOUND
    return {
        "violations": [int(broken.sum()), len(states)],
        "at_bound": [int((broken & at_bound).sum()), int(at_bound.sum())],
        "paid": int((margin > AT_BOUND).sum()),
        "worst": float(excess.max()),
    }


def _curves(
    rollout: Rollout,
    condition: Condition,
    states: np.ndarray,
    references: np.ndarray,
) -> dict[str, list]:
    """Returns the curves that are drawn, states in the units of the data."""
    curves = {"states": states, "references": references, "inputs": rollout.inputs}
    if rollout.covariances.any():
        std = np.sqrt(rollout.covariances.diagonal(axis1=1, axis2=2))
        curves["deviations"] = std * condition.scaling.factor.numpy()
    reference_inputs = condition.reference.inputs
    if reference_inputs is not None:
        curves["reference_inputs"] = reference_inputs[: condition.steps]
    return {name: np.round(values, 9).tolist() for name, values in curves.items()}
