"""Records every step of a run in a file that explains itself and survives a crash, and shows it live.

``record`` keeps a copy of the step, some ten microseconds; at every ``CHUNK`` bytes or ``INTERVAL`` seconds the steps
kept are serialised and written as one compressed chunk. A run killed at any moment loses at most that last chunk.

Before the first step the file holds where it comes from (commit, versions, host, command, the caller's metadata), the
resolved configuration, units and frames, flushed to the disk. An unfinished file has no footer; see ``recover``.
"""

import contextlib
import fcntl
import json
import os
import platform
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import foxglove
from foxglove.channels import LogChannel
from foxglove.mcap import MCAPWriteOptions

from gpmpc.exceptions import RecordingError, check_number
from gpmpc.provenance import provenance
from gpmpc.recording._messages import RecordedSystem, units_by_field
from gpmpc.recording._records import CONFIG, LARGEST
from gpmpc.recording._scene import Scene
from gpmpc.recording._steps import Encoder, Packed, failure_log, pack, unpack
from gpmpc.step import Step

_INTERVAL = 1.0  # [s] after which the next step ends a chunk
_PORT = 8765  # of the live view, if it is free


class McapRecorder:
    """Writes the steps of one run to an MCAP file; a context manager.

    Args:
        path: The file, such as ``run.mcap``; its folder is made, an older file is replaced.
        system: What is recorded.
        config: The resolved configuration, as YAML text or as plain data (written as JSON, which is YAML).
        metadata: More to know of the run, such as its seed.
        start_time_ns: Time stamp of the run's time 0 [ns since 1970]. With 0, equal runs give equal files.
        record_problems: Keep every step's quadratic program, so that it can be replayed.
        chunk_size: Numbers [bytes] that wait in memory at most, if more than one step does; what a killed run loses.
        live: Serve every step to viewers as well, at ``address``.

    Attributes:
        address: Where a viewer finds the live view, such as ``ws://127.0.0.1:8765``; None without one.

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
        start_time_ns: int = 0,
        record_problems: bool = True,
        chunk_size: int = 256 * 1024,
        live: bool = False,
    ):
        check_number("start_time_ns", start_time_ns, least=0, whole=True, unit="[ns]")
        check_number("chunk_size", chunk_size, least=1, whole=True, unit="[bytes]")
        states, inputs = system.state_names, system.input_names
        about = _flat(provenance() | {"host": platform.node()} | dict(metadata or {}))
        about |= {"state_names": " ".join(states), "input_names": " ".join(inputs)}
        units = units_by_field(system.units, states, inputs)
        frames = {"positions": system.frame, "z axis": "down" if system.z_down else "up", "display": "z axis up"}
        config = config if isinstance(config, str) else json.dumps(config, indent=2, default=str)

        self.path, self.address = Path(path), None
        self._n, self._m = len(states), len(inputs)
        self._start, self._record_problems, self._chunk_size = start_time_ns, record_problems, chunk_size
        self._encoder = Encoder(system)
        self._waiting: list[Packed] = []
        self._bytes, self._steps, self._last = 0, 0, time.perf_counter()
        self._error: str | None = None
        self._server: Any = None
        self._file = _File(self.path)
        self._context = context = foxglove.Context()  # its channels live as long as it does
        options = MCAPWriteOptions(
            profile="gpmpc",
            chunk_size=None,  # ``_flush`` ends them
            disable_seeking=True,  # a chunk is written in one piece
            compression_threads=0,
            compression_level=1,
        )
        self._writer = foxglove.open_mcap(self._file, context=context, writer_options=options)
        with self._writing(sync=True):
            for name, pairs in (("run", about), ("units", units), ("frames", frames)):
                self._writer.write_metadata(name, pairs)
            stamps = {"log_time": start_time_ns, "create_time": start_time_ns}
            self._writer.attach(name=CONFIG, media_type="application/yaml", data=config.encode(), **stamps)
        self._channels, self._log = self._encoder.channels(context), LogChannel("/log", context=context)
        self._scene = Scene(context, states, system.frame, system.z_down)
        if live:
            self._serve(context)

    def record(self, step: Step, gp_size: int | None = None) -> None:
        """Takes a copy of a step.

        Args:
            step: As a closed loop makes it.
            gp_size: Transitions that the model holds, where the step does not say.

        Raises:
            ShapeError: An array does not fit the names of states and inputs.
            RecordingError: An earlier step could not be written, the recorder is closed, or a step is too large.
        """
        if self._error is not None:
            raise RecordingError(self._error)
        packed = pack(step, gp_size, self._n, self._m, self._record_problems)
        size = len(packed.data)
        if 4 * size > LARGEST:
            raise RecordingError(f"{self.path}: a step of {size} bytes is too large; at most {LARGEST // 4}")
        self._waiting.append(packed)
        self._bytes += size
        if self._server is not None:
            self._serialise()
        if self._bytes > self._chunk_size or time.perf_counter() - self._last > _INTERVAL:
            with self._writing():
                self._serialise()

    def close(self, outcome: str = "complete") -> None:
        """Writes what waits and finishes the file.

        Args:
            outcome: How the run ended; kept as metadata.

        Raises:
            RecordingError: It could not be written; the file is left unfinished.
        """
        if self._file.error is not None:
            raise RecordingError(self._error)
        if self._error is not None:
            return
        with self._writing():
            self._serialise()
        with self._writing(sync=True):
            self._writer.write_metadata("end", {"steps": str(self._steps), "outcome": outcome})
        with self._writing(sync=True, last=True):
            pass
        self._end("the recording is closed")

    def __enter__(self) -> "McapRecorder":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: Any) -> None:
        if error is None or kind is None:
            self.close()
            return
        with contextlib.suppress(RecordingError):  # most likely the same error
            self.close(f"{kind.__name__}: {error}")  # a run that ended in an error has been recorded up to there

    def _serialise(self) -> None:
        """Logs the steps that wait: into the open chunk, and to viewers."""
        if not self._waiting:
            return
        steps = [unpack(packed) for packed in self._waiting]
        stamps = [self._start + round(kept.step.time * 1e9) for kept in steps]
        for topic, row, message in self._encoder.encode(steps):
            self._channels[topic].log(message, log_time=stamps[row])
        self._scene.log(steps, stamps)
        for kept, nanoseconds in zip(steps, stamps, strict=True):
            if kept.step.failed or not kept.status.solved:
                self._log.log(failure_log(kept, nanoseconds), log_time=nanoseconds)
        self._steps += len(self._waiting)
        self._waiting.clear()

    @contextlib.contextmanager
    def _writing(self, sync: bool = False, last: bool = False) -> Iterator[None]:
        """Ends the chunk, or the whole file: what it holds is safe from now on if this process dies.

        Args:
            sync: Put it on the disk as well.
            last: Finish the file.

        Raises:
            RecordingError: It could not be written.
        """
        with self._file.accepting(sync):
            yield
            self._writer.close() if last else self._writer.flush()
        if self._file.error is not None:
            self._end(f"the recording stopped and is unfinished: {self._file.error.strerror}")
            raise RecordingError(self._error) from self._file.error
        self._bytes, self._last = 0, time.perf_counter()

    def _end(self, reason: str) -> None:
        self._error = f"{self.path}: {reason}"
        if self._server is not None:
            self._server.stop()
        self._file.close()

    def _serve(self, context: foxglove.Context) -> None:
        try:
            self._server = foxglove.start_server(name=self.path.name, port=_PORT, context=context)
        except RuntimeError:  # the port is taken
            self._server = foxglove.start_server(name=self.path.name, port=0, context=context)
        self.address = f"ws://127.0.0.1:{self._server.port}"


class _File:
    """The file that the library writes to; takes nothing after an error, nor outside of ``accepting``.

    (A writer that is not closed adds a footer when it is collected, and the file would look finished.)

    Raises:
        RecordingError: The file cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path):
        self.error: OSError | None = None
        self._position = self._whole = 0
        self._accepts = True
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o666)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.ftruncate(self._descriptor, 0)
        except OSError as error:
            os.close(self._descriptor)
            raise RecordingError(f"{path}: another process is recording to this file") from error

    @contextlib.contextmanager
    def accepting(self, sync: bool) -> Iterator[None]:
        """Takes what is written; where that fails, the file is cut to what it held before."""
        self._accepts = True
        try:
            yield
            if sync and self.error is None:
                os.fsync(self._descriptor)
        except OSError as error:
            self.error = error
        finally:
            self._accepts = False
            if self.error is None:
                self._whole = self._position
            else:
                os.ftruncate(self._descriptor, self._whole)

    def write(self, data: bytes | bytearray) -> int:
        """Writes all of the data."""
        left = memoryview(data)
        try:
            while left and self._accepts and self.error is None:
                left = left[os.write(self._descriptor, left) :]
        except OSError as error:
            self.error = error
        self._position += len(data)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Returns the position, which the library reads although it does not seek."""
        return self._position

    def flush(self) -> None:
        """Does nothing: nothing is held back."""

    def close(self) -> None:
        """Lets other processes write the file."""
        os.close(self._descriptor)


def _flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Flattens nested data to the text pairs that a metadata record holds, keys dotted."""
    pairs: dict[str, str] = {}
    for key, value in data.items():
        pairs |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": str(value)}
    return pairs
