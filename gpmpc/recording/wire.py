"""Problem: a step has to leave the control loop in a few microseconds, however long it takes to write it to a file.

The loop and the writer are two processes with shared memory between them (``ring``). What crosses it is frames: a kind
and a length, then, for a step, one packed head and the step's arrays as they lie in memory (float64). The small
arrays are gathered behind the head, since a call for each costs more than a copy; P and G go from where they are to the
shared memory in one. The writer finds every array by the sizes in the head.
"""

import struct
from dataclasses import dataclass

import numpy as np

from gpmpc.exceptions import ShapeError
from gpmpc.qp.record import HEADER
from gpmpc.recording.ring import FRAME
from gpmpc.status import Status
from gpmpc.step import Step

Array = np.ndarray

SETUP, STEP, END = 0, 1, 2
STATUSES = tuple(Status)

# time, k, gp_size, gp_version, status, iterations, failed, H, n and m of the QP, length of its record, timing
_HEAD = struct.Struct("<dqqqqqqqqqqddd")
_float64 = np.dtype(np.float64)
_NUMBERS = {status: number for number, status in enumerate(STATUSES)}


def frame(kind: int, content: bytes) -> bytes:
    """A frame of setup or end."""
    return FRAME.pack(kind, len(content)) + content


def pack(step: Step, states: int, inputs: int) -> tuple[bytes, list[Array], int]:
    """The frame of a step: its head with all small arrays, the large ones that follow, and their length [bytes].

    Args:
        step: What to pack.
        states: n.
        inputs: m.

    Raises:
        ShapeError: An array of the step does not fit n and m.
    """
    decision = step.decision
    H = len(decision.inputs)
    arrays = [
        step.reference,
        step.state,
        step.measured,
        step.innovation,
        step.input,
        step.belief_covariance,
        decision.inputs,
        decision.means,
        decision.covariances,
    ]
    expected = _size(states, inputs, H)
    solution, problem = decision.solution, decision.problem
    variables = rows = record = 0
    large: list[Array] = []
    if solution is not None:
        (P, G, softness), q = solution.terms, solution.q
        variables, rows = len(q), len(G)
        record = HEADER + 3 * variables + 2 * rows  # without the factor
        arrays += [q, solution.lower, solution.upper, softness, solution.record[:record]]
        large = [P, G]
    elif problem is not None:
        P, G, variables, rows = problem.P, problem.G, len(problem.q), len(problem.G)
        hard = np.zeros((2, variables + rows))
        hard[1] = np.inf
        arrays += [problem.q, problem.lower, problem.upper, hard]
        large = [P, G]
    if large:
        expected += 5 * variables + 4 * rows + record
    length = 0
    for i, array in enumerate(arrays):
        if array.__class__ is not np.ndarray or array.dtype is not _float64 or not array.flags.c_contiguous:
            array = arrays[i] = np.ascontiguousarray(array, dtype=np.float64)
        length += array.nbytes
    if length != 8 * expected or (large and (P.shape != (variables, variables) or G.shape != (rows, variables))):
        _explain(step, states, inputs)
    following = 8 * variables * (variables + rows)
    timing = decision.timing
    head = _HEAD.pack(
        step.time,
        step.k,
        step.gp_size,
        step.gp_version,
        _NUMBERS[decision.status],
        decision.iterations,
        step.failed,
        H,
        variables,
        rows,
        record,
        timing.model,
        timing.build,
        timing.solve,
    )
    return b"".join([FRAME.pack(STEP, _HEAD.size + length + following), head, *arrays]), large, following


@dataclass(frozen=True, eq=False)
class PackedQP:
    """A quadratic program ``min 1/2 x'Px + q'x``, ``lower <= [x; Gx] <= upper``, and the record of its solution.

    Attributes:
        P: (n, n).
        q: (n,).
        G: (m, n).
        lower: (M,), M = n + m.
        upper: (M,).
        softness: (2, M), see ``gpmpc.qp.soft_rows``.
        record: See ``gpmpc.qp.record``; empty where there is no solution.
    """

    P: Array
    q: Array
    G: Array
    lower: Array
    upper: Array
    softness: Array
    record: Array


@dataclass(frozen=True, eq=False)
class PackedStep:
    """A step as the writer receives it; the fields of ``Step`` and ``Decision`` in one level."""

    time: float  # [s]
    k: int
    gp_size: int
    gp_version: int
    status: Status
    iterations: int
    failed: bool
    timing: tuple[float, float, float]  # model, build, solve [s]
    reference: Array
    state: Array
    measured: Array
    innovation: Array
    input: Array
    belief_covariance: Array
    inputs: Array
    means: Array
    covariances: Array
    qp: PackedQP | None


def unpack(content: bytes | memoryview, states: int, inputs: int) -> PackedStep:
    """The step of a frame; its arrays are views of ``content``."""
    time, k, size, version, status, iterations, failed, H, variables, rows, record, *timing = _HEAD.unpack_from(content)
    numbers, start = np.frombuffer(content, np.float64, offset=_HEAD.size), 0

    def take(*shape: int) -> Array:
        nonlocal start
        count = 1
        for length in shape:
            count *= length
        start += count
        return numbers[start - count : start].reshape(shape)

    n, m = states, inputs
    head = (time, k, size, version, STATUSES[status], iterations, bool(failed), tuple(timing))
    vectors = [take(n) for _ in range(4)]
    arrays = [*vectors, take(m), take(n, n), take(H, m), take(H + 1, n), take(H + 1, n, n)]
    qp, v, M = None, variables, variables + rows
    if variables:
        small = {"q": take(v), "lower": take(M), "upper": take(M), "softness": take(2, M), "record": take(record)}
        qp = PackedQP(P=take(v, v), G=take(rows, v), **small)
    return PackedStep(*head, *arrays, qp)


def _size(n: int, m: int, H: int) -> int:
    return 4 * n + m + n * n + H * m + (H + 1) * (n + n * n)


def _explain(step: Step, n: int, m: int) -> None:
    """Raises with the first array of a step that has another shape than it should."""
    decision = step.decision
    H = len(decision.inputs)
    shapes = {"reference": (n,), "state": (n,), "measured": (n,), "innovation": (n,), "input": (m,)}
    shapes |= {"belief_covariance": (n, n)}
    plan = {"inputs": (H, m), "means": (H + 1, n), "covariances": (H + 1, n, n)}
    for owner, fields in ((step, shapes), (decision, plan)):
        for name, shape in fields.items():
            if np.shape(getattr(owner, name)) != shape:
                raise ShapeError(f"step {step.k}: {name} must be {shape}; got {np.shape(getattr(owner, name))}")
    raise ShapeError(f"step {step.k}: the quadratic program's arrays do not belong together")
