"""Figures 2 to 4 and section 5.2 of Cao, Lai and Alam (2017): how closely the controllers track, and what a step takes.

Two systems can stand at the other end of the loop, and every row says which one did.

* ``model``: the paper's reading. The next state is the GP's own prediction, its covariance carried on from 0.1^2 I; the
  references are the states of the NMPC flight that the GP learned from, and inputs are weighed by their deviation from
  that flight's. The rotational subsystem lives in scaled units. Nothing here says how a vehicle flies.
* ``plant``: the integrated plant with process noise, many seeds, a GP that learned from dithered flights.

A *row* is one controller with its settings; lists of horizons, training sizes or confidences make several rows of it.
One *trial* is a row on one trajectory with one seed.
"""

import inspect
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gpmpc.datasets import DataSource
from gpmpc.exceptions import SettingError, check_number
from gpmpc.experiments import figures_tables as tables
from gpmpc.experiments.slsqp import SLSQP
from gpmpc.experiments.subsystems import SCALINGS, SYSTEMS, check_subsystems
from gpmpc.gp import Scaling, Transitions
from gpmpc.metrics import tracking_error, violation_rate
from gpmpc.mpc import Controller, PredictionSettings, Reference
from gpmpc.mpc.baselines import NMPC
from gpmpc.mpc.gp_mpc import GPMPC, NonlinearGPMPC
from gpmpc.mpc.problem import Box, Constraint, Problem, Tracking
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.simulation import ModelLoop, Noise, Rollout, closed_loop, rehearse
from gpmpc.studies._document import Document, Table
from gpmpc.studies.study import (
    TrialSpec,
    derived_seed,
    fingerprint,
    random_rows,
    read_model,
    trained_model,
)
from gpmpc.systems import GRAVITY
from gpmpc.trajectories import Trajectory

PROPAGATIONS = {"moment_matching": MomentMatching, "linearization": Linearization}
CONTROLLERS = {
    "nmpc": NMPC,
    "nonlinear": NonlinearGPMPC,
    "slsqp": SLSQP,
    "convex": GPMPC,
}
LOOPS = ("model", "plant")
PLANT = SYSTEMS["translational"]  # the plant in the loop
AT_BOUND = 1e-6  # [m, m/s] distance of a plan to a bound that counts as none


@dataclass(frozen=True)
class Row:
    """One controller in one loop.

    Attributes:
        loop: ``"model"`` or ``"plant"``.
        controller: ``"nmpc"`` (on the true plant), ``"nonlinear"`` or ``"convex"``.
        R: Input weights, the diagonal (m,).
        Q: State weights, the diagonal (n,).
        penalized: What R weighs; see ``Tracking``.
        bounded: Whether the inputs are bounded.
        horizon: H, or several.
        propagation: ``"moment_matching"`` or ``"linearization"``: how the controller's belief moves.
        process_noise: Whether the learned noise counts as part of the predicted state; chance constraints with a
            noisy plant in the loop need it.
        data: What the GP learned from: a name in ``Figures.data``.
        size: Training transitions, or several; 0 for all.
        confidence: eta of the state bounds of the trajectory, or several; None without state bounds.
        subsystems: Which are flown; the plant in the loop is translational.
        trials: Seeds, for plants; None takes the study's.
        settings: Further arguments of the controller, and the ``penalty`` of state bounds that cannot be kept.
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
    size: Any = 0
    confidence: Any = None
    subsystems: Sequence[str] = ("translational",)
    trials: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    title: str = ""

    def __post_init__(self) -> None:
        known = (
            ("loop", LOOPS),
            ("controller", CONTROLLERS),
            ("propagation", PROPAGATIONS),
        )
        for key, possible in known:
            if getattr(self, key) not in possible:
                raise SettingError(
                    key,
                    f"must be one of {', '.join(possible)}; got {getattr(self, key)!r}",
                )
        if self.loop == "model" and self.controller == "nmpc":
            raise SettingError(
                "controller",
                "nmpc knows the true plant and needs it in the loop; got loop model",
            )
        parameters = {
            *inspect.signature(CONTROLLERS[self.controller]).parameters,
            "penalty",
        }
        for key in self.settings:
            if key not in parameters:
                raise SettingError(
                    f"settings.{key}",
                    f"controller {self.controller} takes no such setting",
                )
        check_subsystems("subsystems", self.subsystems)
        for key, least in (("horizon", 1), ("size", 0)):
            for value in _several(getattr(self, key)):
                check_number(key, value, least=least, whole=True)

    def variants(self) -> list["Row"]:
        """Returns one row for every combination of the settings that are given as lists."""
        keys = ("horizon", "size", "confidence")
        combinations = itertools.product(
            *(_several(getattr(self, key)) for key in keys)
        )
        return [
            replace(self, **dict(zip(keys, values, strict=True)))
            for values in combinations
        ]


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds; None leaves an entry free."""

    lower: Sequence[float]
    upper: Sequence[float]


@dataclass(frozen=True)
class Condition:
    """What a trial needs besides its seed.

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
        problem = tracking_problem(self.row, self.inputs, self.states)
        settings = {
            key: value for key, value in row.settings.items() if key != "penalty"
        }
        if "prediction" in settings:
            settings["prediction"] = PredictionSettings(**settings["prediction"])
        known = self.reference.inputs
        at_first = (
            np.array([PLANT.dynamics.mass * GRAVITY, 0.0, 0.0])
            if known is None
            else known[0]
        )
        at_first = np.clip(at_first, problem.inputs.lower, problem.inputs.upper)
        if self.model is None:
            return NMPC(PLANT, problem, row.horizon, at_first, **settings)
        propagator = PROPAGATIONS[row.propagation](process_noise=row.process_noise)
        make = CONTROLLERS[row.controller]
        return make(
            read_model(self.model),
            propagator,
            problem,
            row.horizon,
            at_first,
            **settings,
        )


@dataclass(frozen=True)
class Figures:
    """The flights of all rows.

    Attributes:
        rows: By name.
        data: Where transitions come from, by name; ``data`` is that of the paper's reading.
        trajectories: By name.
        subsystems: Names, or one.
        models: By loop: from transitions and a ``seed`` to a ``Training``.
        model_settings: The same as plain data, for the fingerprint.
        bounds: Input bounds ``{lower, upper}`` by loop, then (``model``) by subsystem or trajectory.
        state_bounds: State bounds ``{lower, upper}`` by trajectory, for rows with a confidence; null is no bound.
        steps: Of a flight.
        samples: Transitions that a GP learns from.
        number: Seeds of the plant in the loop.
        noise: Standard deviation of the process noise, every state.
        seed: Every trial's own derives from it.
        workers: Processes; None takes one a core.

    Raises:
        SettingError: A number out of range, nothing to fly, rows that name data that are not there, or bounds that a
            row needs and that are not there or do not fit it.
    """

    rows: Mapping[str, Row]
    data: Mapping[str, DataSource]
    trajectories: Mapping[str, Trajectory]
    subsystems: Sequence[str]
    models: Mapping[str, Callable[..., Any]]
    model_settings: Mapping[str, Any]
    bounds: Mapping[str, Any]
    state_bounds: Mapping[str, Any]
    steps: int = 189
    samples: int = 189
    number: int = 50
    noise: float = 0.01
    seed: int = 0
    workers: int | None = None

    name = "figures"
    trial_name = "flights"
    lost_is_result = True

    def __post_init__(self) -> None:
        for key, least in (("steps", 1), ("samples", 2), ("seed", 0)):
            check_number(key, getattr(self, key), least=least, whole=True)
        check_number("trials", self.number, least=1, whole=True)
        check_number("noise", self.noise, least=0)
        check_number(
            "workers", 1 if self.workers is None else self.workers, least=1, whole=True
        )
        for key, chosen in (("rows", self.rows), ("trajectory", self.trajectories)):
            if not chosen:
                raise SettingError(key, "choose at least one")
        for name, row in self.rows.items():
            if row.data not in self.data:
                raise SettingError(
                    f"rows.{name}.data",
                    f"must be one of {', '.join(self.data)}; got {row.data!r}",
                )
        object.__setattr__(
            self, "subsystems", check_subsystems("subsystem", self.subsystems)
        )
        for _, row, trajectory, subsystem in self._flown:
            tracking_problem(row, *self._bounds(row, trajectory, subsystem))
        if not self._flown:
            raise SettingError(
                "subsystem",
                f"no row flies it in the chosen loops; got {', '.join(self.subsystems)}",
            )

    @cached_property
    def _flown(self) -> list[tuple[str, Row, str, str]]:
        """Name, row, trajectory and subsystem of everything that is flown with every seed."""
        return [
            (name, row, trajectory, subsystem)
            for name, template in self.rows.items()
            for trajectory, row in itertools.product(
                self.trajectories, template.variants()
            )
            for subsystem in (
                row.subsystems if row.loop == "model" else ("translational",)
            )
            if subsystem in self.subsystems
        ]

    @cached_property
    def _flights(self) -> dict[str, Transitions]:
        """Transitions by their source; each is flown once."""
        return {}

    def trials(self, folder: Path) -> list[TrialSpec]:
        """Returns every flight, its GPs trained; trained ones are kept in ``folder``.

        Raises:
            DataError: The data cannot be read.
            SettingError: The data are fewer than are asked for.
            TrainingError: GPs could not be trained.
        """
        for (
            _,
            row,
            trajectory,
            subsystem,
        ) in self._flown:  # what the data do not hold is found before any training
            self._data(row, trajectory, subsystem)
        trials = []
        for name, row, trajectory, subsystem in self._flown:
            condition = self._condition(row, trajectory, subsystem, folder)
            reference = condition.reference
            bounds = [condition.inputs, condition.states]
            settings = [
                name,
                asdict(row),
                trajectory,
                subsystem,
                repr(PLANT),
                self.noise,
                self.steps,
            ]
            settings += [
                condition.model and condition.model.name,
                *(box and asdict(box) for box in bounds),
            ]
            scaling = condition.scaling
            arrays = [
                reference.states,
                reference.inputs,
                scaling.offset,
                scaling.factor,
            ]
            named = fingerprint(settings, arrays)
            labels = {
                "name": row.title or name,
                "trajectory": trajectory,
                "subsystem": subsystem,
            }
            labels |= {
                k: getattr(row, k)
                for k in (
                    "loop",
                    "controller",
                    "horizon",
                    "size",
                    "confidence",
                    "bounded",
                )
            }
            for trial in range(1 if row.loop == "model" else row.trials or self.number):
                seed = derived_seed(
                    self.seed, trial
                )  # all rows have the same seeds: their differences are paired
                flown = replace(condition, drawn=trial == 0)
                trials.append(
                    TrialSpec(
                        labels | {"trial": trial},
                        flown,
                        seed,
                        fingerprint([named, trial, seed]),
                    )
                )
        return trials

    def _bounds(
        self, row: Row, trajectory: str, subsystem: str
    ) -> tuple[Bounds, Bounds | None]:
        """Returns the bounds of the inputs and of the states."""
        of_inputs = self.bounds.get(row.loop) or {}
        if row.loop == "model":
            of_inputs = of_inputs.get(subsystem) or of_inputs.get(trajectory) or {}
        of_states = (
            None
            if row.confidence is None
            else (self.state_bounds or {}).get(trajectory) or {}
        )
        for key, box in (("bounds", of_inputs), ("state_bounds", of_states)):
            if box is not None and not {"lower", "upper"} <= set(box):
                what = f"must hold lower and upper of the {row.loop} on {trajectory}, {subsystem}; got {box or 'none'}"
                raise SettingError(key, what)
        if of_states is not None:
            absent = {"lower": -np.inf, "upper": np.inf}
            of_states = Bounds(
                **{
                    k: [absent[k] if v is None else float(v) for v in of_states[k]]
                    for k in absent
                }
            )
        return Bounds(of_inputs["lower"], of_inputs["upper"]), of_states

    def _data(
        self, row: Row, trajectory: str, subsystem: str
    ) -> tuple[Transitions | None, list[int]]:
        """Returns the transitions of a row, and those that its GP learns from; None for the true model's controller."""
        if row.controller == "nmpc":
            return None, []
        size = row.size or self.samples
        needed = self.samples
        count = max(needed, size if row.loop == "plant" else self.steps + row.horizon)
        source = replace(self.data[row.data], samples=count)
        key = f"{source!r} {trajectory} {self.trajectories[trajectory]!r} {subsystem}"
        if key not in self._flights:
            self._flights[key] = source.transitions(
                SYSTEMS[subsystem], self.trajectories[trajectory], trajectory
            )
        data = self._flights[key]
        return data, random_rows(
            len(data) if row.loop == "plant" else needed, size, self.seed
        )

    def _condition(
        self, row: Row, trajectory: str, subsystem: str, folder: Path
    ) -> Condition:
        def trained(learned: Transitions) -> Path:
            settings = self.model_settings[row.loop]
            return trained_model(
                self.models[row.loop], settings, learned[chosen], self.seed, folder
            )

        n_ahead, (data, chosen) = (
            self.steps + row.horizon,
            self._data(row, trajectory, subsystem),
        )
        rest = {"noise": self.noise, "steps": self.steps}
        bounds = self._bounds(row, trajectory, subsystem)
        if row.loop == "plant":
            reference = Reference(
                PLANT.reference_states(self.trajectories[trajectory], n_ahead + 1)
            )
            unscaled = Scaling(torch.zeros(6), torch.ones(6))
            model = None if data is None else trained(data)
            return Condition(row, model, reference, unscaled, *bounds, **rest)
        system = SYSTEMS[subsystem]
        scaling = SCALINGS[subsystem]
        # States and next states share one scaling, so that a prediction can be fed back in.
        visited = torch.cat([data.states, data.next_states[-1:]])
        states = scaling(visited, system.state_names)
        inputs = scaling(data.inputs, system.input_names)
        learned = Transitions(
            states.scale(data.states),
            inputs.scale(data.inputs),
            states.scale(data.next_states),
        )
        reference = Reference(
            states.scale(visited)[: n_ahead + 1].numpy(),
            learned.inputs[:n_ahead].numpy(),
        )
        return Condition(row, trained(learned), reference, states, *bounds, **rest)

    @staticmethod
    def run_trial(trial: TrialSpec) -> dict:
        """Flies one trial and measures it."""
        condition = trial.condition
        controller = condition.controller()
        reference = condition.reference
        if condition.row.loop == "model":
            system = ModelLoop(
                read_model(condition.model), MomentMatching(process_noise=False)
            )
            noise = None
        else:
            system = PLANT
            noise = Noise(process=[condition.noise] * 6)
        rehearse(system, controller, reference, reference.states[0])
        rollout = closed_loop(
            system, controller, reference, reference.states[0], condition.steps,
            noise=noise, on_failure="previous_plan", seed=trial.seed,
        )  # fmt: skip
        return measure(rollout, condition, controller.problem.constraints)

    def summary(self, records: Sequence[dict]) -> tuple[list[Table], list[str]]:
        """Returns the tables for a terminal."""
        return tables.summary(tables.summarise(records), self.data["data"].note)

    def document(self, records: Sequence[dict]) -> Document:
        """Returns the tables and figures."""
        return tables.document(
            tables.summarise(records), records, self.data["data"].note
        )


def from_settings(
    made: Mapping[str, Any], settings: Mapping[str, Any], flight: Any
) -> Figures:
    """Makes the flights that ``conf/figures.yaml`` describes; arguments as in ``gpmpc.experiments.tables``.

    Raises:
        SettingError: An unknown loop, or a row with an unknown setting.
    """
    loops = _several(settings["loop"])
    rows = {}
    for loop in loops:
        if loop not in LOOPS:
            raise SettingError(
                "loop", f"must be among {', '.join(LOOPS)}; got {loop!r}"
            )
    for name, row in settings["rows"].items():
        if row is not None:  # left out on the command line
            try:
                rows[name] = Row(**row)
            except TypeError as error:
                raise SettingError(
                    f"rows.{name}", str(error).removeprefix("Row.__init__() ")
                ) from error
    numbers = ("bounds", "state_bounds", "steps", "samples", "noise", "seed", "workers")
    return Figures(
        rows={name: row for name, row in rows.items() if row.loop in loops},
        data={key: made[key] for key in ("data", "excited", "undithered")},
        trajectories=made["trajectory"],
        subsystems=made["subsystem"],
        models={"model": made["model"], "plant": made["flying"]},
        model_settings={"model": settings["model"], "plant": settings["flying"]},
        number=settings["trials"],
        **{key: settings[key] for key in numbers},
    )


def tracking_problem(row: Row, inputs: Bounds, states: Bounds | None) -> Problem:
    """Returns the tracking problem of a row."""
    box = Box(inputs.lower, inputs.upper) if row.bounded else Box()
    limits = []
    if states is not None:
        price = row.settings.get("penalty")
        limits = [
            Box(states.lower, states.upper, probability=row.confidence, penalty=price)
        ]
    return Problem(
        Tracking(row.Q, row.R, penalized=row.penalized), box, constraints=limits
    )


def measure(
    rollout: Rollout, condition: Condition, constraints: Sequence[Constraint]
) -> dict:
    """Returns the record of a flight."""
    scale = condition.scaling
    inputs = condition.inputs
    states, references = (
        scale.restore(torch.from_numpy(x)).numpy()
        for x in (rollout.states, rollout.references)
    )
    error = tracking_error(states, references, PLANT.tracked_indices)
    inside = violation_rate(rollout.inputs, inputs.lower, inputs.upper, tolerance=1e-8)
    measured = {
        "rmse": error.axes.tolist(),
        "total": error.total,
        "input_excess": inside.worst if condition.row.bounded else None,
        "failures": [[k, status.name] for k, status in rollout.failures],
        "iterations": float(rollout.iterations.mean()),
        "seconds": np.round(rollout.seconds, 7).tolist(),
    }
    for limits in constraints:
        after = rollout.states[1:]
        expected = rollout.predicted_means
        std = np.sqrt(rollout.predicted_covariances.diagonal(axis1=1, axis2=2))
        beyond = np.maximum(limits.lower - after, after - limits.upper).max(axis=1)
        planned = limits.standard_deviations() * std + np.maximum(
            limits.lower - expected, expected - limits.upper
        )
        margin = planned.max(
            axis=1
        )  # of the program's own promise; NaN where nothing was solved
        at_bound = np.abs(margin) <= AT_BOUND
        measured["violations"] = [int((beyond > 0).sum()), len(after)]
        measured["at_bound"] = [
            int(((beyond > 0) & at_bound).sum()),
            int(at_bound.sum()),
        ]
        measured["paid"] = int((margin > AT_BOUND).sum())
        measured["worst"] = float(beyond.max())
    if condition.drawn:
        shown = {"states": states, "references": references, "inputs": rollout.inputs}
        if rollout.covariances.any():
            shown["deviations"] = (
                np.sqrt(rollout.covariances.diagonal(axis1=1, axis2=2))
                * scale.factor.numpy()
            )
        if condition.reference.inputs is not None:
            shown["reference_inputs"] = condition.reference.inputs[: condition.steps]
        measured["drawn"] = {
            key: np.round(value, 9).tolist() for key, value in shown.items()
        }
        measured["bounds"] = [list(inputs.lower), list(inputs.upper)]
    return measured


def _several(value: Any) -> list:
    return list(value) if isinstance(value, list | tuple) else [value]
