"""Real clusters of two nodes on this machine, and what must hold on them.

    make cluster                                        # all of it, for half an hour
    .venv/bin/python -m benchmarks.cluster --on slurm --only memory

Starts Slurm without accounting, Slurm with it, and Ray, flies sweeps on each while it
kills, cancels and hides, and prints a table. After every act each run is accounted for,
has the numbers of the basic launcher, the exit code is true, and no process is left.

Slurm needs root and the packages slurmctld, slurmd, slurm-client and munge of Debian or
Ubuntu, with accounting also slurmdbd and mariadb-server; Ray needs gpmpc[ray]. What is
missing is said, and nothing is installed. Everything is bound to loopback, and stopped
at the end. Exit code 1 where an act fails, or nothing could be played.
"""

import argparse
import os
import re
import signal
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from benchmarks.cluster import ray_nodes, slurm
from benchmarks.cluster.acts import MANY, Act, RayActs, SlurmActs, Stage, run
from benchmarks.cluster.processes import kill, processes_with, running
from benchmarks.cluster.sweeps import STAGE, Sweep

_CLUSTERS = ("slurm", "slurm-accounting", "ray")


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
    with tempfile.TemporaryDirectory(prefix="gpmpc-cluster-") as name:
        folder = Path(name)
        folder.chmod(0o755)
        try:
            stage = Stage(folder, _reference(folder, arguments.runs))
            for cluster in arguments.on or _CLUSTERS:
                rows += _play(cluster, stage, arguments.only)
        finally:
            kill(processes_with(f"{STAGE}={folder}"))
    print()
    for where, act, outcome, seconds in rows:
        print(f"{where:17} {act:40} {seconds:5.0f} s  {outcome}")
    return 0 if rows and all(outcome == "pass" for *_, outcome, _ in rows) else 1


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
