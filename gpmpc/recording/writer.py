"""Problem: serialising and compressing a step takes longer than a fast control loop can wait.

The writer is a process of its own (a thread would hold the interpreter lock while the loop needs it). It takes frames
(``wire``) from the shared memory (``ring``) and writes an MCAP file, whose descriptor it inherits. Its standard input
is the doorbell; its standard output carries "ready" once metadata and configuration are on the disk, and at the end
"done" or one line that says what went wrong.

Only a file that was closed gets a footer. If the loop's process dies, the writer sees the end of its input, writes what
it still holds and leaves the file without footer; if the disk is full, likewise.
"""

import contextlib
import json
import os
from collections.abc import Callable, Sequence
from typing import BinaryIO

import numpy as np
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from gpmpc.qp.record import HEADER
from gpmpc.qp.solution import QPSolution, Terms
from gpmpc.recording import schemas, wire
from gpmpc.recording.encoding import DoublesEncoder
from gpmpc.recording.ring import POSITION, Ring
from gpmpc.recording.scene import CLASSES, LOG, Log, Scene, failure_log

CHUNK_SIZE = 64 * 1024  # [bytes], before compression
STEP, PLAN, QP = "/step", "/plan", "/qp"
CONFIG = "config.yaml"


class StepWriter:
    """Writes steps as messages.

    Args:
        file: Where to; metadata and configuration are written, and on the disk, when the constructor returns.
        setup: What ``McapRecorder`` sends first.
    """

    def __init__(self, file: BinaryIO, setup: dict):
        self._file, self._setup = file, setup
        self._states, self._inputs = setup["state_names"], setup["input_names"]
        self._steps = 0
        self._writer = Writer(file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="", library="gpmpc")
        for name in ("run", "units", "frames"):
            self._writer.add_metadata(name, setup[name])
        start = setup["start_time_ns"]
        self._writer.add_attachment(start, start, CONFIG, "application/yaml", setup["config"].encode())
        self._to_disk()

        self._scene = Scene(self._states, setup["frame"], setup["z_down"])
        declared = schemas.message_classes(self._states, self._inputs)
        topics = {STEP: declared[schemas.STEP], PLAN: declared[schemas.PLAN]}
        topics |= {QP: declared[schemas.QP]} if setup["record_problems"] else {}
        topics |= {topic: CLASSES[topic] for topic in self._scene.topics} | {LOG: Log}
        registered: dict[str, int] = {}
        self._channels = {}
        for topic, message_class in topics.items():
            name = message_class.DESCRIPTOR.full_name
            if name not in registered:
                registered[name] = register_schema(self._writer, message_class)
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.Protobuf, registered[name])

        twins = schemas.message_classes(self._states, self._inputs, schemas.WRITTEN)
        self._step, self._plan, self._qp = twins[schemas.STEP], twins[schemas.PLAN], twins[schemas.QP]
        groups = (schemas.STATE, schemas.INPUT, schemas.TIMINGS, schemas.RESIDUES, schemas.STAGE)
        self._encode = {name: DoublesEncoder(declared[name]).encode for name in groups}
        self._encode_last = DoublesEncoder(declared[schemas.STAGE], without="input").encode
        bounds = self._encode[schemas.INPUT](np.array(setup["input_bounds"])) if setup["input_bounds"] else ()
        self._bounds = dict(zip(("input_lower", "input_upper"), bounds, strict=False))

    def write(self, content: bytes | memoryview) -> None:
        """Writes the step of a frame."""
        step = wire.unpack(content, len(self._states), len(self._inputs))
        nanoseconds = self._setup["start_time_ns"] + round(step.time * 1e9)
        stamp = Timestamp(seconds=nanoseconds // 10**9, nanos=nanoseconds % 10**9)

        def put(topic: str, message) -> None:
            data = message.SerializeToString()
            self._writer.add_message(self._channels[topic], nanoseconds, data, nanoseconds, step.k)

        put(STEP, self._step_message(step))
        put(PLAN, self._plan_message(step))
        if step.qp is not None and self._setup["record_problems"]:
            put(QP, self._qp_message(step))
        for topic, message in self._scene.draw(step, stamp):
            put(topic, message)
        log = failure_log(step, stamp)
        if log is not None:
            put(LOG, log)
        self._file.flush()  # whole chunks, if any: they are safe from now on if this process dies
        self._steps += 1

    def interrupt(self) -> None:
        """Writes what is held back; the file stays unfinished."""
        self._writer.flush()
        self._to_disk()

    def finish(self, outcome: str) -> None:
        """Writes the index and the footer; if that fails, the file does not look finished."""
        self._writer.add_metadata("end", {"steps": str(self._steps), "outcome": outcome})
        self._writer.flush()
        self._to_disk()
        whole = self._file.tell()
        try:
            self._writer.finish()
            self._to_disk()
        except OSError:
            os.ftruncate(self._file.fileno(), whole)
            raise

    def _to_disk(self) -> None:
        self._file.flush()
        os.fsync(self._file.fileno())

    def _step_message(self, step: wire.PackedStep):
        model, build, solve = step.timing
        active, residuals = _quality(step.qp)
        std = _deviation(step.belief_covariance)
        states = np.array([step.reference, step.state, step.measured, step.innovation, std])
        reference, state, measured, innovation, belief_std = self._encode[schemas.STATE](states)
        return self._step(
            time=step.time,
            k=step.k,
            reference=reference,
            state=state,
            measured=measured,
            input=self._one(schemas.INPUT, step.input),
            **self._bounds,
            innovation=innovation,
            belief_std=belief_std,
            belief_covariance=step.belief_covariance.tobytes(),
            status=wire.STATUSES.index(step.status),
            iterations=step.iterations,
            active_set_size=active,
            timing=self._one(schemas.TIMINGS, (model, build, solve, model + build + solve)),
            residuals=self._one(schemas.RESIDUES, residuals),
            gp_size=step.gp_size,
            gp_version=step.gp_version,
            failed=step.failed,
        )

    def _plan_message(self, step: wire.PackedStep):
        times = step.time + self._setup["time_step"] * np.arange(len(step.means))
        table = np.column_stack([times, step.means, _deviation(step.covariances)])
        stages = self._encode[schemas.STAGE](np.hstack([table[:-1], step.inputs])) + self._encode_last(table[-1:])
        return self._plan(time=step.time, k=step.k, stages=stages, covariances=step.covariances.tobytes())

    def _one(self, name: str, values: Sequence[float]) -> bytes:
        return self._encode[name](np.array([values]))[0]

    def _qp_message(self, step: wire.PackedStep):
        qp = step.qp
        n, M = len(qp.q), len(qp.lower)
        arrays = {name: getattr(qp, name).tobytes() for name in ("P", "q", "G", "lower", "upper", "softness")}
        if len(qp.record):
            x, multipliers = np.split(qp.record[HEADER : HEADER + n + M], [n])
            arrays |= {"x": x.tobytes(), "multipliers": multipliers.tobytes()}
        return self._qp(time=step.time, k=step.k, variables=n, rows=M - n, **arrays)


def _deviation(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0))


def _quality(qp: wire.PackedQP | None) -> tuple[int, tuple[float, float, float]]:
    """Size of the active set, and the residuals; zero and NaN where there is no solution to judge."""
    if qp is None or not len(qp.record):
        return 0, (np.nan, np.nan, np.nan)
    x = qp.record[HEADER : HEADER + len(qp.q)]
    solution = QPSolution(x, Terms(qp.P, qp.G, qp.softness), qp.q, qp.lower, qp.upper, qp.record, 0.0, 0.0)
    return int(np.count_nonzero(solution.active_set)), solution.residuals()


def serve(ring: Ring, file: BinaryIO, hear: Callable[[], int | None], answer: Callable[[str], None]) -> None:
    """Writes what comes until the last frame, or until the loop's process has died.

    Args:
        ring: Where frames come from.
        file: Where they go.
        hear: Waits for the position up to which frames are whole; None once nobody rings any more.
        answer: Sends a line to the loop's process.
    """
    writer: StepWriter | None = None
    alive = True
    while alive:
        announced = hear()
        alive = announced is not None
        while (taken := ring.take(announced if alive else ring.given)) is not None:
            kind, content = taken
            if kind == wire.SETUP:
                writer = StepWriter(file, json.loads(bytes(content)))
                answer("ready")
            elif kind == wire.STEP:
                writer.write(content)
            else:
                writer.finish(bytes(content).decode())
                answer("done")
                return
            ring.done(len(content))
    if writer is not None:
        writer.interrupt()


def main(file: int, memory: int) -> None:
    """The writer's process.

    Args:
        file: Descriptor of the file to write, open and empty.
        memory: Descriptor of the ring.
    """

    def answer(line: str) -> None:
        os.write(1, f"{line}\n".encode())

    def hear() -> int | None:
        positions = os.read(0, 1 << 16)
        return POSITION.unpack(positions[-POSITION.size :])[0] if positions else None

    with contextlib.suppress(AttributeError, OSError):  # Linux: be no rival to the loop, which wakes this process up
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    os.nice(5)
    try:
        serve(Ring(memory), os.fdopen(file, "wb"), hear, answer)
    except Exception as error:
        reason = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        try:
            answer(" ".join(str(reason or error).split()))
        finally:
            os._exit(1)  # nothing that is still buffered may reach the file
    os._exit(0)  # everything is on the disk; the memory of the ring is still in use, and goes with the process
