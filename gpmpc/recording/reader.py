"""Problem: a recorded run has to come back as arrays, and any of its decisions has to be repeatable.

``read_run`` reads finished files and unfinished ones alike (all that is whole, see ``records``). A message whose
checksum is right may still come from another program, so the sizes of its arrays are checked. A plan belongs to the
step of its number, wherever it stands. ``replay`` solves a step's quadratic program again: its minimiser is unique, so
any exact solver finds the recorded plan.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Attachment, Channel, Footer, Message, Metadata, Schema

from gpmpc.exceptions import GpmpcError, RecordingError, SettingError
from gpmpc.recording import schemas
from gpmpc.recording.records import room, whole_records
from gpmpc.recording.writer import CONFIG, PLAN, QP, STEP
from gpmpc.status import Status

if TYPE_CHECKING:
    import pandas

    from gpmpc.qp import QPSolution, QPSolver

Array = np.ndarray
RECOVERED = "recovered"  # metadata of a file that holds what was left of another


@dataclass(frozen=True, eq=False)
class Run:
    """K recorded steps; n states, m inputs, horizon H (the longest; NaN beyond a shorter one).

    Attributes:
        path: The file.
        finished: The run was recorded to its end, and every checksum is right; otherwise this is what was saved of it.
        state_names: n names.
        input_names: m names.
        steps: Numbers k of the steps (K,).
        times: [s] (K,).
        references: (K, n).
        states: True states (K, n).
        measured: Measured states (K, n).
        inputs: Applied inputs (K, m).
        input_bounds: Lower and upper bounds (2, m); infinite where none were given.
        innovations: (K, n).
        belief_covariances: (K, n, n).
        plan_inputs: (K, H, m).
        plan_means: (K, H + 1, n).
        plan_stds: (K, H + 1, n).
        plan_covariances: (K, H + 1, n, n).
        statuses: K of them.
        iterations: (K,).
        active_set_sizes: (K,).
        residuals: Primal and dual residual and duality gap of the quadratic program (K, 3); NaN without one.
        timings: Model, build, solve, total [s] (K, 4).
        gp_sizes: (K,).
        gp_versions: (K,).
        failed: Whether the decision was not applied (K,).
        channels: Number of messages and schema by topic.
        metadata: Metadata records by name.
        config: Text of the resolved configuration.
        problems: Messages ``gpmpc.QuadraticProgram`` by k; see ``replay``.
    """

    path: Path
    finished: bool
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    steps: Array
    times: Array
    references: Array
    states: Array
    measured: Array
    inputs: Array
    input_bounds: Array
    innovations: Array
    belief_covariances: Array
    plan_inputs: Array
    plan_means: Array
    plan_stds: Array
    plan_covariances: Array
    statuses: tuple[Status, ...]
    iterations: Array
    active_set_sizes: Array
    residuals: Array
    timings: Array
    gp_sizes: Array
    gp_versions: Array
    failed: Array
    channels: dict[str, tuple[int, str]]
    metadata: dict[str, dict[str, str]]
    config: str
    problems: dict[int, "RecordedProblem"]

    @cached_property
    def columns(self) -> dict[str, Array]:
        """The run as a table: a column (K,) per scalar field of ``gpmpc.Step``, in its order."""
        table: dict[str, Array] = {"time": self.times, "k": self.steps}
        with np.errstate(invalid="ignore"):  # NaN says it
            std = np.sqrt(np.diagonal(self.belief_covariances, axis1=1, axis2=2))
        groups = {"reference": self.references, "state": self.states, "measured": self.measured, "input": self.inputs}
        groups |= {"innovation": self.innovations, "belief_std": std}
        for group, values in groups.items():
            names = self.input_names if group == "input" else self.state_names
            table |= {f"{group}.{name}": values[:, i] for i, name in enumerate(names)}
        table |= {"status": np.array([status.name for status in self.statuses], dtype=object)}
        table |= {"iterations": self.iterations, "active_set_size": self.active_set_sizes}
        table |= {f"timing.{name}": self.timings[:, i] for i, name in enumerate(schemas.TIMING)}
        table |= {f"residuals.{name}": self.residuals[:, i] for i, name in enumerate(schemas.RESIDUALS)}
        return table | {"gp_size": self.gp_sizes, "gp_version": self.gp_versions, "failed": self.failed}

    def to_pandas(self) -> "pandas.DataFrame":
        """``columns`` as a data frame, units in its ``attrs``.

        Raises:
            RecordingError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise RecordingError("data frames need pandas: pip install 'gpmpc[report]'") from error
        frame = pandas.DataFrame(self.columns)
        frame.attrs["units"] = self.metadata.get("units", {})
        return frame


@dataclass(frozen=True, eq=False)
class RecordedProblem:
    """A quadratic program as it was solved; letters as in ``gpmpc.qp``.

    Attributes:
        P: (n, n).
        q: (n,).
        G: (m, n).
        lower: Bounds of the stacked constraints ``[x; Gx]`` (M,).
        upper: (M,).
        softness: 1/rho and the cap of the multiplier of every stacked constraint (2, M).
        x: The solution found then (n,); empty where there was none.
        multipliers: Its multipliers (M,); empty where there was none.
    """

    P: Array
    q: Array
    G: Array
    lower: Array
    upper: Array
    softness: Array
    x: Array
    multipliers: Array


def replay(run: Run, k: int, solver: "QPSolver | None" = None) -> "QPSolution":
    """Solves the quadratic program of step k again.

    Args:
        run: A run recorded with its problems.
        k: Number of the step.
        solver: ``DualActiveSet()`` if omitted, which also takes soft rows.

    Raises:
        RecordingError: The step or its problem is not in the recording, or it is no convex program.
    """
    from gpmpc.qp import DualActiveSet, QuadraticProgram, SoftRows

    recorded = run.problems.get(k)
    if recorded is None:
        raise RecordingError(f"{run.path}: holds no quadratic program of step {k}; it holds {len(run.problems)} others")
    solver = solver if solver is not None else DualActiveSet()
    inverse, caps = recorded.softness[:, len(recorded.q) :]
    try:
        problem = QuadraticProgram.from_stacked(recorded.P, recorded.q, recorded.G, recorded.lower, recorded.upper)
        if not inverse.any() and np.isinf(caps).all():
            return solver.solve(problem)
        with np.errstate(divide="ignore"):
            return solver.solve(problem, soft=SoftRows(quadratic=1 / inverse, linear=caps))
    except GpmpcError as error:
        raise RecordingError(f"{run.path}: step {k}: {error}") from error


def read_run(path: str | Path) -> Run:
    """Reads a recording.

    Args:
        path: A file that ``McapRecorder`` wrote, finished or not.

    Raises:
        RecordingError: There is no such file, or it is no recording of a run.
    """
    path = Path(path)
    metadata: dict[str, dict[str, str]] = {}
    names: dict[int, str] = {}
    channels: dict[int, Channel] = {}
    counts: Counter[int] = Counter()
    messages: dict[str, list] = {STEP: [], PLAN: [], QP: []}
    decoder: _Decoder | None = None
    config, finished = "", False
    for record in whole_records(path):
        if isinstance(record, Message):
            counts[record.channel_id] += 1
            topic = channels[record.channel_id].topic
            if topic in messages:
                if decoder is None and "run" not in metadata:  # another tool has moved them behind the messages
                    metadata |= {more.name: more.metadata for more in whole_records(path) if isinstance(more, Metadata)}
                decoder = decoder or _Decoder(path, metadata)
                messages[topic].append(decoder.decode(topic, record))
        elif isinstance(record, Schema):
            names[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Metadata):
            metadata.setdefault(record.name, record.metadata)
        elif isinstance(record, Attachment) and record.name == CONFIG:
            config = record.data.decode(errors="replace")
        finished = finished or isinstance(record, Footer)
    decoder = decoder or _Decoder(path, metadata)
    states, inputs = decoder.states, decoder.inputs
    return Run(
        path=path,
        finished=finished and RECOVERED not in metadata,
        state_names=states,
        input_names=inputs,
        **_steps(messages[STEP], states, inputs),
        **_plans(path, messages[PLAN], messages[STEP], states, inputs),
        channels={channel.topic: (counts[i], names.get(channel.schema_id, "")) for i, channel in channels.items()},
        metadata=metadata,
        config=config,
        problems=dict(messages[QP]),
    )


class _Decoder:
    """Turns messages into what they say, if it fits the names of states and inputs.

    Args:
        path: The file.
        metadata: Its records.

    Raises:
        RecordingError: They do not tell of a run.
    """

    def __init__(self, path: Path, metadata: dict[str, dict[str, str]]):
        self._path, about = path, metadata.get("run", {})
        if not {"state_names", "input_names"} <= about.keys():
            raise RecordingError(f"{path}: is not the recording of a run; it has no metadata about one")
        try:
            self.states = schemas.check_names("state_names", about["state_names"].split())
            self.inputs = schemas.check_names("input_names", about["input_names"].split())
            classes = schemas.message_classes(self.states, self.inputs, schemas.READ)
        except SettingError as error:
            raise RecordingError(f"{path}: its metadata are damaged; {error}") from error
        self._classes = {STEP: classes[schemas.STEP], PLAN: classes[schemas.PLAN], QP: classes[schemas.QP]}

    def decode(self, topic: str, record: Message) -> Any:
        """The message; of a quadratic program its step's number k and itself.

        Raises:
            RecordingError: It does not parse, or its arrays do not belong together.
        """
        n = len(self.states)
        try:
            message = self._classes[topic].FromString(record.data)
            if topic == QP:
                return message.k, _problem(message)
            if topic == STEP:
                _numbers(message, "belief_covariance", n, n)
                if not 0 <= message.status < len(Status):
                    raise ValueError(f"status {message.status} is unknown")
            elif not message.stages:
                raise ValueError("it has no stage")
            else:
                _numbers(message, "covariances", len(message.stages), n, n)
        except (DecodeError, ValueError) as error:
            raise RecordingError(f"{self._path}: message {record.sequence} of {topic} is damaged: {error}") from error
        return message


def _numbers(message: Any, field: str, *shape: int) -> Array:
    """A field's numbers.

    Raises:
        ValueError: There are more or fewer.
    """
    data = getattr(message, field)
    if min(shape) < 0 or len(data) != 8 * math.prod(shape):
        raise ValueError(f"{field} must be {shape}; got {len(data)} bytes")
    return np.frombuffer(data).reshape(shape)


def _table(messages: list, fields: tuple[str, ...]) -> Array:
    numbers = attrgetter(*fields)
    return np.array([numbers(message) for message in messages], dtype=float).reshape(len(messages), len(fields))


def _steps(steps: list, states: tuple[str, ...], inputs: tuple[str, ...]) -> dict[str, Any]:
    n, statuses = len(states), tuple(Status)
    groups = {"references": "reference", "states": "state", "measured": "measured", "innovations": "innovation"}
    arrays = {name: _table([getattr(step, group) for step in steps], states) for name, group in groups.items()}
    integers = {"steps": "k", "iterations": "iterations", "active_set_sizes": "active_set_size"}
    integers |= {"gp_sizes": "gp_size", "gp_versions": "gp_version"}
    arrays |= {name: np.array([getattr(step, field) for step in steps], int) for name, field in integers.items()}
    covariances = b"".join(step.belief_covariance for step in steps)
    return arrays | {
        "times": np.array([step.time for step in steps], dtype=float),
        "inputs": _table([step.input for step in steps], inputs),
        "input_bounds": _bounds(steps[:1], inputs),
        "belief_covariances": np.frombuffer(covariances).reshape(len(steps), n, n),
        "statuses": tuple(statuses[step.status] for step in steps),
        "residuals": _table([step.residuals for step in steps], schemas.RESIDUALS),
        "timings": _table([step.timing for step in steps], schemas.TIMING),
        "failed": np.array([step.failed for step in steps], dtype=bool),
    }


def _bounds(steps: list, inputs: tuple[str, ...]) -> Array:
    """Of the first step: they are the same in all."""
    if not steps or not steps[0].HasField("input_lower"):
        return np.tile([[-np.inf], [np.inf]], len(inputs))
    return np.concatenate([_table([steps[0].input_lower], inputs), _table([steps[0].input_upper], inputs)])


def _numbered(messages: list) -> Iterator[tuple[int, int]]:
    """Of every message its step's number k and, where a number comes again, the how many'th time it is."""
    seen: Counter[int] = Counter()
    for message in messages:
        seen[message.k] += 1
        yield message.k, seen[message.k]


def _plans(path: Path, plans: list, steps: list, states: tuple[str, ...], inputs: tuple[str, ...]) -> dict[str, Array]:
    H, n, m = max((len(plan.stages) - 1 for plan in plans), default=0), len(states), len(inputs)
    if (needed := 8 * len(steps) * (H + 1) * (n * n + 2 * n + m)) > room(path):
        raise RecordingError(f"{path}: a plan of {H} stages would make arrays of {needed / 1e6:.0f} MB with the others")
    arrays = {
        "plan_inputs": np.full((len(steps), H, m), np.nan),
        "plan_means": np.full((len(steps), H + 1, n), np.nan),
        "plan_stds": np.full((len(steps), H + 1, n), np.nan),
        "plan_covariances": np.full((len(steps), H + 1, n, n), np.nan),
    }
    rows = {key: row for row, key in enumerate(_numbered(steps))}
    for key, plan in zip(_numbered(plans), plans, strict=True):
        if (row := rows.get(key)) is None:
            continue  # the step is lost
        stages = list(plan.stages)
        length = len(stages)
        arrays["plan_means"][row, :length] = _table([stage.mean for stage in stages], states)
        arrays["plan_stds"][row, :length] = _table([stage.std for stage in stages], states)
        arrays["plan_inputs"][row, : length - 1] = _table([stage.input for stage in stages[:-1]], inputs)
        arrays["plan_covariances"][row, :length] = _numbers(plan, "covariances", length, n, n)
    return arrays


def _problem(message: Any) -> RecordedProblem:
    n, M = message.variables, message.variables + message.rows
    shapes = {"P": (n, n), "q": (n,), "G": (message.rows, n), "lower": (M,), "upper": (M,), "softness": (2, M)}
    if message.x or message.multipliers:
        shapes |= {"x": (n,), "multipliers": (M,)}
    else:
        shapes |= {"x": (0,), "multipliers": (0,)}
    return RecordedProblem(**{name: _numbers(message, name, *shape) for name, shape in shapes.items()})
