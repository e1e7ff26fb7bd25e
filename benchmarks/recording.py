"""Measures what recording costs a control loop.

    .venv/bin/python -m benchmarks.recording                 # about a minute
    .venv/bin/python -m benchmarks.recording --horizon 20 --seconds 10

A step is that of the quadrotor: n = 6, m = 3, a plan over the horizon H with
covariances, and the condensed quadratic program (3 H variables, 6 H rows). Sixteen
different steps take turns: in use, too, a step's numbers have just been written, and
lie in the cache. Steps are a millisecond apart, so that thirty pictures a second are
drawn; with ``--apart 0.1`` every step is. Every step works for half a millisecond
(arithmetic in the interpreter) and is recorded.

Reported: the time of ``record`` (median, mean, 99 % quantile; every few steps it
serialises and compresses those that wait), and how much longer the loop takes than one
without a recorder, the two taking turns.
"""

import argparse
import os
import tempfile
from pathlib import Path
from time import perf_counter

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

from dataclasses import replace

import numpy as np

from benchmarks.timing import write_results
from gpmpc.mpc import Decision, Timing
from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.recording import McapRecorder, RecordedSystem, Step
from gpmpc.status import Status

STATES = ("x", "vx", "y", "vy", "z", "vz")
INPUTS = ("U1", "ux", "uy")


def make_steps(horizon: int, count: int) -> list[Step]:
    """Steps that are all different."""
    rng = np.random.default_rng(0)
    n = len(STATES)
    m = len(INPUTS)
    variables = m * horizon
    rows = n * horizon
    solver = DualActiveSet()
    steps = []
    for k in range(count):
        A = rng.standard_normal((variables, variables))
        bounds = {"h_lower": -np.full(rows, 5.0), "h_upper": np.full(rows, 5.0)}
        program = QuadraticProgram(
            A @ A.T + variables * np.eye(variables),
            rng.standard_normal(variables),
            np.tril(rng.standard_normal((rows, variables))),
            **bounds,
        )
        roots = rng.standard_normal((horizon + 1, n, n))
        inputs = rng.standard_normal((horizon, m))
        decision = Decision(
            input=inputs[0],
            inputs=inputs,
            means=rng.standard_normal((horizon + 1, n)),
            covariances=0.01 * roots @ roots.mT,
            status=Status.SOLVED,
            iterations=5,
            timing=Timing(1e-4, 1e-4, 1e-4),
            problem=program,
            solution=solver.solve(program),
        )
        vectors = [rng.standard_normal(n) for _ in range(4)]
        reference, state, measured, innovation = vectors
        steps.append(
            Step(
                0.0,
                0,
                reference,
                state,
                measured,
                inputs[0],
                decision,
                innovation,
                0.1 * np.eye(n),
                100,
                k,
            )
        )
    return steps


def loop(
    steps: list[Step], count: int, apart: float, recorder: McapRecorder | None
) -> tuple[np.ndarray, float]:
    """Runs a loop; the times of ``record`` (count,) [s], and of the whole loop [s]."""
    seconds = np.zeros(count)
    began = perf_counter()
    for k in range(count):
        total = 0.0
        for i in range(10_000):  # about half a millisecond
            total += i * 0.5
        if recorder is not None:
            step = replace(steps[k % len(steps)], time=k * apart, k=k)
            start = perf_counter()
            recorder.record(step)
            seconds[k] = perf_counter() - start
    return seconds, perf_counter() - began


def measure(
    horizon: int, seconds: float, apart: float, record_problems: bool, turns: int
) -> dict:
    """Measures one line of the table."""
    steps = make_steps(horizon, 16)
    count = round(seconds / 1e-3 / turns)
    system = RecordedSystem(
        STATES, INPUTS, time_step=apart, pose={axis: axis for axis in "xyz"}
    )
    records = []
    with_recorder = []
    without = []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(turns):
            path = Path(folder) / f"{turn}.mcap"
            without.append(loop(steps, count, apart, None)[1])
            with McapRecorder(
                path, system, record_problems=record_problems
            ) as recorder:
                took, total = loop(steps, count, apart, recorder)
            records.append(took)
            with_recorder.append(total)
        size = path.stat().st_size / count
    took = 1e6 * np.concatenate(records)
    return {
        "horizon": horizon,
        "apart": apart,
        "record_problems": record_problems,
        "steps": int(count * turns),
        "record_median_us": float(np.median(took)),
        "record_mean_us": float(took.mean()),
        "record_p99_us": float(np.quantile(took, 0.99)),
        "loop_longer_us_a_step": 1e6 * (min(with_recorder) - min(without)) / count,
        "file_bytes_per_step": size,
        "load_average": os.getloadavg()[0],
    }


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--horizon", type=int, nargs="+", default=[10, 20])
    parser.add_argument(
        "--seconds", type=float, default=3.0, help="of loop a line, each way"
    )
    parser.add_argument(
        "--apart",
        type=float,
        default=0.001,
        help="time between two steps of the plant [s]",
    )
    parser.add_argument("--turns", type=int, default=3)
    arguments = parser.parse_args()
    rows = []
    for horizon in arguments.horizon:
        for record_problems in (True, False):
            row = measure(
                horizon,
                arguments.seconds,
                arguments.apart,
                record_problems,
                arguments.turns,
            )
            rows.append(row)
            print(
                f"H {horizon:3d}, problems "
                f"{'kept' if record_problems else 'not kept':8s}: record() median "
                f"{row['record_median_us']:5.1f} us, mean "
                f"{row['record_mean_us']:5.1f}, p99 "
                f"{row['record_p99_us']:6.0f}; the loop "
                f"{row['loop_longer_us_a_step']:+5.0f} us a step; "
                f"{row['file_bytes_per_step'] / 1e3:.1f} kB a step; load average "
                f"{row['load_average']:.1f}",
                flush=True,
            )
    write_results("recording", rows)


if __name__ == "__main__":
    main()
