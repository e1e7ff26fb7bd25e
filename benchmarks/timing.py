"""Times single calls in turns, and writes machine, tables and files.

The calls that are compared alternate, so that a slow minute of the machine slows all of
them. A time is the processor time of the calling thread, less what reading the clock
costs; one call is one sample, as a control loop meets them.

*Hot* calls find their data in the caches, as in a benchmark's loop; *flushed* ones come
after a walk through a large buffer, as after other work between two control steps.
"""

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from gpmpc._provenance import processor, provenance
from gpmpc.exceptions import check_number

FLUSH_BYTES = (
    64 * 2**20
)  # walked through before a flushed call: more than any core's own caches
WARM_UP_CALLS = 2  # not counted: what is compiled, loaded or allocated once
MATRIX_SIDE = 1000  # of the product that measures the machine's rate
WALK_BYTES = 128 * 2**20  # summed to measure the rate of memory: more than any cache
RESULTS = Path("outputs/benchmarks")


@dataclass(frozen=True)
class Times:
    """Processor times of single calls.

    Attributes:
        seconds: In the order of the calls (S,) [s].
    """

    seconds: np.ndarray

    @property
    def median(self) -> float:
        """[s]."""
        return float(np.median(self.seconds))

    def split(self, in_a_row: int) -> tuple["Times", "Times"]:
        """The first calls of each turn of ``in_a_row`` calls, and those after them."""
        turns = self.seconds.reshape(-1, in_a_row)
        return Times(turns[:, 0]), Times(turns[:, 1:].ravel())

    def over(self, reference: "Times") -> float:
        """Median ratio to another case, call by call of one interleaved timing."""
        calls = min(len(self.seconds), len(reference.seconds))
        return float(np.median(self.seconds[:calls] / reference.seconds[:calls]))

    def summary(self) -> dict[str, float | int]:
        """Median and 99 % quantile in milliseconds, and the number of calls."""
        median, p99 = 1e3 * np.quantile(self.seconds, [0.5, 0.99])
        return {
            "median": float(median),
            "p99": float(p99),
            "samples": len(self.seconds),
        }


def time_interleaved(
    cases: Mapping[str, Callable[[], Any]],
    seconds: float,
    min_rounds: int = 5,
    max_rounds: int = 1000,
    flushed: bool = False,
    in_a_row: int = 1,
) -> dict[str, Times]:
    """Lets every case take a turn in each round, and times every call.

    Args: cases: Calls by name. seconds: Processor time all of them may take together,
        the flushing apart [s]. min_rounds: Rounds at least, whatever the time.
        max_rounds: Rounds at most. flushed: Whether the caches are emptied before every
        call. in_a_row: Calls of a turn: with one, all find the caches as another case
        left them.

    Raises:
        SettingError: Fewer than one round, or no time.
    """
    check_number("seconds", seconds, above=0)
    check_number("min_rounds", min_rounds, least=1, whole=True)
    use_one_thread()
    buffer = np.zeros(FLUSH_BYTES // 8 if flushed else 0)
    overhead = _clock_overhead()
    for call in cases.values():
        for _ in range(WARM_UP_CALLS):
            call()
    samples: dict[str, list[float]] = {name: [] for name in cases}
    spent = 0.0
    for count in range(max(min_rounds, max_rounds)):
        if count >= min_rounds and spent >= seconds:
            break
        for name, call in [turn for turn in cases.items() for _ in range(in_a_row)]:
            if flushed:
                buffer += 1.0
            began = time.thread_time_ns()
            call()
            elapsed = max(time.thread_time_ns() - began - overhead, 0) * 1e-9
            samples[name].append(elapsed)
            spent += elapsed
    return {name: Times(np.array(values)) for name, values in samples.items()}


def _clock_overhead() -> int:
    """Time between two readings of the clock without anything in between [ns]."""
    differences = []
    for _ in range(2000):
        began = time.thread_time_ns()
        differences.append(time.thread_time_ns() - began)
    return int(np.median(differences))


def use_one_thread() -> None:
    """Limits every numerical library of this process to one thread."""
    threadpool_limits(1)
    torch.set_num_threads(1)


def machine() -> dict:
    """Describes the machine as plain data.

    Processor, cores, threads, load, and the rates of a matrix product and of reading
    memory.
    """
    left = np.ones((MATRIX_SIDE, MATRIX_SIDE))
    numbers = np.ones(WALK_BYTES // 8)
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": max((pool["num_threads"] for pool in threadpool_info()), default=1),
        "load": round(os.getloadavg()[0], 2),
        "dgemm_gflops": round(
            2e-9 * MATRIX_SIDE**3 / _shortest(lambda: left @ left), 1
        ),
        "memory_gb_per_s": round(1e-9 * WALK_BYTES / _shortest(numbers.sum), 1),
    }


def _shortest(call: Callable[[], Any]) -> float:
    """Processor time of the fastest of five calls [s]."""
    seconds = []
    for _ in range(5):
        began = time.thread_time()
        call()
        seconds.append(time.thread_time() - began)
    return min(seconds)


def describe(machine: Mapping[str, Any]) -> str:
    """Names the machine in one line."""
    return (
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} "
        f"thread; {machine['dgemm_gflops']} "
        f"GFlop/s in a matrix product, {machine['memory_gb_per_s']} GB/s from memory; "
        f"load {machine['load']}"
    )


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Formats rows as a Markdown table, all columns but the first to the right."""
    cells = [[_cell(value) for value in row] for row in rows]
    widths = [
        max(len(row[i]) for row in [list(header), *cells]) for i in range(len(header))
    ]
    lines = [
        header,
        ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])],
        *cells,
    ]
    padded = [
        [
            f"{text:<{w}}" if i == 0 else f"{text:>{w}}"
            for i, (text, w) in enumerate(zip(line, widths, strict=True))
        ]
        for line in lines
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in padded)


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    return str(value)


def own_source(path: str) -> str:
    """The source of a benchmark, which its kept rows depend on beside gpmpc's code."""
    return Path(path).read_text(encoding="utf-8")


def write_results(name: str, results: Any, **meta: Any) -> Path:
    """Writes results and provenance to ``outputs/benchmarks/NAME.json``."""
    path = RESULTS / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        json.dumps(
            {"meta": provenance() | {"threads": 1} | meta, "results": results}, indent=1
        )
        + "\n"
    )
    print(f"written to {path}")
    return path
