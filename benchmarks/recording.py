"""What does recording cost a control loop, in a loop of 1 kHz?

    .venv/bin/python -m benchmarks.recording                 # about a minute
    .venv/bin/python -m benchmarks.recording --horizon 20 --seconds 10

A step is that of the quadrotor: n = 6, m = 3, a plan over the horizon H with covariances, and the condensed quadratic
program (3 H variables, 6 H rows). Sixteen different steps take turns: in use, too, a step's numbers have just been
written, and lie in the cache. Two questions, each with and without recorder, the two taking turns:

*Paced*: every step begins on the millisecond, works for half of it (arithmetic in the interpreter, so anything that
holds the interpreter's lock or the core shows up), records, and waits for the next. Reported: the time of ``record``
itself, the processor time in it, which other processes on the machine blur less, and how the work's time changes.

*Flat out*: steps of a millisecond of work each, without waiting. Reported: how much longer it takes, by the clock and
in the loop's processor time (the writer's process has a core of its own only if one is free).

A third way takes turns with the two: one plain copy of as many bytes into private memory of the ring's size. Where the
machine itself holds up writes to memory (one copy in twenty by 0.2 ms on some virtual ones), it shows there as well.

Also: what a step costs the writer's process, which is what a thread in the loop's process would take from the loop.
"""

import argparse
import json
import os
import platform
import tempfile
from pathlib import Path
from time import perf_counter, process_time, thread_time

import numpy as np

from gpmpc.mpc.controller import Decision, Timing
from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.recording import McapRecorder, Step, wire
from gpmpc.recording.ring import CAPACITY, FRAME
from gpmpc.recording.writer import StepWriter
from gpmpc.status import Status

STATES, INPUTS = ("x", "vx", "y", "vy", "z", "vz"), ("U1", "ux", "uy")
PERIOD = 1e-3  # [s]


def make_steps(horizon: int, count: int) -> list[Step]:
    """Steps that are all different."""
    rng, n, m = np.random.default_rng(0), len(STATES), len(INPUTS)
    variables, rows = m * horizon, n * horizon
    solver, steps = DualActiveSet(), []
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
            Step(k * PERIOD, k, reference, state, measured, inputs[0], decision, innovation, 0.1 * np.eye(n), 100, k)
        )
    return steps


def work(seconds_of_work: int) -> float:
    """Arithmetic in the interpreter."""
    total = 0.0
    for i in range(seconds_of_work):
        total += i * 0.5
    return total


class PlainCopy:
    """Copies as many numbers as a step has, to a place that moves on."""

    def __init__(self, steps: list[Step]):
        head, _, length = wire.pack(steps[0], len(STATES), len(INPUTS))
        count = (len(head) + length) // 8
        self._sources = [np.random.default_rng(k).standard_normal(count) for k in range(len(steps))]
        self._numbers, self._at = np.zeros(CAPACITY // 8), 0

    def record(self, step: Step) -> None:
        """Copies."""
        source = self._sources[step.k]
        if self._at + len(source) > len(self._numbers):
            self._at = 0
        self._numbers[self._at : self._at + len(source)] = source
        self._at += len(source)


def calibrate(seconds: float) -> int:
    """How much ``work`` takes that long."""
    counts = 20_000
    best = min(_timed(counts) for _ in range(20))
    return max(1, round(counts * seconds / best))


def _timed(count: int) -> float:
    began = perf_counter()
    work(count)
    return perf_counter() - began


def loop(
    steps: list[Step], count: int, amount: int, recorder: McapRecorder | PlainCopy | None, paced: bool
) -> dict[str, np.ndarray]:
    """Times of work and of recording of every step [s]."""
    works, records, processor = np.zeros(count), np.zeros(count), np.zeros(count)
    started, started_processor = perf_counter(), thread_time()
    for k in range(count):
        if paced:
            while perf_counter() < started + k * PERIOD:
                pass
        began = perf_counter()
        work(amount)
        worked_processor, worked = thread_time(), perf_counter()
        if recorder is not None:
            recorder.record(steps[k % len(steps)])
        ended = perf_counter()
        works[k], records[k], processor[k] = worked - began, ended - worked, thread_time() - worked_processor
    totals = np.array([perf_counter() - started, thread_time() - started_processor])
    return {"work": works, "record": records, "processor": processor, "total": totals}


def writer_cost(steps: list[Step], settings: dict) -> float:
    """Processor time that a step costs the writer [s]."""
    setup = {
        "state_names": STATES,
        "input_names": INPUTS,
        "time_step": PERIOD,
        "run": {},
        "units": {},
        "frames": {},
        "config": "",
        "input_bounds": None,
        "frame": "world",
        "z_down": True,
        "start_time_ns": 0,
    } | settings
    packed = [wire.pack(step, len(STATES), len(INPUTS)) for step in steps]
    frames = [head[FRAME.size :] + b"".join(arrays) for head, arrays, _ in packed] * 10
    with tempfile.TemporaryFile() as file:
        writer = StepWriter(file, setup)
        writer.write(frames[0])
        began = process_time()
        for content in frames[1:]:
            writer.write(content)
        return (process_time() - began) / (len(frames) - 1)


def measure(horizon: int, seconds: float, record_problems: bool, turns: int) -> dict:
    """One line of the table."""
    steps, count = make_steps(horizon, 16), round(seconds / PERIOD / turns)
    half, whole = calibrate(0.5 * PERIOD), calibrate(PERIOD)
    paced: dict[bool, list] = {False: [], True: []}
    flat: dict[bool, list] = {False: [], True: []}
    closing, copies = [], []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(turns):
            copies.append(loop(steps, count, half, PlainCopy(steps), paced=True)["record"])
            for recording in (False, True):
                for results, amount, is_paced in ((paced, half, True), (flat, whole, False)):
                    recorder = None
                    if recording:
                        recorder = McapRecorder(
                            Path(folder) / f"{turn}.mcap",
                            STATES,
                            INPUTS,
                            time_step=PERIOD,
                            record_problems=record_problems,
                        )
                    results[recording].append(loop(steps, count, amount, recorder, is_paced))
                    if recorder is not None:
                        began = perf_counter()
                        recorder.close()
                        closing.append(perf_counter() - began)
        size = (Path(folder) / "0.mcap").stat().st_size / count
    records, copied = np.concatenate([run["record"] for run in paced[True]]), np.concatenate(copies)
    processor = {key: np.concatenate([run["processor"] for run in runs]) for key, runs in paced.items()}
    works = {key: np.concatenate([run["work"] for run in runs]) for key, runs in paced.items()}
    totals = {key: np.min([run["total"] for run in runs], axis=0) for key, runs in flat.items()}
    slowdown = totals[True] / totals[False] - 1
    return {
        "horizon": horizon,
        "record_problems": record_problems,
        "steps": int(count * turns),
        "record_mean_us": 1e6 * records.mean(),
        "record_median_us": 1e6 * np.median(records),
        "record_p99_us": 1e6 * np.quantile(records, 0.99),
        "copy_mean_us": 1e6 * copied.mean(),
        "copy_median_us": 1e6 * np.median(copied),
        "copy_p99_us": 1e6 * np.quantile(copied, 0.99),
        "record_processor_mean_us": 1e6 * (processor[True].mean() - processor[False].mean()),
        "record_processor_median_us": 1e6 * (np.median(processor[True]) - np.median(processor[False])),
        "work_change_median_us": 1e6 * (np.median(works[True]) - np.median(works[False])),
        "work_p99_us": {"without": 1e6 * np.quantile(works[False], 0.99), "with": 1e6 * np.quantile(works[True], 0.99)},
        "flat_out_slowdown": {"wall": slowdown[0], "processor": slowdown[1]},
        "close_seconds": max(closing),
        "load_average": os.getloadavg()[0],
        "writer_us_per_step": 1e6 * writer_cost(steps, {"record_problems": record_problems}),
        "file_bytes_per_step": size,
    }


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--horizon", type=int, nargs="+", default=[10, 20])
    parser.add_argument("--seconds", type=float, default=6.0, help="of loop a line, each way")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--out", type=Path, help="folder of recording.json")
    arguments = parser.parse_args()
    rows = []
    for horizon in arguments.horizon:
        for record_problems in (True, False):
            rows.append(measure(horizon, arguments.seconds, record_problems, arguments.turns))
            row = rows[-1]
            print(
                f"H {horizon:3d}, problems {'kept' if record_problems else 'not kept':8s}: record() median "
                f"{row['record_median_us']:5.1f} us, mean {row['record_mean_us']:5.1f} (processor time "
                f"{row['record_processor_mean_us']:5.1f}, median {row['record_processor_median_us']:5.1f}), p99 "
                f"{row['record_p99_us']:6.1f}; a plain copy {row['copy_median_us']:.1f}, "
                f"mean {row['copy_mean_us']:.1f}, p99 {row['copy_p99_us']:.1f}; work "
                f"{row['work_change_median_us']:+5.1f} us; flat out {100 * row['flat_out_slowdown']['wall']:+.1f} % "
                f"(processor time {100 * row['flat_out_slowdown']['processor']:+.1f} %); the writer "
                f"{row['writer_us_per_step']:.0f} us, {row['file_bytes_per_step'] / 1e3:.1f} kB a step; close "
                f"{row['close_seconds']:.2f} s; load average {row['load_average']:.1f}",
                flush=True,
            )
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
        document = {"machine": machine, "python": platform.python_version(), "rows": rows}
        (arguments.out / "recording.json").write_text(json.dumps(document, indent=2) + "\n")


if __name__ == "__main__":
    main()
