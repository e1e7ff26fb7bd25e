"""Records the steps of a run in a file that survives a crash, and shows them live.

``record`` copies the step; the copies that wait are serialised and written as one
compressed chunk, of two seconds of the flight or so. A run killed at any moment loses
at most the last one, and a spoiled byte the one that it lies in. Where the file comes
from is on the disk before the first step.
"""

import contextlib
import json
import math
import platform
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import foxglove
from foxglove.channels import LogChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import Log, LogLevel, Timestamp

from gpmpc._calls import explains_arguments
from gpmpc._files import as_path
from gpmpc._interrupts import interrupts_after
from gpmpc._provenance import flattened, provenance
from gpmpc.exceptions import RecordingError, SettingError, check_kind, check_number
from gpmpc.recording._encoding import Encoder, StepCopy
from gpmpc.recording._frames import LARGEST, topics_of_chunk
from gpmpc.recording._scene import WORLD, Scene
from gpmpc.recording._schema import (
    CHANNELS_METADATA,
    COMPLETE,
    CONFIG_ATTACHMENT,
)
from gpmpc.recording._sink import Sink
from gpmpc.recording._system import RecordedSystem
from gpmpc.step import Step

if TYPE_CHECKING:
    from gpmpc.mpc import Judgement

_LONGEST_WAIT = 1.0  # [s] of the clock after which the next step ends a chunk
_SPAN = 2.0  # [s] of the flight in a chunk; a simulated one takes less than it lasts
# [bytes] of numbers; fewer wait for more steps: a chunk has entries of its own
_SMALLEST_CHUNK = 8 * 1024
_TIME_LIMIT = 2**32  # [s], which dates count in 32 bits
_PORT = 8765  # of the live view, if it is free


@explains_arguments
class McapRecorder:
    """Writes the steps of one flight to an MCAP file; a context manager.

    Args:
        path: The file, such as ``run.mcap``; its folder is made, an older file is
            replaced.
        system: What is recorded.
        config: The resolved configuration, as YAML text or as plain data (written as
            JSON, which is YAML).
        metadata: More to know of the run, such as its seed.
        record_problems: Keep the quadratic programs, so that they can be replayed.
        chunk_size: Size [bytes] of numbers that may wait in memory: with more, the
            steps that wait are written as a chunk. They are as well when they span two
            seconds of the flight, or have waited for one. A killed run loses what
            waits.
        live: Serve every step to viewers as well, at ``address``.

    Raises:
        SettingError: ``chunk_size`` is no whole number, 1 or more, or ``system`` of
            another kind.
        RecordingError: The file cannot be written, or another process is writing it.

    See Also:
        ``RecordedSystem.of``, which describes a system; ``read_run``, which reads the
        file; ``closed_loop``, whose ``on_step`` takes ``record``.
    """

    def __init__(
        self,
        path: str | Path,
        system: RecordedSystem,
        *,
        config: Mapping[str, Any] | str = "",
        metadata: Mapping[str, Any] | None = None,
        record_problems: bool = True,
        chunk_size: int = 256 * 1024,
        live: bool = False,
    ):
        check_number("chunk_size", chunk_size, least=1, whole=True, unit="[bytes]")
        check_kind("system", system, RecordedSystem, "RecordedSystem.of(system)")
        described = _describe(system, metadata or {})

        self.path = as_path(path)
        #: where a viewer finds the live view, such as ``ws://127.0.0.1:8765``
        self.address: str | None = None
        self._n = len(system.state_names)
        self._m = len(system.input_names)
        self._record_problems = record_problems
        self._chunk_size = chunk_size
        self._encoder = Encoder(system)
        self._waiting: deque[StepCopy] = deque()
        self._unsaved_bytes = 0  # of numbers, in the chunk under way
        self._steps = 0
        self._chunk_begins_at = -math.inf  # [s] of the flight
        self._last_k = -1  # number of the step before
        self._topics: dict[int, str] = {}  # by channel, as far as they are written
        self._level = "healthy"  # of the last judgement
        self._error: str | None = None  # why no more steps are taken
        self._saved_at_clock = 0.0  # [s]
        self._closed = False
        self._server: Any = None
        self._context = foxglove.Context()  # its channels live as long as it does
        self._sink = Sink(self.path)
        try:
            self._writer = _open_writer(self._sink, self._context)
            self._write_description(described, config)
            self._channels = self._encoder.channels(self._context)
            self._log = LogChannel("/log", context=self._context)
            self._scene = Scene(self._context, system)
            if live:
                self._server = _start_server(self.path.name, self._context)
                self.address = f"ws://127.0.0.1:{self._server.port}"
        except BaseException:
            self._sink.close()  # another try may write the file
            raise

    def _write_description(
        self,
        described: Mapping[str, Mapping[str, str]],
        config: Mapping[str, Any] | str,
    ) -> None:
        """Puts on the disk where the file comes from."""
        for name, pairs in described.items():
            self._writer.write_metadata(name, dict(pairs))
        if not isinstance(config, str):
            config = json.dumps(config, indent=2, default=str)
        self._writer.attach(
            name=CONFIG_ATTACHMENT,
            data=config.encode(),
            media_type="application/yaml",
            log_time=0,
            create_time=0,
        )
        self._writer.flush()
        self._save(sync=True)

    def record(self, step: Step) -> None:
        """Takes a copy of a step.

        Raises:
            ShapeError: An array does not fit the names of states and inputs.
            SettingError: Its time is no number of seconds that a file can hold, or its
                number is not larger than that of the step before: a recorder takes one
                flight.
            RecordingError: An earlier step could not be written, the recorder is
                closed, or a step is too large.
        """
        if self._error is not None:
            raise RecordingError(self._error)
        _check_time(step.time)
        if step.k <= self._last_k:
            rule = f"must be above {self._last_k}: one recorder takes one flight"
            raise SettingError("step.k", f"{rule}; got {step.k}")
        copy = StepCopy(step, self._n, self._m, self._record_problems)
        size = len(copy.data)
        if 4 * size > LARGEST:
            raise RecordingError(
                f"{self.path}: a step of {size} bytes is too large; at most "
                f"{LARGEST // 4}"
            )
        if self._unsaved_bytes == 0:
            self._chunk_begins_at = step.time
        self._last_k = step.k
        self._waiting.append(copy)
        self._unsaved_bytes += size
        if self._server is not None:
            with interrupts_after():
                self._serialise()
        if self._is_chunk_due(step):
            self._end_chunk()

    def close(self, outcome: str = COMPLETE) -> None:
        """Writes what waits and finishes the file; ``outcome`` is kept as metadata.

        A Ctrl-C waits for the end of it.

        Raises:
            RecordingError: It could not be written; the file is left unfinished.
        """
        if self._closed:
            return
        if self._error is not None:
            raise RecordingError(self._error)
        with interrupts_after():
            self._end_chunk()
            end = {"steps": str(self._steps), "outcome": outcome}
            self._writer.write_metadata("end", end)
            self._writer.close()
            self._save(sync=True)
            self._closed = True
            self._stop_recording("the recording is closed")

    def __enter__(self) -> "McapRecorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: Any
    ) -> None:
        if error is not None:
            self._close_after(error)
            return
        try:
            self.close()
        except Exception as own_error:
            self._close_after(own_error)
            raise

    def _close_after(self, error: BaseException) -> None:
        """Finishes the file of a run that has been recorded up to an error."""
        with contextlib.suppress(RecordingError):  # most likely the same error
            self.close(f"{type(error).__name__}: {error}")

    def _is_chunk_due(self, step: Step) -> bool:
        """Tells whether the steps that wait are to be written now."""
        if self._unsaved_bytes > min(self._chunk_size, LARGEST // 8):
            return True
        is_long = step.time - self._chunk_begins_at >= _SPAN
        if is_long and self._unsaved_bytes >= _SMALLEST_CHUNK:
            return True
        return time.perf_counter() - self._saved_at_clock > _LONGEST_WAIT

    def _end_chunk(self) -> None:
        """Writes what waits, and behind it the topics of channels that are new.

        A Ctrl-C waits for the end: half a chunk cannot be taken up again.
        """
        with interrupts_after():
            self._write_chunk()

    def _write_chunk(self) -> None:
        self._serialise()
        self._writer.flush()
        new_topics = topics_of_chunk(self._sink.unsaved, self._topics)
        if new_topics:
            self._topics |= new_topics
            pairs = {str(number): topic for number, topic in self._topics.items()}
            self._writer.write_metadata(CHANNELS_METADATA, pairs)
        self._save()

    def _serialise(self) -> None:
        """Logs the steps that wait: into the open chunk, and to viewers.

        What cannot be encoded waits no more: it would fail at each attempt.
        """
        while self._waiting:
            copy = self._waiting.popleft()
            stamp = round(copy.step.time * 1e9)
            messages = list(self._encoder.encode(copy))
            self._steps += 1
            for topic, encoded in messages:
                self._channels[topic].log(encoded, log_time=stamp)
            self._scene.log(copy, stamp)
            if copy.step.failed or not copy.status.solved:
                self._log.log(_failure_log(copy, stamp), log_time=stamp)
            judgement = copy.step.judgement
            if judgement is not None and judgement.level != self._level:
                self._level = judgement.level
                message = _judgement_log(copy.step, judgement, stamp)
                self._log.log(message, log_time=stamp)

    def _save(self, sync: bool = False) -> None:
        """Saves what was written, so that it is safe if this process dies.

        With ``sync`` it is safe if the machine does.
        """
        try:
            self._sink.save(sync)
        except OSError as error:
            reason = f"the recording stopped and is unfinished: {error.strerror}"
            self._stop_recording(reason)
            raise RecordingError(self._error) from error
        self._unsaved_bytes = 0
        self._saved_at_clock = time.perf_counter()

    def _stop_recording(self, reason: str) -> None:
        """Takes no more steps, for a reason."""
        self._error = f"{self.path}: {reason}"
        if self._server is not None:
            self._server.stop()
        self._sink.close()


def _check_time(time: float) -> None:
    """Raises ``SettingError`` for a time [s] that a message cannot be dated with."""
    check_number("step.time", time, least=0, unit="[s]")
    if time >= _TIME_LIMIT:
        raise SettingError("step.time", f"must be below {_TIME_LIMIT} [s]; got {time}")


def _describe(
    system: RecordedSystem, metadata: Mapping[str, Any]
) -> dict[str, dict[str, str]]:
    """Returns the metadata of a file by their names."""
    run = provenance() | {"host": platform.node()} | dict(metadata)
    about = {key: str(value) for key, value in flattened(run).items()}
    about["state_names"] = " ".join(system.state_names)
    about["input_names"] = " ".join(system.input_names)
    return {
        "run": about,
        "units": system.field_units,
        "frames": {
            "positions": WORLD,
            "z axis": "down" if system.z_down else "up",
            "display": "z axis up",
        },
        "pose": dict(system.pose),
    }


def _open_writer(sink: Sink, context: foxglove.Context) -> Any:
    """Opens a writer that ends a chunk when it is flushed, and writes it as a whole."""
    options = MCAPWriteOptions(
        profile="gpmpc",
        chunk_size=None,
        disable_seeking=True,
        compression_threads=0,
        compression_level=1,
    )
    output: Any = sink
    return foxglove.open_mcap(output, context=context, writer_options=options)


def _start_server(name: str, context: foxglove.Context) -> Any:
    """Starts the live view at its usual port, or at any other."""
    try:
        return foxglove.start_server(name=name, port=_PORT, context=context)
    except RuntimeError:  # the port is taken
        return foxglove.start_server(name=name, port=0, context=context)


def _failure_log(copy: StepCopy, nanoseconds: int) -> Log:
    """Says what went wrong at a step."""
    status = copy.status
    failed = copy.step.failed
    policy = "; the policy for failures chose the input" if failed else ""
    return Log(
        timestamp=_timestamp(nanoseconds),
        level=LogLevel.Error if failed else LogLevel.Warning,
        name="gpmpc",
        message=f"step {copy.step.k}: {status.name}: {status.advice}{policy}",
    )


def _judgement_log(step: Step, judgement: "Judgement", nanoseconds: int) -> Log:
    """Says that a flight is healthy, suspicious or lost from a step on, and why."""
    return Log(
        timestamp=_timestamp(nanoseconds),
        level=_LOG_LEVELS[judgement.level],
        name="gpmpc",
        message=f"from step {step.k} on {judgement}",
    )


def _timestamp(nanoseconds: int) -> Timestamp:
    return Timestamp(sec=nanoseconds // 10**9, nsec=nanoseconds % 10**9)


_LOG_LEVELS = {
    "healthy": LogLevel.Info,
    "suspicious": LogLevel.Warning,
    "lost": LogLevel.Error,
}
