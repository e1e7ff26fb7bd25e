"""Measures what a sweep costs beside its flights, and what 100 000 runs cost to read.

    python -m benchmarks.sweeps fly FOLDER           2 000 short flights by joblib
    python -m benchmarks.sweeps make FOLDER 100000   a sweep that looks finished
    python -m benchmarks.sweeps read FOLDER          times and memory of reading it

``make`` flies one run, and writes its result under other choices with other numbers,
as if each had been flown. The folders are for measuring alone: remove them.
"""

import argparse
import json
import os
import random
import statistics
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

FLIGHT = ["system=double_integrator", "steps=2", "recorder=none"]
SEEDS = 10  # of every combination of settings


class Sample(NamedTuple):
    """What a process held, and had worked, at a time."""

    time: float  # since the epoch [s]
    megabytes: float
    processor_time: float  # [s]


def gpmpc(*words: str, samples: list[Sample] | None = None) -> tuple[str, float, float]:
    """Runs the command; returns what it printed, time [s] and most memory [MB].

    ``samples`` takes what it holds and has worked, every half second.
    """
    command = [sys.executable, "-c", "from gpmpc.cli import main; main()", *words]
    start = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        if samples is not None:
            watch = threading.Thread(target=_watch, args=(process.pid, samples))
            watch.start()
        output = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - start
    times = usage.ru_utime + usage.ru_stime
    print(f"gpmpc {words[0]}: {times:.1f} s of processors", flush=True)
    if process.returncode:
        raise SystemExit(f"gpmpc {' '.join(words)}: exit code {process.returncode}")
    return output, seconds, usage.ru_maxrss / 1024


def _watch(process: int, samples: list[Sample]) -> None:
    """Notes memory and processor time of a process until it ends."""
    page = os.sysconf("SC_PAGE_SIZE")
    tick = 1 / os.sysconf("SC_CLK_TCK")
    files = Path(f"/proc/{process}")
    while True:
        try:
            pages = int((files / "statm").read_text().split()[1])
            # Behind the name, in which spaces may be.
            fields = (files / "stat").read_text().rpartition(")")[2].split()
        except (OSError, IndexError):
            return
        if pages == 0:  # it has ended
            return
        ticks = int(fields[11]) + int(fields[12])  # of the user and the system
        samples.append(Sample(time.time(), 1e-6 * pages * page, ticks * tick))
        time.sleep(0.5)


def make(folder: Path, count: int) -> None:
    """Writes a finished sweep of ``count`` runs over masses and seeds."""
    gpmpc("run", *FLIGHT, f"folder={folder / 'pattern'}")
    (pattern,) = (folder / "pattern").glob("*/metrics.json")
    result = json.loads(pattern.read_text())
    config = pattern.with_name("config.yaml").read_text()
    numbers = random.Random(0)
    tree = folder / "sweep"
    plan = []
    for i in range(count):
        mass = 1 + i // SEEDS / 1000
        seed = i % SEEDS
        choices = sorted([*FLIGHT, f"seed={seed}", f"system.mass={mass}"])
        plan.append(choices)
        result["choices"] = choices
        result["seed"] = result["settings"]["seed"] = seed
        result["settings"]["system"]["mass"] = mass
        result["rmse"] = dict.fromkeys(result["rmse"], numbers.lognormvariate(-3, 0.5))
        path = tree / ",".join(choices)
        path.mkdir(parents=True)
        (path / "config.yaml").write_text(config)
        (path / ".lock").touch()
        (path / "metrics.json").write_text(json.dumps(result, indent=1) + "\n")
    (tree / "sweep-0000000000.json").write_text(json.dumps({"runs": plan}))


def fly(folder: Path, count: int) -> None:
    """Flies ``count`` short runs by joblib, and says what they cost beside flying."""
    words = ["run", "-m", *FLIGHT, f"seed=range({count})", f"folder={folder}"]
    words += ["launcher=joblib", "hydra.launcher.n_jobs=2"]
    print(f"load before it: {os.getloadavg()[0]:.1f}")
    samples: list[Sample] = []
    start = time.time()
    output, seconds, _ = gpmpc(*words, samples=samples)
    end = time.time()
    print(output.splitlines()[-1])
    begun = [path.stat().st_mtime for path in folder.glob("*/config.yaml")]
    ended = [path.stat().st_mtime for path in folder.glob("*/metrics.json")]
    plan = max(path.stat().st_mtime for path in folder.glob("sweep-*.json"))
    print(f"{seconds:.1f} s in all")
    print(f"{plan - start:.1f} s until the sweep was planned, and its settings tried")
    before = [each.processor_time for each in samples if each.time < min(begun)]
    print(
        f"{min(begun) - start:.1f} s until the first run began, "
        f"{before[-1]:.1f} s of the driver's processor"
    )
    print(f"{end - max(ended):.1f} s behind the last")
    flying = [each for each in samples if min(begun) <= each.time <= max(ended)]
    megabytes = [each.megabytes for each in flying]
    print(
        f"driver: {megabytes[0]:.0f} MB when the first run began, "
        f"{min(megabytes):.0f} to {max(megabytes):.0f} MB from then on"
    )
    print(f"{1e3 * (max(ended) - min(begun)) / count:.0f} ms a run, two processes")
    flights = [_flight(path) for path in folder.glob("*/metrics.json")]
    print(
        f"{1e3 * statistics.median(flights):.0f} ms of training and decisions in each"
    )
    print(f"load: {os.getloadavg()[0]:.1f}")
    _, seconds, _ = gpmpc(*words)
    print(f"{seconds:.1f} s to find all of it finished")


def _flight(path: Path) -> float:
    """Returns the time of the training and of all decisions of a run [s]."""
    result = json.loads(path.read_text())
    times = result["times"]
    return times["training"] + result["steps"] * times["total"]["median"]


def read(folder: Path) -> None:
    """Prints what status and report of a sweep take, with and without its index."""
    tree = folder / "sweep" if (folder / "sweep").is_dir() else folder
    (tree / "index.jsonl").unlink(missing_ok=True)
    for title, words in (
        ("status", ["status", str(tree)]),
        ("report, no index yet", ["report", str(tree)]),
        ("report", ["report", str(tree)]),
    ):
        _, seconds, memory = gpmpc(*words)
        load = os.getloadavg()[0]
        print(f"{title}: {seconds:.1f} s, {memory:.0f} MB; load {load:.1f}")


def main() -> None:
    """Runs one of the three."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("act", choices=["fly", "make", "read"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("count", type=int, nargs="?", default=2000)
    arguments = parser.parse_args()
    if arguments.act == "fly":
        fly(arguments.folder, arguments.count)
    elif arguments.act == "make":
        make(arguments.folder, arguments.count)
    else:
        read(arguments.folder)


if __name__ == "__main__":
    main()
