"""Sweeps for acts, and what must hold after each of them."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.cluster.processes import processes_with, wait_for
from benchmarks.cluster.slow import SLOW
from gpmpc.studies._run_folder import RunFolder, RunState

ROOT = Path(__file__).resolve().parents[2]
STAGE = "GPMPC_STAGE"  # variable: the folder of all acts that a process belongs to
_MARK = "GPMPC_ACT"  # variable: the act that it belongs to
_PATIENCE = 600.0  # for a sweep [s]
_WORDS = [
    "system=double_integrator", "steps=2", "data.samples=25", "model.restarts=0",
    "horizon=3", "recorder=none",
]  # fmt: skip
_MAIN = "from gpmpc.cli import main; main()"


def disturbed(*kinds: str) -> str:
    """Returns the override that takes the disturbances of ``slow``, each in turn."""
    lists = [f"[{{_target_: benchmarks.cluster.slow.{kind}}}]" for kind in kinds]
    return f"disturbances={','.join(lists)}"


@dataclass
class Sweep:
    """One sweep that an act flies, in a folder of its own.

    Args:
        folder: Where its runs go.
        runs: Seeds.
        kinds: Of disturbances.
        launcher: Settings of the launcher.
        environment: In which the launcher finds its cluster.
        slow: Seconds that a step takes.
    """

    folder: Path
    runs: int
    kinds: Sequence[str]
    launcher: Sequence[str]
    environment: Mapping[str, str]
    slow: float = 0.0

    def start(self, *words: str) -> subprocess.Popen:
        """Starts the command, as a user does."""
        command = [
            sys.executable, "-c", _MAIN, "run", "-m", *_WORDS, disturbed(*self.kinds),
            f"seed=range({self.runs})", f"folder={self.folder}", *self.launcher, *words,
        ]  # fmt: skip
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        marks = {
            SLOW: str(self.slow),
            STAGE: str(self.folder.parent),
            _MARK: str(self.folder),
            "PYTHONPATH": path,
        }
        return subprocess.Popen(
            command,
            cwd=ROOT,
            env={**self.environment, **marks},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def fly(self, *words: str) -> tuple[int, str]:
        """Runs the command to its end; returns its exit code and what it prints."""
        return end_of(self.start(*words))

    def folders(self) -> list[RunFolder]:
        """Returns the folders that are there."""
        if not self.folder.is_dir():
            return []
        return [
            RunFolder(path)
            for path in sorted(self.folder.iterdir())
            if path.is_dir() and path.name.startswith("data.samples")
        ]

    def states(self) -> list[RunState]:
        """Returns how far the runs are."""
        return [folder.state for folder in self.folders()]

    def wait_for(self, count: int, state: RunState) -> None:
        """Waits until so many runs are so far."""
        wait_for(
            f"{count} {state.value} of {self.folder.name}",
            lambda: self.states().count(state) >= count,
            _PATIENCE,
        )

    def errors(self) -> list[dict[str, Any]]:
        """Returns why runs failed."""
        return [
            json.loads((folder.path / "error.json").read_text())
            for folder in self.folders()
            if folder.state is RunState.FAILED
        ]

    def numbers(self) -> dict[int, dict[str, Any]]:
        """Returns all that flights without memory or patience measured, by seed."""
        numbers = {}
        for folder in self.folders():
            if folder.state is not RunState.FINISHED:
                continue
            content = folder.result()
            for aside in ("times", "provenance", "choices", "settings"):
                del content[aside]
            numbers[content["seed"]] = content
        return numbers

    def check(self, code: int, reference: Mapping[int, Any]) -> None:
        """Raises where a run is unaccounted for, a number another, or a process left.

        Args:
            code: With which the last command ended.
            reference: Numbers of the basic launcher, by seed, of all seeds or some.
        """
        states = self.states()
        total = self.runs * len(self.kinds)
        finished = states.count(RunState.FINISHED)
        failed = states.count(RunState.FAILED)
        assert len(states) == finished + failed == total, states
        assert code == (0 if failed == 0 else 1), f"exit code {code}, {failed} failed"
        for seed, numbers in self.numbers().items():
            if seed in reference:
                assert numbers == reference[seed], f"seed {seed} has other numbers"
        wait_for(
            f"no process of {self.folder.name}",
            lambda: not processes_with(f"{_MARK}={self.folder}"),
            60.0,
        )

    def remove(self) -> None:
        """Removes its folder."""
        shutil.rmtree(self.folder)


def end_of(process: subprocess.Popen) -> tuple[int, str]:
    """Waits for a command; returns its exit code and what it printed."""
    printed, _ = process.communicate(timeout=_PATIENCE)
    return process.returncode, printed
