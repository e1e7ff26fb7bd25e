"""Reads recorded runs as arrays, solves a recorded quadratic program again, and rescues unfinished files.

A message whose checksum is right may come from another program, so the sizes of its arrays are checked.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import (
    Attachment,
    Channel,
    Message,
    Metadata,
    Schema,
    Statistics,
)
from mcap.writer import CompressionType, Writer

from gpmpc._files import whole_file
from gpmpc.exceptions import GpmpcError, RecordingError, SettingError
from gpmpc.recording import _messages
from gpmpc.recording._flaws import (
    DAMAGE,
    DAMAGED_RECORDS,
    LOST_CHUNKS,
    LOST_STEPS,
    NO_CHECKSUMS,
    WRONG_COUNT,
    WRONG_ORDER,
    Flaw,
)
from gpmpc.recording._flaws import RECOVERED as WAS_RECOVERED
from gpmpc.recording._messages import (
    FIELDS,
    LEVELS,
    PLAN,
    QP,
    QP_ARRAYS,
    RESIDUALS,
    STEP,
    TIMING,
    TOPICS,
)
from gpmpc.recording._records import CHANNELS, CONFIG, RECOVERED, room, whole_records
from gpmpc.status import Status

if TYPE_CHECKING:
    import pandas

    from gpmpc.qp import QPSolution

Array = np.ndarray
_STATUSES = tuple(Status)
_MOST_SPANS = 3  # of lost steps that are named
#: of ``Run``, by the field of a step's message
_ATTRIBUTES = {
    "time": "times",
    "k": "steps",
    "reference": "references",
    "state": "states",
    "measured": "measured",
}
_ATTRIBUTES |= {
    "input": "inputs",
    "innovation": "innovations",
    "iterations": "iterations",
    "timing": "timings",
}
_ATTRIBUTES |= {
    "active_set_size": "active_set_sizes",
    "gp_size": "gp_sizes",
    "gp_version": "gp_versions",
}
_ATTRIBUTES |= {"failed": "failed", "novelty": "novelties"}
_ATTRIBUTES |= {"judgement": "judgements", "reason": "reasons"}


class RecordedProblem(NamedTuple):
    """A quadratic program as it was solved; letters as in ``gpmpc.qp``."""

    P: Array  # (n, n)
    q: Array  # (n,)
    G: Array  # (m, n)
    lower: Array  # (M,) bounds of the stacked constraints [x; Gx]
    upper: Array  # (M,)
    softness: Array  # (2, M) zeros (older recordings: 1/rho of quadratic prices), and the multipliers' largest sizes
    x: Array  # (n,) the solution found then; empty where there was none
    multipliers: Array  # (M,) its multipliers; empty where there was none


@dataclass(frozen=True, eq=False)
class Run:
    """K recorded steps; n states, m inputs, horizon H (the longest; NaN beyond a shorter one)."""

    path: Path
    # Recorded to its end, nothing is missing, and checksums vouch for all of it;
    # otherwise this is what could be read of it, and ``flaws`` say what is wrong.
    finished: bool
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    steps: Array  # (K,) their numbers k
    times: Array  # (K,) [s]
    references: Array  # (K, n)
    states: Array  # (K, n) true states
    measured: Array  # (K, n)
    inputs: Array  # (K, m) applied inputs
    input_bounds: Array  # (2, m) lower and upper; infinite where none were given
    innovations: Array  # (K, n)
    belief_covariances: Array  # (K, n, n)
    plan_inputs: Array  # (K, H, m)
    plan_means: Array  # (K, H + 1, n)
    plan_covariances: Array  # (K, H + 1, n, n)
    statuses: tuple[Status, ...]
    iterations: Array  # (K,)
    active_set_sizes: Array  # (K,)
    timings: Array  # (K, 4) model, build, solve, total [s]
    gp_sizes: Array  # (K,)
    gp_versions: Array  # (K,)
    failed: Array  # (K,) whether the decision was not applied
    novelties: (
        Array  # (K,) ``novelty`` of the decisions; 0 in files that do not have it
    )
    judgements: Array  # (K,) of texts, healthy, suspicious or lost; empty ones in files that have none
    reasons: Array  # (K,) of texts, why a step is not healthy
    channels: dict[str, tuple[int, str]]  # number of messages and schema by topic
    metadata: dict[str, dict[str, str]]
    config: str  # text of the resolved configuration
    problems: dict[int, RecordedProblem]  # by k; see ``replay``
    flaws: tuple[Flaw, ...] = ()  # what is wrong with the recording

    @property
    def whole(self) -> bool:
        """Whether nothing of it is known to be missing.

        Where it is not finished all the same, it has no checksums to tell.
        """
        return all(flaw.kind == NO_CHECKSUMS for flaw in self.flaws)

    @property
    def lost_steps(self) -> int:
        """How many steps are known to be lost."""
        return sum(flaw.count for flaw in self.flaws if flaw.kind == LOST_STEPS)

    @property
    def lost_chunks(self) -> int:
        """How many pieces of the file could not be read."""
        return sum(flaw.count for flaw in self.flaws if flaw.kind == LOST_CHUNKS)

    @cached_property
    def pose(self) -> dict[str, int]:
        """Indices of the states that are x, y, z, roll, pitch and yaw in space, as far as there are any."""
        named = self.metadata.get("pose", {}).items()
        return {
            axis: self.state_names.index(name)
            for axis, name in named
            if name in self.state_names
        }

    @cached_property
    def plan_stds(self) -> Array:
        """Standard deviations of the plans (K, H + 1, n)."""
        return _messages.deviations(self.plan_covariances)

    @cached_property
    def residuals(self) -> Array:
        """Primal and dual residual and duality gap of every recorded solution (K, 3); NaN without one."""
        nothing = (np.nan, np.nan, np.nan)
        return np.array(
            [
                _residuals(self.problems[k]) if k in self.problems else nothing
                for k in self.steps.tolist()
            ]
        )

    @cached_property
    def columns(self) -> dict[str, Array]:
        """The run as a table: a column (K,) per scalar field of ``gpmpc.Step``, in its order."""
        values: dict[str, Array] = {
            field: getattr(self, name) for field, name in _ATTRIBUTES.items()
        }
        values["belief_std"] = _messages.deviations(self.belief_covariances)
        values["residuals"] = self.residuals.reshape(-1, 3)
        values["status"] = np.array(
            [status.name for status in self.statuses], dtype=object
        )
        names = {
            "State": self.state_names,
            "Input": self.input_names,
            "Timing": TIMING,
            "": RESIDUALS,
        }
        found: dict[str, Array] = {}
        for field, kind in FIELDS["Step"].items():
            if field in values and kind in names:
                columns = zip(names[kind], values[field].T, strict=True)
                found |= {f"{field}.{name}": column for name, column in columns}
            elif field in values:
                found[field] = values[field]
        return found

    def to_pandas(self) -> "pandas.DataFrame":
        """Returns ``columns`` as a data frame, units in its ``attrs``."""
        import pandas

        frame = pandas.DataFrame(self.columns)
        frame.attrs["units"] = self.metadata.get("units", {})
        return frame


def replay(run: Run, k: int) -> "QPSolution":
    """Solves the recorded quadratic program of step k again.

    Raises:
        RecordingError: The step or its problem is not in the recording, or it is no convex program.
    """
    from gpmpc.qp import DualActiveSet, QuadraticProgram

    recorded = run.problems.get(k)
    if recorded is None:
        raise RecordingError(
            f"{run.path}: holds no quadratic program of step {k}; it holds {len(run.problems)} others"
        )
    inverse, caps = recorded.softness[:, len(recorded.q) :]
    try:
        problem = QuadraticProgram.from_stacked(*recorded[:5])
        if inverse.any():
            raise RecordingError(
                "its rows have quadratic prices, as in files of the first edition"
            )
        return DualActiveSet().solve(
            problem, prices=None if np.isinf(caps).all() else caps
        )
    except GpmpcError as error:
        raise RecordingError(f"{run.path}: step {k}: {error}") from error


def read_run(path: str | Path) -> Run:
    """Reads a recording, finished or not.

    What is damaged is left out, and ``Run.flaws`` say what is missing.

    Raises:
        RecordingError: There is no such file, it is no recording of a run, or damage
            has left no step of it.
    """
    path = Path(path)
    content = _read_content(path)
    flaws = list(content.flaws)
    state_names, input_names, are_named_twice = _names(path, content)
    if are_named_twice:
        text = "its metadata name other states or inputs than its messages"
        flaws.append(Flaw(DAMAGED_RECORDS, 1, text))
    try:
        classes = _messages.message_classes(
            _messages.descriptor(state_names, input_names, "bytes")
        )
    except SettingError as error:
        raise RecordingError(f"{path}: its metadata are damaged; {error}") from error
    steps, plans, problems = (
        _decoded(path, topic, classes, len(state_names), content.messages[topic])
        for topic in (STEP, PLAN, QP)
    )
    flaws += _step_flaws(content, steps, flaws)
    if not steps and any(flaw.kind in DAMAGE for flaw in flaws):
        reasons = "; ".join(flaw.text for flaw in flaws)
        raise RecordingError(f"{path}: no step of it can be read: {reasons}")
    if RECOVERED in content.metadata:
        text = "it was recovered, and holds what was left of another file"
        if reasons := content.metadata[RECOVERED].get("flaws"):
            text += f" ({reasons})"
        flaws.append(Flaw(WAS_RECOVERED, 1, text))
    return Run(
        path=path,
        finished=not flaws,
        state_names=state_names,
        input_names=input_names,
        statuses=tuple(_STATUSES[step.status] for step in steps),
        **_steps(steps, state_names, input_names),
        **_plans(path, plans, steps, state_names, input_names),
        channels={
            channel.topic: (
                content.counts[number],
                content.schemas[channel.schema_id].name
                if channel.schema_id in content.schemas
                else "",
            )
            for number, channel in content.channels.items()
        },
        metadata=content.metadata,
        config=content.config,
        problems=dict(problems),
        flaws=tuple(flaws),
    )


@dataclass
class _FileContent:
    """The records of a file, those of the topics that a run is read from."""

    messages: dict[str, list[Message]]  # by topic
    counts: Counter[int] = dataclasses.field(
        default_factory=Counter
    )  # of messages, by channel
    channels: dict[int, Channel] = dataclasses.field(default_factory=dict)
    schemas: dict[int, Schema] = dataclasses.field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = dataclasses.field(default_factory=dict)
    config: str = ""
    statistics: Statistics | None = None
    flaws: list[Flaw] = dataclasses.field(default_factory=list)


def _read_content(path: Path) -> _FileContent:
    content = _FileContent(messages={STEP: [], PLAN: [], QP: []})
    for record in whole_records(path, content.flaws):
        if isinstance(record, Message):
            content.counts[record.channel_id] += 1
            topic = content.channels[record.channel_id].topic
            if topic in content.messages:
                content.messages[topic].append(record)
        elif isinstance(record, Schema):
            content.schemas[record.id] = record
        elif isinstance(record, Channel):
            content.channels[record.id] = record
        elif isinstance(record, Metadata) and record.name != CHANNELS:
            content.metadata.setdefault(record.name, record.metadata)
        elif isinstance(record, Attachment) and record.name == CONFIG:
            content.config = record.data.decode(errors="replace")
        elif isinstance(record, Statistics):
            content.statistics = record
    return content


def _names(
    path: Path, content: _FileContent
) -> tuple[tuple[str, ...], tuple[str, ...], bool]:
    """Returns the names of states and inputs, and whether metadata name others.

    Those in the schema of the steps count, which has a checksum where metadata have
    none.
    """
    about = content.metadata.get("run", {})
    if not {"state_names", "input_names"} <= about.keys():
        raise RecordingError(
            f"{path}: is not the recording of a run; it has no metadata about one"
        )
    described = [about[key].split() for key in ("state_names", "input_names")]
    try:
        for names in (described, _names_in_schema(content) or described):
            state_names = _messages.check_names("state_names", names[0])
            input_names = _messages.check_names("input_names", names[1])
    except SettingError as error:
        raise RecordingError(f"{path}: its metadata are damaged; {error}") from error
    are_others = [list(state_names), list(input_names)] != described
    return state_names, input_names, are_others


def _names_in_schema(content: _FileContent) -> list[list[str]] | None:
    """Reads the names of states and inputs out of the schema of the steps."""
    for channel in content.channels.values():
        schema = content.schemas.get(channel.schema_id)
        if channel.topic == STEP and schema is not None:
            return _messages.names_in(schema.data)
    return None


def _step_flaws(
    content: _FileContent, steps: list[Any], flaws: Sequence[Flaw]
) -> list[Flaw]:
    """Says which steps are lost, repeated or in another order, and where."""
    sequence = np.array([message.sequence for message in content.messages[STEP]])
    is_numbered = bool(sequence.any())  # not every program numbers its messages
    is_ordered = is_numbered and bool((np.diff(sequence) > 0).all())
    # Where every checksum is right, another program chose the order.
    if flaws and is_numbered and not is_ordered:
        text = "its steps do not stand in the order in which they were recorded"
        return [Flaw(WRONG_ORDER, 1, text), *_count_flaws(content, len(steps), "")]
    where = _lost_spans(sequence, steps) if is_ordered else ""
    return _count_flaws(content, len(steps), where)


def _count_flaws(content: _FileContent, present: int, where: str) -> list[Flaw]:
    """Compares the number of steps with what end, index and numbering of a file say."""
    by_index = _steps_by_index(content)
    by_end = _steps_by_end(content)
    flaws = []
    if by_index is not None and by_end is not None and by_end < by_index:
        text = f"its end counts {by_end} steps, its index {by_index}"
        flaws.append(Flaw(WRONG_COUNT, 1, text))
    is_damaged = any(flaw.kind in DAMAGE for flaw in content.flaws)
    if is_damaged and by_index is not None:  # which has a checksum of its own
        stated: int | None = by_index
    else:  # what rewrites a file makes a new index, and keeps the end
        known = [count for count in (by_index, by_end) if count is not None]
        stated = max(known, default=None)
    total = str(stated)
    if stated is None:  # those behind the last that was read are not known
        stated = _numbered_steps(content)
        total = f"at least {stated}"
    if present > stated > 0:
        text = f"{stated} steps were recorded by its end; there are {present}"
        flaws.append(Flaw(WRONG_COUNT, present - stated, text))
    if present < stated:
        lost = stated - present
        text = f"{lost} of {total} steps are lost" + (f": {where}" if where else "")
        flaws.append(Flaw(LOST_STEPS, lost, text))
    return flaws


def _steps_by_end(content: _FileContent) -> int | None:
    """How many steps the end of the recording counts."""
    stated = content.metadata.get("end", {}).get("steps", "")
    return int(stated) if stated.isdecimal() and len(stated) < 10 else None


def _steps_by_index(content: _FileContent) -> int | None:
    """How many steps the index of the file counts."""
    if content.statistics is None:
        return None
    by_channel = content.statistics.channel_message_counts
    counts = [
        by_channel[number]
        for number, channel in content.channels.items()
        if channel.topic == STEP and number in by_channel
    ]
    return sum(counts) if counts else None


def _numbered_steps(content: _FileContent) -> int:
    """How many steps were recorded up to the last that was read, by their numbering."""
    sequence = [message.sequence for message in content.messages[STEP]]
    if not any(sequence):
        return len(sequence)
    # The first number is 1, or 0 in files of the first edition.
    return max(sequence) + (1 if min(sequence) == 0 else 0)


def _lost_spans(sequence: Array, steps: list[Any]) -> str:
    """Names the steps between which some are lost, by their numbers."""
    spans = []
    if sequence[0] > 1:
        spans.append(f"before step {steps[0].k}")
    gaps = np.flatnonzero(np.diff(sequence) > 1)
    for row in gaps[:_MOST_SPANS]:
        spans.append(f"between steps {steps[row].k} and {steps[row + 1].k}")
    if len(gaps) > _MOST_SPANS:
        spans.append(f"and at {len(gaps) - _MOST_SPANS} other places")
    return ", ".join(spans) or f"after step {steps[-1].k}"


def _decoded(
    path: Path, topic: str, classes: dict[str, Any], n: int, records: list[Message]
) -> list[Any]:
    """Parses the messages of a topic; a quadratic program becomes its step's number k and itself."""
    found: list[Any] = []
    for record in records:
        try:
            message = classes[TOPICS[topic]].FromString(record.data)
            if topic == QP:
                message = message.k, _problem(message)
            elif topic == PLAN:
                _numbers(message, "covariances", len(message.stages), n, n)
                if not message.stages:
                    raise ValueError("it has no stage")
            else:
                _numbers(message, "belief_covariance", n, n)
                if not 0 <= message.status < len(_STATUSES):
                    raise ValueError(f"status {message.status} is unknown")
                if message.judgement not in LEVELS:
                    raise ValueError(f"judgement {message.judgement!r:.40} is unknown")
        except (DecodeError, ValueError) as error:
            raise RecordingError(
                f"{path}: message {record.sequence} of {topic} is damaged: {error}"
            ) from error
        found.append(message)
    return found


def _numbers(message: Any, field: str, *shape: int) -> Array:
    """Reads a packed array."""
    data = getattr(message, field)
    if min(shape) < 0 or len(data) != 8 * math.prod(shape):
        raise ValueError(f"{field} must be {shape}; got {len(data)} bytes")
    return np.frombuffer(data).reshape(shape)


def _table(messages: Iterable[Any], names: Sequence[str]) -> Array:
    """Reads scalar fields of messages (K, names)."""
    return np.array(
        [[getattr(message, name) for name in names] for message in messages]
    ).reshape(-1, len(names))


def _steps(
    steps: list, states: tuple[str, ...], inputs: tuple[str, ...]
) -> dict[str, Array]:
    bounds = np.tile([[-np.inf], [np.inf]], len(inputs))
    if steps and steps[0].HasField("input_lower"):  # they are equal in all steps
        bounds = _table([steps[0].input_lower, steps[0].input_upper], inputs)
    covariances = np.frombuffer(b"".join(step.belief_covariance for step in steps))
    found = {
        "input_bounds": bounds,
        "belief_covariances": covariances.reshape(-1, len(states), len(states)),
    }
    names = {"State": states, "Input": inputs, "Timing": TIMING}
    for field, name in _ATTRIBUTES.items():
        kind = FIELDS["Step"][field]
        values = [getattr(step, field) for step in steps]
        if kind in names:
            found[name] = _table(values, names[kind])
        else:
            found[name] = np.array(values, dtype=object if kind == "string" else kind)
    return found


def _numbered(messages: list) -> Iterator[tuple[int, int]]:
    """Yields of every message its step's number k and, where a number comes again, the how many'th time it is."""
    seen: Counter[int] = Counter()
    for message in messages:
        seen[message.k] += 1
        yield message.k, seen[message.k]


def _plans(
    path: Path,
    plans: list,
    steps: list,
    states: tuple[str, ...],
    inputs: tuple[str, ...],
) -> dict[str, Array]:
    H = max((len(plan.stages) - 1 for plan in plans), default=0)
    n = len(states)
    m = len(inputs)
    if (needed := 8 * len(steps) * (H + 1) * (n * n + n + m)) > room(path):
        raise RecordingError(
            f"{path}: a plan of {H} stages would make arrays of {needed / 1e6:.0f} MB with the others"
        )
    shapes = {"inputs": (H, m), "means": (H + 1, n), "covariances": (H + 1, n, n)}
    arrays = {
        f"plan_{name}": np.full((len(steps), *shape), np.nan)
        for name, shape in shapes.items()
    }
    rows = {key: row for row, key in enumerate(_numbered(steps))}
    for key, plan in zip(_numbered(plans), plans, strict=True):
        if key in rows:  # else the step is lost
            row = rows[key]
            H = len(plan.stages) - 1
            arrays["plan_means"][row, : H + 1] = _table(
                (stage.mean for stage in plan.stages), states
            )
            arrays["plan_inputs"][row, :H] = _table(
                (stage.input for stage in plan.stages[:-1]), inputs
            )
            arrays["plan_covariances"][row, : H + 1] = _numbers(
                plan, "covariances", H + 1, n, n
            )
    return arrays


def _problem(message: Any) -> RecordedProblem:
    n = message.variables
    m = message.rows
    M = n + m
    has_solution = bool(message.x or message.multipliers)
    shapes = (
        (n, n),
        (n,),
        (m, n),
        (M,),
        (M,),
        (2, M),
        (n * has_solution,),
        (M * has_solution,),
    )
    return RecordedProblem(
        *(
            _numbers(message, name, *s)
            for name, s in zip(QP_ARRAYS, shapes, strict=True)
        )
    )


def _residuals(problem: RecordedProblem) -> tuple[float, float, float]:
    """Judges a recorded solution; NaN where there is none."""
    from gpmpc.qp import QuadraticProgram, make_solution

    if not len(problem.x):
        return np.nan, np.nan, np.nan
    P, q, G, lower, upper, softness, x, multipliers = problem
    solution = make_solution(
        QuadraticProgram.unchecked(P, q, G, lower, upper), Status.SOLVED, x, multipliers
    )
    return solution._replace(caps=softness[1]).residuals()


def recover(path: str | Path, output: str | Path) -> Run:
    """Writes everything whole in a recording to a new file with index, and reads that.

    Args:
        path: A file that a crash left without an end, or that is damaged; an MCAP
            reader takes it for empty.
        output: The new file, which says that it was recovered and what is missing; it
            appears when it is complete and has been read.

    Raises:
        RecordingError: There is no run to recover, or the output cannot be written.
    """
    path = Path(path)
    output = Path(output)
    run = read_run(path)
    try:
        if output.exists() and path.exists() and output.samefile(path):
            raise RecordingError(
                f"{output}: a file cannot be recovered into itself; name another output"
            )
        with whole_file(output) as file:
            _copy(path, file, run.flaws)
            file.flush()
            return replace(read_run(file.name), path=output)
    except OSError as error:
        raise RecordingError(
            f"{output}: cannot be written: {error.strerror or error}"
        ) from error


def _copy(path: Path, file: BinaryIO, flaws: Sequence[Flaw]) -> None:
    """Copies whole records, and what is wrong with their file."""
    writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile="gpmpc", library="gpmpc")
    schemas: dict[int, int] = {}  # numbers in the copy, by those in the file
    channels: dict[int, int] = {}
    topics: dict[str, str] = {}  # of ``CHANNELS``
    messages = 0
    are_topics_listed = False
    was_recovered = False
    for record in whole_records(path):
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(
                record.name, record.encoding, record.data
            )
        elif isinstance(record, Channel) and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic,
                record.message_encoding,
                schemas.get(record.schema_id, 0),
                record.metadata,
            )
            topics[str(channels[record.id])] = record.topic
        elif isinstance(record, Message):
            writer.add_message(
                channels[record.channel_id],
                record.log_time,
                record.data,
                record.publish_time,
                record.sequence,
            )
            messages += 1
        elif isinstance(record, Metadata) and record.name == CHANNELS:
            are_topics_listed = True
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
            was_recovered |= record.name == RECOVERED
        elif isinstance(record, Attachment):
            writer.add_attachment(
                record.create_time,
                record.log_time,
                record.name,
                record.media_type,
                record.data,
            )
    if are_topics_listed:
        writer.add_metadata(CHANNELS, topics)
    if flaws and not was_recovered:
        reasons = "; ".join(flaw.text for flaw in flaws)
        writer.add_metadata(RECOVERED, {"messages": str(messages), "flaws": reasons})
    writer.finish()
