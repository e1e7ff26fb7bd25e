"""Figures 2 to 4 and section 5.2 of Cao, Lai and Alam (2017).

They show how closely the controllers track, and how long a step takes. Two systems can
stand at the other end of the loop, and every row says which one did.

* ``model``: the paper's reading. The next state is the GP's own prediction, its
  covariance carried on from 0.1^2 I; the references are the states of the NMPC flight
  that the GP learned from, and inputs are weighed by their deviation from that
  flight's. The rotational subsystem lives in scaled units. Nothing here says how a
  vehicle flies.
* ``plant``: the integrated plant with process noise, many seeds, a GP that learned from
  dithered flights.

A *row* is one controller with its settings; lists of horizons, training sizes or
confidences make several rows of it. One *trial* is a row on one trajectory with one
seed.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import Field, asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import torch

from gpmpc.datasets import DataSource
from gpmpc.exceptions import SettingError, check_number
from gpmpc.experiments import figures_tables as tables
from gpmpc.experiments.figures_flights import (
    LOOPS,
    PLANT,
    Bounds,
    Condition,
    Row,
    as_list,
    fly,
    tracking_problem,
)
from gpmpc.experiments.subsystems import SCALINGS, SYSTEMS, check_subsystems
from gpmpc.gp import Scaling, Transitions
from gpmpc.mpc import Reference
from gpmpc.studies._document import Document, Table
from gpmpc.studies.study import (
    TrialSpec,
    derived_seed,
    fingerprint,
    random_rows,
    trained_model,
)
from gpmpc.trajectories import Trajectory


class SampledData(DataSource, Protocol):
    """A data source, a dataclass, that is told how many samples to give."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def samples(self) -> int:
        """Number of samples."""
        ...


class Flight(NamedTuple):
    """Everything that is flown with every seed of one row."""

    name: str  # of the row
    row: Row  # one variant of it
    trajectory: str
    subsystem: str


class TrainingData(NamedTuple):
    """Transitions of a trajectory, and those of them that a GP learns from."""

    transitions: Transitions
    chosen: list[int]


@dataclass(frozen=True)
class Figures:
    """The flights of all rows.

    Attributes:
        rows: By name.
        data: Sources of transitions, by name; ``data`` is that of the paper's reading.
        trajectories: By name.
        subsystems: Names, or one.
        models: By loop: from transitions and a ``seed`` to a ``Training``.
        model_settings: The same as plain data, for the fingerprint.
        bounds: Input bounds ``{lower, upper}`` by loop, then (``model``) by subsystem
            or trajectory.
        state_bounds: State bounds ``{lower, upper}`` by trajectory, for rows with a
            confidence; null is no bound.
        steps: Of a flight.
        samples: Transitions that a GP learns from.
        number: Seeds of the plant in the loop.
        noise: Standard deviation of the process noise, every state.
        seed: Every trial's own derives from it.
        workers: Processes; None takes one a core.

    Raises:
        SettingError: A number out of range, nothing to fly, rows that name data that
            are not there, or bounds that a row needs and that are not there or do not
            fit it.
    """

    rows: Mapping[str, Row]
    data: Mapping[str, SampledData]
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
        check_number("steps", self.steps, least=1, whole=True)
        check_number("samples", self.samples, least=2, whole=True)
        check_number("seed", self.seed, least=0, whole=True)
        check_number("trials", self.number, least=1, whole=True)
        check_number("noise", self.noise, least=0)
        if self.workers is not None:
            check_number("workers", self.workers, least=1, whole=True)
        if not self.rows:
            raise SettingError("rows", "choose at least one")
        if not self.trajectories:
            raise SettingError("trajectory", "choose at least one")
        for name, row in self.rows.items():
            if row.data not in self.data:
                raise SettingError(
                    f"rows.{name}.data",
                    f"must be one of {', '.join(self.data)}; got {row.data!r}",
                )
        subsystems = check_subsystems("subsystem", self.subsystems)
        object.__setattr__(self, "subsystems", subsystems)
        for flight in self._flights:
            inputs = self._input_bounds(flight)
            tracking_problem(flight.row, inputs, self._state_bounds(flight))
        if not self._flights:
            names = ", ".join(subsystems)
            rule = "no row flies it in the chosen loops"
            raise SettingError("subsystem", f"{rule}; got {names}")

    @cached_property
    def _flights(self) -> list[Flight]:
        """All flights, but for their seeds."""
        flights = []
        for name, template in self.rows.items():
            variants = template.variants()
            for trajectory, row in itertools.product(self.trajectories, variants):
                subsystems = row.subsystems
                if row.loop == "plant":
                    subsystems = ("translational",)
                for subsystem in subsystems:
                    if subsystem in self.subsystems:
                        flights.append(Flight(name, row, trajectory, subsystem))
        return flights

    @cached_property
    def _transitions(self) -> dict[str, Transitions]:
        """Transitions by their source; each is flown once."""
        return {}

    def trials(self, folder: Path) -> list[TrialSpec]:
        """Returns every flight, its GPs trained; trained ones are kept in ``folder``.

        Raises:
            DataError: The data cannot be read.
            SettingError: The data are fewer than are asked for.
            TrainingError: GPs could not be trained.
        """
        # What the data do not hold is found before any training.
        for flight in self._flights:
            if flight.row.controller != "nmpc":
                self._training_data(flight)
        trials: list[TrialSpec] = []
        for flight in self._flights:
            trials += self._seeds(flight, self._condition(flight, folder))
        return trials

    def _seeds(self, flight: Flight, condition: Condition) -> Iterator[TrialSpec]:
        """Yields the trials of a flight, one for each seed."""
        row = flight.row
        condition_name = self._fingerprint(flight, condition)
        labels = {
            "name": row.title or flight.name,
            "trajectory": flight.trajectory,
            "subsystem": flight.subsystem,
            "loop": row.loop,
            "controller": row.controller,
            "horizon": row.horizon,
            "size": row.size,
            "confidence": row.confidence,
            "bounded": row.bounded,
        }
        count = 1 if row.loop == "model" else row.trials or self.number
        for trial in range(count):
            # All rows have the same seeds: their differences are paired.
            seed = derived_seed(self.seed, trial)
            yield TrialSpec(
                labels=labels | {"trial": trial},
                condition=replace(condition, drawn=trial == 0),
                seed=seed,
                fingerprint=fingerprint([condition_name, trial, seed]),
            )

    def _fingerprint(self, flight: Flight, condition: Condition) -> str:
        """Names everything that the record of a flight depends on, but for its seed."""
        model = condition.model
        state_bounds = condition.states
        settings = [
            flight.name,
            asdict(flight.row),
            flight.trajectory,
            flight.subsystem,
            repr(PLANT),
            self.noise,
            self.steps,
            None if model is None else model.name,
            asdict(condition.inputs),
            None if state_bounds is None else asdict(state_bounds),
        ]
        arrays = [
            condition.reference.states,
            condition.reference.inputs,
            condition.scaling.offset,
            condition.scaling.factor,
        ]
        return fingerprint(settings, arrays)

    def _input_bounds(self, flight: Flight) -> Bounds:
        loop = flight.row.loop
        sides = self.bounds.get(loop) or {}
        if loop == "model":
            sides = sides.get(flight.subsystem) or sides.get(flight.trajectory) or {}
        _check_sides("bounds", sides, flight)
        return Bounds(sides["lower"], sides["upper"])

    def _state_bounds(self, flight: Flight) -> Bounds | None:
        if flight.row.confidence is None:
            return None
        sides = (self.state_bounds or {}).get(flight.trajectory) or {}
        _check_sides("state_bounds", sides, flight)
        return Bounds(
            lower=[-np.inf if low is None else float(low) for low in sides["lower"]],
            upper=[np.inf if high is None else float(high) for high in sides["upper"]],
        )

    def _training_data(self, flight: Flight) -> TrainingData:
        """Returns the transitions that the GP of a flight learns from."""
        row = flight.row
        in_plant = row.loop == "plant"
        size = row.size or self.samples
        # The paper's reading follows the states of the flight that it learned from.
        count = max(self.samples, size if in_plant else self.steps + row.horizon)
        source = replace(self.data[row.data], samples=count)
        trajectory = self.trajectories[flight.trajectory]
        key = f"{source!r} {flight.trajectory} {trajectory!r} {flight.subsystem}"
        if key not in self._transitions:
            self._transitions[key] = source.transitions(
                SYSTEMS[flight.subsystem], trajectory, flight.trajectory
            )
        transitions = self._transitions[key]
        candidates = len(transitions) if in_plant else self.samples
        return TrainingData(transitions, random_rows(candidates, size, self.seed))

    def _condition(self, flight: Flight, folder: Path) -> Condition:
        if flight.row.loop == "plant":
            return self._plant_condition(flight, folder)
        return self._model_condition(flight, folder)

    def _plant_condition(self, flight: Flight, folder: Path) -> Condition:
        """Returns a flight of the plant along the trajectory."""
        row = flight.row
        stages = self.steps + row.horizon + 1
        trajectory = self.trajectories[flight.trajectory]
        model = None
        if row.controller != "nmpc":
            transitions, chosen = self._training_data(flight)
            model = self._trained(row, transitions[chosen], folder)
        return Condition(
            row=row,
            model=model,
            reference=Reference(PLANT.reference_states(trajectory, stages)),
            scaling=Scaling(torch.zeros(6), torch.ones(6)),
            inputs=self._input_bounds(flight),
            states=self._state_bounds(flight),
            noise=self.noise,
            steps=self.steps,
        )

    def _model_condition(self, flight: Flight, folder: Path) -> Condition:
        """Returns a flight of the GP itself along the flight that it learned from."""
        row = flight.row
        final_step = self.steps + row.horizon
        transitions, chosen = self._training_data(flight)
        system = SYSTEMS[flight.subsystem]
        scaling = SCALINGS[flight.subsystem]
        # States and next states share one scaling: a prediction can be fed back in.
        visited = torch.cat([transitions.states, transitions.next_states[-1:]])
        states = scaling(visited, system.state_names)
        inputs = scaling(transitions.inputs, system.input_names)
        scaled = Transitions(
            states.scale(transitions.states),
            inputs.scale(transitions.inputs),
            states.scale(transitions.next_states),
        )
        reference = Reference(
            states.scale(visited)[: final_step + 1].numpy(),
            scaled.inputs[:final_step].numpy(),
        )
        return Condition(
            row=row,
            model=self._trained(row, scaled[chosen], folder),
            reference=reference,
            scaling=states,
            inputs=self._input_bounds(flight),
            states=self._state_bounds(flight),
            noise=self.noise,
            steps=self.steps,
        )

    def _trained(self, row: Row, transitions: Transitions, folder: Path) -> Path:
        """Returns the file of GPs that learned from some transitions."""
        settings = self.model_settings[row.loop]
        train = self.models[row.loop]
        return trained_model(train, settings, transitions, self.seed, folder)

    @staticmethod
    def run_trial(trial: TrialSpec) -> dict:
        """Flies one trial and measures it."""
        return fly(trial.condition, trial.seed)

    def summary(self, records: Sequence[dict]) -> tuple[list[Table], list[str]]:
        """Returns the tables for a terminal, and the notes below them."""
        return tables.summary(tables.summarise(records), self.data["data"].note)

    def document(self, records: Sequence[dict]) -> Document:
        """Returns the tables and figures."""
        rows = tables.summarise(records)
        return tables.document(rows, records, self.data["data"].note)


def _check_sides(key: str, sides: Mapping[str, Any], flight: Flight) -> None:
    """Raises ``SettingError`` unless there are a lower and an upper side."""
    if not {"lower", "upper"} <= set(sides):
        place = f"{flight.row.loop} on {flight.trajectory}, {flight.subsystem}"
        rule = f"must hold lower and upper of the {place}"
        raise SettingError(key, f"{rule}; got {sides or 'none'}")


def from_settings(
    objects: Mapping[str, Any], settings: Mapping[str, Any], flight: Any
) -> Figures:
    """Makes the flights that ``conf/figures.yaml`` describes.

    Args:
        objects: The settings, with objects in the place of what names a class.
        settings: The same as plain data.
        flight: Not needed.

    Raises:
        SettingError: An unknown loop, or a row with an unknown setting.
    """
    loops = as_list(settings["loop"])
    for loop in loops:
        if loop not in LOOPS:
            raise SettingError(
                "loop", f"must be among {', '.join(LOOPS)}; got {loop!r}"
            )
    rows = {}
    for name, row_settings in settings["rows"].items():
        if row_settings is None:  # left out on the command line
            continue
        row = _read_row(name, row_settings)
        if row.loop in loops:
            rows[name] = row
    return Figures(
        rows=rows,
        data={key: objects[key] for key in ("data", "excited", "undithered")},
        trajectories=objects["trajectory"],
        subsystems=objects["subsystem"],
        models={"model": objects["model"], "plant": objects["flying"]},
        model_settings={"model": settings["model"], "plant": settings["flying"]},
        bounds=settings["bounds"],
        state_bounds=settings["state_bounds"],
        steps=settings["steps"],
        samples=settings["samples"],
        number=settings["trials"],
        noise=settings["noise"],
        seed=settings["seed"],
        workers=settings["workers"],
    )


def _read_row(name: str, settings: Mapping[str, Any]) -> Row:
    try:
        return Row(**settings)
    except TypeError as error:
        message = str(error).removeprefix("Row.__init__() ")
        raise SettingError(f"rows.{name}", message) from error
