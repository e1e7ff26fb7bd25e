"""Sweeps on this machine and on real clusters of two nodes, and what must hold there.

    make cluster                                        # all of it
    .venv/bin/python -m benchmarks.cluster --on slurm --only memory

Flies sweeps by joblib, then starts Slurm without accounting, Slurm with it, and Ray,
and flies them on each, while it kills, cancels and hides; prints a table. After every
act each run is accounted for, has the numbers of the basic launcher, the exit code is
true, and no process is left. It takes more than an hour on two cores, and has patience
where they are busy.

Slurm needs root and the packages slurmctld, slurmd, slurm-client and munge of Debian or
Ubuntu, with accounting also slurmdbd and mariadb-server; Ray needs gpmpc[ray]. What is
missing is said, and nothing is installed. Everything is bound to loopback, and stopped
at the end; what an earlier call left that was killed is ended first. Exit code 1 where
an act fails, something is left, or nothing could be played.
"""

import argparse
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from benchmarks.cluster import ray_nodes, slurm
from benchmarks.cluster.acts import (
    MANY,
    Act,
    JoblibActs,
    RayActs,
    SlurmActs,
    Stage,
    run,
)
from benchmarks.cluster.processes import command_of, kill, processes_with, running
from benchmarks.cluster.sweeps import Sweep

_CLUSTERS = ("joblib", "slurm", "slurm-accounting", "ray")
_PREFIX = "gpmpc-acts-"  # of the folder of a call
_STAGE = "GPMPC_STAGE"  # variable: that folder, in whatever the call started
_ENDING = 60.0  # within which the processes of clusters that were stopped are gone [s]


def main() -> int:
    """Plays the acts; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--on", choices=_CLUSTERS, action="append", help="(all)")
    parser.add_argument("--only", default="", help="acts whose name holds this pattern")
    parser.add_argument("--runs", type=int, default=MANY, help="of the reference")
    arguments = parser.parse_args()
    for number in (signal.SIGTERM, signal.SIGINT):  # what was started is stopped
        signal.signal(number, lambda *_: sys.exit("stopped"))
    rows = []
    _end_killed_calls()
    with _stage_folder() as folder:
        stage = Stage(folder, _reference(folder, arguments.runs))
        for cluster in arguments.on or _CLUSTERS:
            rows += _play(cluster, stage, arguments.only)
        left = _left_running(folder)
    print()
    for where, act, outcome, seconds in rows:
        print(f"{where:17} {act:40} {seconds:5.0f} s  {outcome}")
    print(f"left running: {'; '.join(left) or 'nothing'}")
    all_passed = all(outcome == "pass" for *_, outcome, _ in rows)
    return 0 if rows and all_passed and not left else 1


@contextmanager
def _stage_folder() -> Iterator[Path]:
    """Makes the folder of a call; in the end it, and what the call started, are gone.

    A lock in it says that the call lives.
    """
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
    folder.chmod(0o755)
    os.environ[_STAGE] = str(folder)
    with FileLock(folder / ".lock"):
        try:
            yield folder
        finally:
            _remove(folder)


def _end_killed_calls() -> None:
    """Ends what calls left that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        try:
            with FileLock(folder / ".lock", blocking=False):
                print(f"ending what is left of {folder}", flush=True)
                _remove(folder)
        except Timeout:
            print(f"{folder}: another call, which is playing", flush=True)


def _remove(folder: Path) -> None:
    """Kills what was started for a call, and removes its folder."""
    kill(_processes_of(folder))
    shutil.rmtree(folder, ignore_errors=True)


def _processes_of(folder: Path) -> list[int]:
    """Returns the processes that a call started, without the call itself."""
    return [
        process
        for process in processes_with(f"{_STAGE}={folder}")
        if process != os.getpid()
    ]


def _left_running(folder: Path) -> list[str]:
    """Returns the commands of processes that outlive the clusters of a call."""
    deadline = time.monotonic() + _ENDING
    while processes := _processes_of(folder):
        if time.monotonic() > deadline:
            return [f"{process}: {command_of(process)}" for process in processes]
        time.sleep(1.0)
    return []


def _reference(folder: Path, runs: int) -> dict[int, dict]:
    """Returns the numbers of the basic launcher, by seed."""
    sweep = Sweep(
        folder=folder / "basic",
        runs=runs,
        kinds=["Slow"],
        launcher=["launcher=basic"],
        environment=os.environ,
    )
    code, printed = sweep.fly()
    if code:
        sys.exit(printed)
    return sweep.numbers()


def _play(cluster: str, stage: Stage, only: str) -> list[tuple[str, str, str, float]]:
    """Starts a cluster, plays its acts and stops it."""
    if cluster == "joblib":
        return run(_chosen(JoblibActs(stage).by_name(), only), cluster)
    accounting = cluster == "slurm-accounting"
    missing = ray_nodes.missing() if cluster == "ray" else slurm.missing(accounting)
    if missing:
        print(f"{cluster}: not here: {', '.join(missing)}", flush=True)
        return []
    if cluster == "ray":
        return run(_chosen(RayActs(stage).by_name(), only), cluster)
    with running(slurm.Slurm(stage.folder / cluster, accounting)) as nodes:
        return run(_chosen(SlurmActs(stage, nodes).by_name(), only), cluster)


def _chosen(acts: Mapping[str, Act], only: str) -> dict[str, Act]:
    """Returns the acts whose names hold a pattern."""
    return {name: act for name, act in acts.items() if re.search(only, name)}


if __name__ == "__main__":
    sys.exit(main())
