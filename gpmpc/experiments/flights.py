"""Figures 2 to 4 and section 5.2 of Cao, Lai and Alam (2017): how closely the controllers track, and what a step takes.

Two things can stand at the other end of the loop, and every row says which one did.

* ``model``: the paper's reading. The next state is the GP's own prediction, its covariance carried on from 0.1^2 I; the
  references are the states of the NMPC flight that the GP learned from, and inputs are weighed by their deviation from
  that flight's. The rotational subsystem lives in scaled units. Nothing here says how a vehicle flies.
* ``plant``: the integrated plant with process noise, many seeds, a GP that learned from dithered flights.

A *row* is one controller with its settings; lists of horizons, training sizes or confidences make several rows of it.
One *flight* is a row on one trajectory with one seed. Flights are independent; they run in worker processes of one
thread each, and every finished one is appended to ``flights.jsonl`` under the fingerprint of all that it depends on, so
a run that was killed goes on where it stopped.
"""

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gpmpc
from gpmpc.datasets import DataSource
from gpmpc.exceptions import DataError, SettingError, check_number
from gpmpc.experiments.flight import Flight, Row, Task, fly, problem_of
from gpmpc.experiments.tables import FitStore, Subsystem, digest
from gpmpc.gp import Scaling, Transitions, save_posterior
from gpmpc.mpc.controller import Reference
from gpmpc.parallel import in_processes
from gpmpc.systems import Plant, Translational
from gpmpc.trajectories import Trajectory, states_along

SOURCES = ("gaussian.py", "metrics.py", "control/*.py", "gp/*.py", "propagation/*.py", "fused/*.py", "qp/*.py")
SOURCES += ("simulation/*.py", "datasets/*.py", "plants/*.py", "experiments/flight.py", "experiments/flights.py")


@dataclass(frozen=True)
class Flights:
    """The whole experiment.

    Attributes:
        rows: By name.
        data: Where transitions come from, by name; ``data`` is that of the paper's reading.
        trajectories: By name.
        subsystems: By name.
        models: By loop: from transitions and a ``seed`` to a ``Training``.
        model_settings: The same as plain data, for the fingerprint.
        plant: The translational plant in the loop.
        bounds: Input bounds ``{lower, upper}`` by loop, then (``model``) by subsystem or trajectory.
        state_bounds: State bounds ``{lower, upper}`` by trajectory, for rows with a confidence; null is no bound.
        steps: Of a flight.
        samples: Transitions that a GP learns from.
        trials: Seeds of the plant in the loop.
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
    subsystems: Mapping[str, Subsystem]
    models: Mapping[str, Callable[..., Any]]
    model_settings: Mapping[str, Any]
    plant: Plant
    bounds: Mapping[str, Any]
    state_bounds: Mapping[str, Any]
    steps: int = 189
    samples: int = 189
    trials: int = 50
    noise: float = 0.01
    seed: int = 0
    workers: int | None = None

    def __post_init__(self) -> None:
        for key, least in (("steps", 1), ("samples", 2), ("trials", 1), ("seed", 0)):
            check_number(key, getattr(self, key), least=least, whole=True)
        check_number("noise", self.noise, least=0)
        if self.workers is not None:
            check_number("workers", self.workers, least=1, whole=True)
        for key, chosen in (("rows", self.rows), ("trajectory", self.trajectories)):
            if not chosen:
                raise SettingError(key, "choose at least one")
        for name, row in self.rows.items():
            if row.data not in self.data:
                raise SettingError(f"rows.{name}.data", f"must be one of {', '.join(self.data)}; got {row.data!r}")
        if tuple(self.plant.dynamics.state_names) != Translational.state_names:
            names = ", ".join(self.plant.dynamics.state_names)
            raise SettingError("plant", f"must have the states of the translational subsystem; got {names}")
        for _, row, trajectory, subsystem in self._flown():
            problem_of(row, *self._bounds(row, trajectory, subsystem))
        if not self._flown():
            chosen = ", ".join(self.subsystems) or "none"
            raise SettingError("subsystem", f"no row flies it in the chosen loops; got {chosen}")

    def _flown(self) -> list[tuple[str, Row, str, str]]:
        """Name, row, trajectory and subsystem of everything that is flown, each once a trial."""
        return [
            (name, row, trajectory, subsystem)
            for name, template in self.rows.items()
            for trajectory, row in itertools.product(self.trajectories, template.variants())
            for subsystem in (row.subsystems if row.loop == "model" else ("translational",))
            if subsystem in self.subsystems
        ]

    def flights(self, folder: Path, progress: Callable[[str], None] = lambda _: None) -> list[Flight]:
        """Every flight of the experiment, its GPs trained; trained ones are kept in ``folder``.

        Raises:
            DataError: The data cannot be read, or are fewer than are asked for.
            TrainingError: GPs could not be trained.
        """
        flown, flights = self._flown(), []
        for _, row, trajectory, subsystem in flown:  # what the data do not hold is found out before any training
            self._data(row, trajectory, subsystem)
        for name, row, trajectory, subsystem in flown:
            progress(f"{name}, {trajectory} {subsystem}")
            task = self._task(row, trajectory, subsystem, folder)
            trials = 1 if row.loop == "model" else row.trials or self.trials
            flights += [self._flight(name, row, trajectory, subsystem, t, task) for t in range(trials)]
        return flights

    def _flight(self, name: str, row: Row, trajectory: str, subsystem: str, trial: int, task: Task) -> Flight:
        # All rows meet the same seeds: their differences are paired.
        seed = int(np.random.SeedSequence([self.seed, trial]).generate_state(1)[0])
        described = [name, asdict(row), trajectory, subsystem, seed, repr(task.plant), task.noise, task.steps]
        described += [str(task.posterior and task.posterior.name), list(task.lower), list(task.upper)]
        described += [_plain(task.state_lower), _plain(task.state_upper)]
        arrays = [task.reference.states, task.reference.inputs, task.scaling.factor.numpy()]
        content = [json.dumps(described, sort_keys=True, default=str).encode()]
        content += [np.ascontiguousarray(array).tobytes() for array in arrays if array is not None]
        return Flight(name, row, trajectory, subsystem, trial, seed, task, digest(_source(), *content))

    def _bounds(self, row: Row, trajectory: str, subsystem: str) -> tuple[Sequence[float] | None, ...]:
        """Lower and upper bounds of the inputs, then of the states, None where there are none."""
        of_inputs = self.bounds.get(row.loop) or {}
        if row.loop == "model":
            of_inputs = of_inputs.get(subsystem) or of_inputs.get(trajectory) or {}
        of_states = None
        if row.confidence is not None:
            of_states = (self.state_bounds or {}).get(trajectory) or {}
        found = []
        for key, box in (("bounds", of_inputs), ("state_bounds", of_states)):
            if box is not None and not {"lower", "upper"} <= set(box):
                what = f"must hold lower and upper of the {row.loop} on {trajectory}, {subsystem}; got {box or 'none'}"
                raise SettingError(key, what)
            found += [None, None] if box is None else [box["lower"], box["upper"]]
        lower, upper, state_lower, state_upper = found
        if of_states is not None:
            state_lower, state_upper = _infinite(state_lower, -np.inf), _infinite(state_upper, np.inf)
        return lower, upper, state_lower, state_upper

    def _data(self, row: Row, trajectory: str, subsystem: str) -> tuple[Transitions | None, list[int]]:
        """The transitions of a row, None for a controller that knows the plant, and those that its GP learns from."""
        size = row.size or self.samples
        if row.controller == "nmpc":
            return None, []
        if row.loop == "plant":
            data = self._transitions(row.data, trajectory, subsystem, max(size, self.samples))
            return data, _subset(len(data), size, self.seed)
        data = self._transitions(row.data, trajectory, subsystem, max(self.samples, self.steps + row.horizon))
        return data, _subset(self.samples, size, self.seed)

    def _task(self, row: Row, trajectory: str, subsystem: str, folder: Path) -> Task:
        n_ahead = self.steps + row.horizon
        lower, upper, state_lower, state_upper = self._bounds(row, trajectory, subsystem)
        shared = {"lower": lower, "upper": upper, "state_lower": state_lower, "state_upper": state_upper}
        shared |= {"plant": self.plant, "noise": self.noise, "steps": self.steps}
        data, chosen = self._data(row, trajectory, subsystem)
        if row.loop == "plant":
            times = self.plant.time_step * np.arange(n_ahead + 1)
            reference = Reference(states_along(self.trajectories[trajectory], times))
            unscaled = Scaling(torch.zeros(6), torch.ones(6))
            posterior = None if data is None else self._trained(row.loop, data[chosen], folder)
            return Task(posterior, reference, unscaled, **shared)
        part, n, m = self.subsystems[subsystem], data.state_dim, data.input_dim
        # States and next states share one scaling, so that a prediction can be fed back in.
        visited = torch.cat([data.states, data.next_states[-1:]])
        states, inputs = part.scaling(visited, part.columns[:n]), part.scaling(data.inputs, part.columns[n : n + m])
        learned = Transitions(states.scale(data.states), inputs.scale(data.inputs), states.scale(data.next_states))
        reference = Reference(states.scale(visited)[: n_ahead + 1].numpy(), learned.inputs[:n_ahead].numpy())
        return Task(self._trained(row.loop, learned[chosen], folder), reference, states, **shared)

    def _transitions(self, name: str, trajectory: str, subsystem: str, count: int) -> Transitions:
        source = self.data[name]
        return _transitions(replace(source, samples=count), self.trajectories[trajectory], trajectory, subsystem)

    def _trained(self, loop: str, data: Transitions, folder: Path) -> Path:
        settings = json.dumps([self.model_settings[loop], self.seed], sort_keys=True).encode()
        name = digest(settings, data.features.numpy().tobytes(), data.next_states.numpy().tobytes())
        path = folder / "models" / f"{name}.safetensors"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            save_posterior(self.models[loop](data, seed=self.seed).posterior, path)
        return path

    def run(self, store: FitStore, flights: Sequence[Flight], progress: Callable[[dict], None]) -> list[dict]:
        """Flies what the store does not hold yet; ``progress`` is called with every record, found or flown.

        Returns:
            One record a flight, in their order.
        """
        found = {}
        for flight in flights:
            if flight.fingerprint in store.records and flight.fingerprint not in found:
                found[flight.fingerprint] = store.records[flight.fingerprint]
                progress(found[flight.fingerprint])
        missing = [flight for flight in flights if flight.fingerprint not in found]
        with closing(in_processes(fly, missing, self.workers)) as finished:
            for index, record in finished:
                store.append(missing[index].fingerprint, record)
                found[missing[index].fingerprint] = record
                progress(record)
        return [found[flight.fingerprint] for flight in flights]


@lru_cache(maxsize=64)
def _generated(source: str, name: str, subsystem: str) -> list:
    return []


def _transitions(source: DataSource, trajectory: Trajectory, name: str, subsystem: str) -> Transitions:
    """The transitions of a source; flown once a process."""
    kept = _generated(repr(source) + repr(trajectory), name, subsystem)
    if not kept:
        kept.append(source.transitions(name, trajectory, subsystem))
    return kept[0]


def _subset(rows: int, size: int, seed: int) -> list[int]:
    """Which rows a GP of a given size learns from: all, or a random subset, sorted."""
    if size > rows:
        raise DataError(f"size: must be at most {rows}, the transitions at hand; got {size}")
    if size == rows:
        return list(range(rows))
    return np.sort(np.random.default_rng(seed).permutation(rows)[:size]).tolist()


def _infinite(values: Sequence[float | None], absent: float) -> list[float]:
    return [absent if value is None else float(value) for value in values]


def _plain(values: Sequence[float] | None) -> list[str] | None:
    return None if values is None else [f"{value:g}" for value in values]


@lru_cache(maxsize=1)
def _source() -> bytes:
    """The code that a flight's numbers come from: what other code flew is not taken for finished."""
    package = Path(gpmpc.__file__).parent
    return b"".join(path.read_bytes() for pattern in SOURCES for path in sorted(package.glob(pattern)))
