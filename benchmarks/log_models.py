"""What ``gpmpc learn`` makes of logs, beside what costs nothing.

    .venv/bin/python -m benchmarks.log_models [--plants pendulum ...] [--fly]
    .venv/bin/python -m benchmarks.log_models --flights FOLDER [--splits 6]

Six simulated plants (``log_plants``): 60 s of excited runs with noise on every state,
at 100 Hz; the model is learned from the first 48 s and judged on the last 12 s. With
``--flights``, the airborne flights of NanoBench in a folder (Ullah and Baca, 2026,
arXiv:2603.09908; not part of this package), two held out of each split. A line for each
group of states and step ahead: the model's mean error, over that of the best baseline,
coverage and width of its 95 % intervals. With ``--fly`` each model is flown to its
plant's task (``log_flights``); with ``--for-control`` it is one to plan with.
``--plants "lagging pendulum"`` is one more plant. Lines are also appended to
``outputs/benchmarks/log_models.jsonl``.
"""

import argparse
import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.log_flights import TASKS, compare
from benchmarks.log_plants import Plant, lagging_pendulum, plants
from benchmarks.timing import RESULTS
from gpmpc.logs import (
    IdentifiedModel,
    Judgement,
    Log,
    LogMapping,
    judge,
    learn,
    read_log,
)
from gpmpc.logs._log import LogRun

MOST = 1.02  # of the best baseline's error
COVERAGE = (0.90, 0.98)
WIDTH = (0.9, 1.2)
NANOBENCH = {
    "time": "t",
    "keep": {"pz": [0.2, None]},
    "model": "rigid_body",
    "states": {
        "position": {"columns": ["px", "py", "pz"], "unit": "m"},
        "attitude": {"columns": ["qx", "qy", "qz", "qw"], "kind": "quaternion"},
        "velocity": {"columns": ["vx", "vy", "vz"], "unit": "m/s", "frame": "world"},
        "rate": {
            "columns": [f"w{axis}_vicon" for axis in "xyz"],
            "unit": "rad/s",
            "frame": "body",
        },
    },
    "inputs": {
        "motors": {
            "columns": [f"motor_motor_m{i}" for i in range(1, 5)],
            "scale": 1 / 65535,
        }
    },
    "context": {"battery": {"columns": ["pwr_pm_vbat"], "unit": "V"}},
}


class Case(NamedTuple):
    """A log to learn from, and one to judge on."""

    name: str
    train: Log
    held_out: Log
    plant: Plant | None = None
    seed: int = 0


def plant_cases(names: list[str], seeds: int) -> Iterator[Case]:
    """Simulates the logs of plants."""
    chosen = plants()
    if names:
        chosen = [one for one in (*chosen, lagging_pendulum()) if one.name in names]
    for plant in chosen:
        for seed in range(seeds):
            table = plant.log(seed)
            mapping = LogMapping.from_dict(dict(plant.mapping))
            states = mapping.column_names("states")
            inputs = mapping.column_names("inputs")
            run = LogRun(
                name="run",
                time=table["t"].to_numpy(),
                states=table[list(states)].to_numpy(),
                inputs=table[list(inputs)].to_numpy(),
                context=np.empty((len(table), 0)),
            )
            train, held_out = Log(mapping, 0.01, (run,)).split_by_time(0.8)
            yield Case(f"{plant.name}, seed {seed}", train, held_out, plant, seed)


def flight_cases(folder: Path, splits: int) -> Iterator[Case]:
    """Reads flights; every split holds out two others."""
    log = read_log(sorted(folder.glob("*.csv.gz")), NANOBENCH)
    names = [run.name for run in log if len(run) > 500]
    pairs = list(itertools.combinations(names, 2))
    for pair in pairs[:: max(len(pairs) // splits, 1)][:splits]:
        others = [name for name in names if name not in pair]
        training_runs = [run.name for run in log if run.name not in others]
        train, held_out = log.split(training_runs)
        if len(held_out.runs) > 2:
            _, held_out = held_out.split([*pair])
        yield Case(" + ".join(pair), train, held_out)


def lines(case: Case, judgement: Judgement) -> list[dict[str, Any]]:
    """Returns a line for each step and group."""
    baselines = {n: e for n, e in judgement.mean.items() if n != "model"}
    result = []
    for k, step in enumerate(judgement.steps):
        for g, group in enumerate(judgement.groups):
            best = min(baselines, key=lambda name: baselines[name][k, g])
            error = judgement.mean["model"][k, g]
            result.append(
                {
                    "case": case.name,
                    "step": step,
                    "group": group,
                    "error": float(error),
                    "baseline": best,
                    "ratio": float(error / baselines[best][k, g]),
                    "coverage": float(judgement.coverage[k, g]),
                    "width": float(judgement.width[k, g]),
                }
            )
    return result


def report(case: Case, learned: IdentifiedModel, judgement: Judgement) -> None:
    """Prints what became of a case, and keeps it."""
    chosen = next(c.name for c in learned.candidates if c.chosen)
    print(f"{case.name}: {chosen}")
    rows = lines(case, judgement)
    for row in rows:
        faults = ""
        if row["ratio"] > MOST:
            faults += "  LOSES"
        if row["step"] > 1 and not COVERAGE[0] <= row["coverage"] <= COVERAGE[1]:
            faults += "  COVERAGE"
        if row["step"] > 1 and not WIDTH[0] <= row["width"] <= WIDTH[1]:
            faults += "  WIDTH"
        print(
            f"  {row['step']:3d} {row['group']:10s} {row['error']:.4g} "
            f"{row['ratio']:.3f} of {row['baseline']}, "
            f"coverage {row['coverage']:.3f}, width {row['width']:.2f}{faults}"
        )
    keep([row | {"chosen": chosen} for row in rows])


def keep(rows: list[dict[str, Any]]) -> None:
    """Appends lines to the results."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    with (RESULTS / "log_models.jsonl").open("a", encoding="utf-8") as file:
        for row in rows:
            file.write(json.dumps(row) + "\n")


def main() -> None:
    """Learns from every log, and reports."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", nargs="*", default=[])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--flights", type=Path)
    parser.add_argument("--splits", type=int, default=6)
    parser.add_argument("--fly", action="store_true")
    parser.add_argument("--for-control", action="store_true")
    parser.add_argument("--progress", action="store_true")
    arguments = parser.parse_args()
    if arguments.flights is None:
        cases = plant_cases(arguments.plants, arguments.seeds)
    else:
        cases = flight_cases(arguments.flights, arguments.splits)
    for case in cases:
        began = time.process_time()
        show = print if arguments.progress else (lambda text: None)
        learned = learn(case.train, progress=show, for_control=arguments.for_control)
        judgement = judge(learned, case.held_out, case.train)
        report(case, learned, judgement)
        print(f"  {time.process_time() - began:.0f} s of one core", flush=True)
        if arguments.fly and case.plant is not None and case.plant.name in TASKS:
            keep([compare(case.plant, learned, case.seed)])


if __name__ == "__main__":
    main()
