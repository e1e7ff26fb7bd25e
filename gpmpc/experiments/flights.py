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
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gpmpc
from gpmpc.control.controller import Controller, Reference
from gpmpc.control.convex_mpc import ConvexMPC
from gpmpc.control.nmpc import NMPC
from gpmpc.control.nonlinear_mpc import NonlinearGPMPC
from gpmpc.control.tracking import StateBounds, TrackingProblem
from gpmpc.datasets import DataSource
from gpmpc.exceptions import DataError, GpmpcError, SettingError, check_number
from gpmpc.experiments.tables import FitStore, Subsystem, digest
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Scaling, Transitions
from gpmpc.gp.posterior import GPPosterior
from gpmpc.metrics import tracking_error, violation_rate
from gpmpc.parallel import in_processes
from gpmpc.plants import Plant
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.simulation import ModelLoop, Noise, Rollout, closed_loop
from gpmpc.simulation.loop import window
from gpmpc.trajectories import Trajectory, states_along

PROPAGATIONS = {"moment_matching": MomentMatching, "linearization": Linearization}
CONTROLLERS = {"nmpc": NMPC, "nonlinear": NonlinearGPMPC, "convex": ConvexMPC}
LOOPS = ("model", "plant")
SOURCES = ("*.py", "control/*.py", "gp/*.py", "propagation/*.py", "fused/*.py", "qp/*.py", "simulation/*.py")
SOURCES += ("datasets/*.py", "plants/*.py", "experiments/flights.py")
ALL = 0  # ``size`` of a row that learns from all samples


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
        data: What the GP learned from: a name in ``Flights.data``.
        size: Training transitions, or several; 0 for all.
        confidence: eta of the state bounds of the trajectory, or several; None without state bounds.
        subsystems: Which are flown; the plant in the loop is translational.
        trials: Seeds, for plants; None takes the experiment's.
        settings: Further arguments of the controller.

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
    data: str = "data"
    size: Any = ALL
    confidence: Any = None
    subsystems: Sequence[str] = ("translational",)
    trials: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        known = (("loop", LOOPS), ("controller", CONTROLLERS), ("propagation", PROPAGATIONS))
        for key, possible in known:
            if getattr(self, key) not in possible:
                raise SettingError(key, f"must be one of {', '.join(possible)}; got {getattr(self, key)!r}")
        if self.loop == "model" and self.controller == "nmpc":
            raise SettingError("controller", "nmpc knows the true plant and needs it in the loop; got loop model")
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


@dataclass(frozen=True)
class Flights:
    """The whole experiment.

    Attributes:
        rows: By name.
        data: Where transitions come from, by name; ``data`` is that of the paper's reading.
        trajectories: By name.
        subsystems: By name.
        model: From transitions and a ``seed`` to a ``Training``.
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
        SettingError: A number out of range, no rows, or rows that name data that are not there.
    """

    rows: Mapping[str, Row]
    data: Mapping[str, DataSource]
    trajectories: Mapping[str, Trajectory]
    subsystems: Mapping[str, Subsystem]
    model: Callable[..., Any]
    model_settings: Any
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

    def flights(self, folder: Path, progress: Callable[[str], None] = lambda _: None) -> list[Flight]:
        """Every flight of the experiment, its GPs trained; trained ones are kept in ``folder``.

        Raises:
            DataError: The data cannot be read, or are fewer than are asked for.
            TrainingError: GPs could not be trained.
        """
        flights = []
        for name, template in self.rows.items():
            for trajectory, row in itertools.product(self.trajectories, template.variants()):
                for subsystem in row.subsystems if row.loop == "model" else ("translational",):
                    progress(f"{name}, {trajectory} {subsystem}")
                    task = self._task(row, trajectory, subsystem, folder)
                    trials = 1 if row.loop == "model" else row.trials or self.trials
                    flights += [self._flight(name, row, trajectory, subsystem, t, task) for t in range(trials)]
        return flights

    def _flight(self, name: str, row: Row, trajectory: str, subsystem: str, trial: int, task: Task) -> Flight:
        # All rows meet the same seeds: their differences are paired.
        seed = int(np.random.SeedSequence([self.seed, trial]).generate_state(1)[0])
        described = [asdict(row), trajectory, subsystem, seed, repr(task.plant), task.noise, task.steps]
        described += [str(task.posterior and task.posterior.name), list(task.lower), list(task.upper)]
        described += [_plain(task.state_lower), _plain(task.state_upper)]
        arrays = [task.reference.states, task.reference.inputs, task.scaling.factor.numpy()]
        content = [json.dumps(described, sort_keys=True, default=str).encode()]
        content += [np.ascontiguousarray(array).tobytes() for array in arrays if array is not None]
        return Flight(name, row, trajectory, subsystem, trial, seed, task, digest(_source(), *content))

    def _task(self, row: Row, trajectory: str, subsystem: str, folder: Path) -> Task:
        n_ahead = self.steps + row.horizon
        state_bounds = self.state_bounds.get(trajectory) if row.confidence is not None else None
        shared = {
            "state_lower": None if state_bounds is None else _infinite(state_bounds["lower"], -np.inf),
            "state_upper": None if state_bounds is None else _infinite(state_bounds["upper"], np.inf),
            "plant": self.plant,
            "noise": self.noise,
            "steps": self.steps,
        }
        size = row.size or self.samples
        if row.loop == "plant":
            box = self.bounds["plant"]
            data = None
            if row.controller != "nmpc":
                data = self._transitions(row.data, trajectory, subsystem, max(size, self.samples))
                data = data[_subset(len(data), size, self.seed)]
            times = self.plant.time_step * np.arange(n_ahead + 1)
            reference = Reference(states_along(self.trajectories[trajectory], times))
            unscaled = Scaling(torch.zeros(6), torch.ones(6))
            posterior = None if data is None else self._trained(data, folder)
            return Task(posterior, reference, unscaled, box["lower"], box["upper"], **shared)
        data = self._transitions(row.data, trajectory, subsystem, max(self.samples, n_ahead))
        part, n, m = self.subsystems[subsystem], data.state_dim, data.input_dim
        # States and next states share one scaling, so that a prediction can be fed back in.
        visited = torch.cat([data.states, data.next_states[-1:]])
        states, inputs = part.scaling(visited, part.columns[:n]), part.scaling(data.inputs, part.columns[n : n + m])
        learned = Transitions(states.scale(data.states), inputs.scale(data.inputs), states.scale(data.next_states))
        reference = Reference(states.scale(visited)[: n_ahead + 1].numpy(), learned.inputs[:n_ahead].numpy())
        chosen = _subset(self.samples, size, self.seed)
        box = self.bounds["model"].get(subsystem) or self.bounds["model"][trajectory]
        return Task(self._trained(learned[chosen], folder), reference, states, box["lower"], box["upper"], **shared)

    def _transitions(self, name: str, trajectory: str, subsystem: str, count: int) -> Transitions:
        source = self.data[name]
        return _transitions(replace(source, samples=count), self.trajectories[trajectory], trajectory, subsystem)

    def _trained(self, data: Transitions, folder: Path) -> Path:
        settings = json.dumps([self.model_settings, self.seed], sort_keys=True).encode()
        name = digest(settings, data.features.numpy().tobytes(), data.next_states.numpy().tobytes())
        path = folder / "models" / f"{name}.npz"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            self.model(data, seed=self.seed).posterior.save(path)
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


def controller_of(row: Row, task: Task) -> Controller:
    """The controller of a row, for one flight."""
    bounds, limits = {}, None
    if row.bounded:
        bounds = {"input_lower": task.lower, "input_upper": task.upper}
    settings = dict(row.settings)
    if task.state_lower is not None:
        prices = {key: settings.pop(key) for key in ("l1", "l2") if key in settings}
        limits = StateBounds(task.state_lower, task.state_upper, confidence=row.confidence, **prices)
    problem = TrackingProblem(row.Q, row.R, row.penalized, state_bounds=limits, **bounds)
    known = task.reference.inputs
    at_first = np.array([task.plant.dynamics.mass * 9.81, 0.0, 0.0]) if known is None else known[0]
    at_first = np.clip(at_first, problem.input_lower, problem.input_upper)
    if row.controller == "nmpc":
        return NMPC(task.plant, problem, row.horizon, at_first, **settings)
    model, propagator = _loaded(task.posterior), PROPAGATIONS[row.propagation]()
    return CONTROLLERS[row.controller](model, propagator, problem, row.horizon, at_first, **settings)


def fly(flight: Flight) -> dict:
    """Flies one flight, in a worker process."""
    torch.set_num_threads(1)
    row, task = flight.row, flight.task
    record = {key: getattr(flight, key) for key in ("name", "trajectory", "subsystem", "trial", "seed")}
    record |= {key: getattr(row, key) for key in ("loop", "controller", "horizon", "size", "confidence", "bounded")}
    try:
        controller = controller_of(row, task)
        if row.loop == "model":
            system = ModelLoop(_loaded(task.posterior), MomentMatching())
            noise = None
        else:
            system, noise = task.plant, Noise(process=[task.noise] * 6)
        start = task.reference.states[0]
        first = window(task.reference, 0, row.horizon)
        for _ in range(2):  # what is compiled or loaded at a first call is no part of the times
            controller.control(Gaussian.certain(start), first)
        rollout = closed_loop(
            system, controller, task.reference, start, task.steps,
            noise=noise, on_failure="previous_plan", seed=flight.seed,
        )  # fmt: skip
    except GpmpcError as error:  # of this flight; the others go on
        return record | {"error": str(error)}
    return record | _measured(rollout, flight)


def _measured(rollout: Rollout, flight: Flight) -> dict:
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
    if task.state_lower is not None:
        lower, upper = np.asarray(task.state_lower), np.asarray(task.state_upper)
        asked = rollout.references[1:]
        outside = (rollout.states[1:] < lower) | (rollout.states[1:] > upper)
        pressed = (asked < lower) | (asked > upper)  # where the reference itself breaks the bound
        measured["violations"] = [int(outside.any(axis=1).sum()), len(outside)]
        measured["pressed"] = [int((outside & pressed).any(axis=1).sum()), int(pressed.any(axis=1).sum())]
        measured["worst"] = float(np.maximum(lower - rollout.states[1:], rollout.states[1:] - upper).max())
    if flight.trial == 0:  # the one that is drawn
        shown = {"states": states, "references": references, "inputs": rollout.inputs}
        if rollout.covariances.any():
            shown["deviations"] = np.sqrt(rollout.covariances.diagonal(axis1=1, axis2=2)) * scale.factor.numpy()
        if task.reference.inputs is not None:
            shown["reference_inputs"] = task.reference.inputs[: task.steps]
        measured["drawn"] = {key: np.round(value, 6).tolist() for key, value in shown.items()}
        measured["bounds"] = [list(task.lower), list(task.upper)]
    return measured


@lru_cache(maxsize=8)
def _loaded(path: Path) -> GPPosterior:
    return GPPosterior.load(path)


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


def _several(value: Any) -> list:
    return list(value) if isinstance(value, list | tuple) else [value]


def _infinite(values: Sequence[float | None], absent: float) -> list[float]:
    return [absent if value is None else float(value) for value in values]


def _plain(values: Sequence[float] | None) -> list[str] | None:
    return None if values is None else [f"{value:g}" for value in values]


@lru_cache(maxsize=1)
def _source() -> bytes:
    """The code that a flight's numbers come from: what other code flew is not taken for finished."""
    package = Path(gpmpc.__file__).parent
    return b"".join(path.read_bytes() for pattern in SOURCES for path in sorted(package.glob(pattern)))
