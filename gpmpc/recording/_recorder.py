"""Records every step of a run in a file that explains itself and survives a crash, and shows it live.

``record`` copies the step; the copies that wait are serialised and written as one
compressed chunk, of two seconds of the flight or so. A run killed at any moment loses
at most the last one, and a spoiled byte the one that it lies in. Where the file comes
from is on the disk before the first step.
"""

import contextlib
import json
import math
import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import foxglove
from filelock import lock_descriptor
from foxglove.channels import LogChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import Log, LogLevel, Timestamp

from gpmpc._provenance import flattened, provenance
from gpmpc.exceptions import RecordingError, check_number
from gpmpc.recording._frames import LARGEST, topics_of_chunk
from gpmpc.recording._messages import Encoder, RecordedSystem, StepCopy
from gpmpc.recording._records import CHANNELS, CONFIG
from gpmpc.recording._scene import WORLD, Scene
from gpmpc.step import Step

_INTERVAL = 1.0  # [s] of the clock after which the next step ends a chunk
_SPAN = 2.0  # [s] of the flight in a chunk; a simulated one takes less than it lasts
_LEAST = 8 * 1024  # numbers [bytes] for which a chunk is worth its own entries
_PORT = 8765  # of the live view, if it is free


class McapRecorder:
    """Writes the steps of one run to an MCAP file; a context manager.

    Args:
        path: The file, such as ``run.mcap``; its folder is made, an older file is replaced.
        system: What is recorded.
        config: The resolved configuration, as YAML text or as plain data (written as JSON, which is YAML).
        metadata: More to know of the run, such as its seed.
        record_problems: Keep every step's quadratic program, so that it can be replayed.
        chunk_size: Numbers [bytes] that wait in memory at most, if more than one step
            does; what a killed run loses.
        live: Serve every step to viewers as well, at ``address``.

    Raises:
        RecordingError: The file cannot be written, or another process is writing it.
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
        about = flattened(
            provenance() | {"host": platform.node()} | dict(metadata or {})
        )
        about = {key: str(value) for key, value in about.items()}
        about |= {
            "state_names": " ".join(system.state_names),
            "input_names": " ".join(system.input_names),
        }
        frames = {
            "positions": WORLD,
            "z axis": "down" if system.z_down else "up",
            "display": "z axis up",
        }
        config = (
            config
            if isinstance(config, str)
            else json.dumps(config, indent=2, default=str)
        )

        self.path = Path(path)
        self.address: str | None = (
            None  #: where a viewer finds the live view, such as ``ws://127.0.0.1:8765``
        )
        self._n = len(system.state_names)
        self._m = len(system.input_names)
        self._record_problems = record_problems
        self._chunk_size = chunk_size
        self._encoder = Encoder(system)
        self._waiting: list[StepCopy] = []
        self._bytes = 0
        self._steps = 0
        self._waiting_since = -math.inf  # when the chunk's first step was [s]
        self._topics: dict[int, str] = {}  # by channel, as far as they are written
        self._level = "healthy"  # of the last judgement
        self._error: str | None = None  # why no more steps are taken
        self._closed = False
        self._server = None
        self._sink = _Sink(self.path)
        self._context = context = (
            foxglove.Context()
        )  # its channels live as long as it does
        # ``_end_chunk`` ends chunks, and each is written in one piece.
        options: Any = {
            "chunk_size": None,
            "disable_seeking": True,
            "compression_threads": 0,
            "compression_level": 1,
        }
        options = MCAPWriteOptions(profile="gpmpc", **options)
        self._writer = foxglove.open_mcap(
            self._sink, context=context, writer_options=options
        )
        described = {
            "run": about,
            "units": system.field_units,
            "frames": frames,
            "pose": dict(system.pose),
        }
        for name, pairs in described.items():
            self._writer.write_metadata(name, pairs)
        attached: Any = {
            "media_type": "application/yaml",
            "log_time": 0,
            "create_time": 0,
        }
        self._writer.attach(name=CONFIG, data=config.encode(), **attached)
        self._writer.flush()
        self._save(sync=True)
        self._channels = self._encoder.channels(context)
        self._log = LogChannel("/log", context=context)
        self._scene = Scene(context, system)
        if live:
            try:
                self._server = foxglove.start_server(
                    name=self.path.name, port=_PORT, context=context
                )
            except RuntimeError:  # the port is taken
                self._server = foxglove.start_server(
                    name=self.path.name, port=0, context=context
                )
            self.address = f"ws://127.0.0.1:{self._server.port}"

    def record(self, step: Step) -> None:
        """Takes a copy of a step.

        Raises:
            ShapeError: An array does not fit the names of states and inputs.
            RecordingError: An earlier step could not be written, the recorder is closed, or a step is too large.
        """
        if self._error is not None:
            raise RecordingError(self._error)
        copy = StepCopy(step, self._n, self._m, self._record_problems)
        size = len(copy.data)
        if 4 * size > LARGEST:
            raise RecordingError(
                f"{self.path}: a step of {size} bytes is too large; at most {LARGEST // 4}"
            )
        if self._bytes == 0:
            self._waiting_since = step.time
        self._waiting.append(copy)
        self._bytes += size
        if self._server is not None:
            self._serialise()
        if self._is_chunk_full(step):
            self._end_chunk()

    def close(self, outcome: str = "complete") -> None:
        """Writes what waits and finishes the file; how the run ended is kept as metadata.

        Raises:
            RecordingError: It could not be written; the file is left unfinished.
        """
        if self._closed:
            return
        if self._error is not None:
            raise RecordingError(self._error)
        self._end_chunk()
        self._writer.write_metadata(
            "end", {"steps": str(self._steps), "outcome": outcome}
        )
        self._writer.close()
        self._save(sync=True)
        self._closed = True
        self._end("the recording is closed")

    def __enter__(self) -> "McapRecorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: Any
    ) -> None:
        if error is None or kind is None:
            self.close()
            return
        with contextlib.suppress(RecordingError):  # most likely the same error
            self.close(
                f"{kind.__name__}: {error}"
            )  # a run that ended in an error has been recorded up to there

    def _is_chunk_full(self, step: Step) -> bool:
        """Whether the steps that wait are to be written now."""
        if self._bytes > min(self._chunk_size, LARGEST // 8):
            return True
        if step.time - self._waiting_since >= _SPAN and self._bytes >= _LEAST:
            return True
        return time.perf_counter() - self._last > _INTERVAL

    def _end_chunk(self) -> None:
        """Writes what waits, and behind it the topics of channels that are new."""
        self._serialise()
        self._writer.flush()
        new_topics = topics_of_chunk(self._sink.unsaved, self._topics)
        if new_topics:
            self._topics |= new_topics
            pairs = {str(number): topic for number, topic in self._topics.items()}
            self._writer.write_metadata(CHANNELS, pairs)
        self._save()

    def _serialise(self) -> None:
        """Logs the steps that wait: into the open chunk, and to viewers."""
        for copy in self._waiting:
            stamp = round(copy.step.time * 1e9)
            for topic, message in self._encoder.encode(copy):
                self._channels[topic].log(message, log_time=stamp)
            self._scene.log(copy, stamp)
            if copy.step.failed or not copy.status.solved:
                self._log.log(_failure(copy, stamp), log_time=stamp)
            judgement = copy.step.judgement
            if judgement is not None and judgement.level != self._level:
                self._level = judgement.level
                self._log.log(_judgement(copy, stamp), log_time=stamp)
        self._steps += len(self._waiting)
        self._waiting.clear()

    def _save(self, sync: bool = False) -> None:
        """Saves what was written: it is safe from now on if this process dies, with ``sync`` if the machine does."""
        try:
            self._sink.save(sync)
        except OSError as error:
            self._end(f"the recording stopped and is unfinished: {error.strerror}")
            raise RecordingError(self._error) from error
        self._bytes = 0
        self._last = time.perf_counter()

    def _end(self, reason: str) -> None:
        self._error = f"{self.path}: {reason}"
        if self._server is not None:
            self._server.stop()
        os.close(self._sink.descriptor)  # other processes may write the file


class _Sink:
    """Collects what the library writes until it is saved, so that an error of the disk reaches the caller.

    (A writer that is not closed adds a footer when it is collected: what is never saved does no harm.)
    """

    def __init__(self, path: Path):
        self._data = bytearray()
        self._position = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.descriptor = os.open(
                path, os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666
            )
        except OSError as error:
            raise RecordingError(
                f"{path}: cannot be written: {error.strerror}"
            ) from error
        if not lock_descriptor(self.descriptor, blocking=False):
            os.close(self.descriptor)
            raise RecordingError(f"{path}: another process is recording to this file")
        os.ftruncate(self.descriptor, 0)

    @property
    def unsaved(self) -> bytes:
        """What was written since it was saved."""
        return bytes(self._data)

    def write(self, data: bytes | bytearray) -> int:
        """Takes all of the data."""
        self._data += data
        self._position += len(data)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Returns the position, which the library reads although it does not seek."""
        return self._position

    def flush(self) -> None:
        """Does nothing: see ``save``."""

    def save(self, sync: bool) -> None:
        """Writes what was collected, and puts it on the disk if asked to."""
        left = memoryview(self._data)
        self._data = bytearray()
        while left:
            left = left[os.write(self.descriptor, left) :]
        if sync:
            os.fsync(self.descriptor)


def _failure(copy: StepCopy, nanoseconds: int) -> Log:
    """Says what went wrong at a step."""
    status = copy.status
    failed = copy.step.failed
    policy = "; the policy for failures chose the input" if failed else ""
    return Log(
        timestamp=Timestamp(sec=nanoseconds // 10**9, nsec=nanoseconds % 10**9),
        level=LogLevel.Error if failed else LogLevel.Warning,
        name="gpmpc",
        message=f"step {copy.step.k}: {status.name}: {status.advice}{policy}",
    )


def _judgement(copy: StepCopy, nanoseconds: int) -> Log:
    """Says that a flight is healthy, suspicious or lost from a step on, and why."""
    judgement: Any = copy.step.judgement
    return Log(
        timestamp=Timestamp(sec=nanoseconds // 10**9, nsec=nanoseconds % 10**9),
        level=_LOG_LEVELS[judgement.level],
        name="gpmpc",
        message=f"from step {copy.step.k} on {judgement}",
    )


_LOG_LEVELS = {
    "healthy": LogLevel.Info,
    "suspicious": LogLevel.Warning,
    "lost": LogLevel.Error,
}
