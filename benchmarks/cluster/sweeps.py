"""Sweeps for acts, and what must hold after each of them."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.cluster.processes import processes_with, wait_for
from gpmpc.studies._run_folder import RunFolder, RunState

ROOT = Path(__file__).resolve().parents[2]
_MARK = "GPMPC_ACT"  # variable: the act that it belongs to
_PATIENCE = 1200.0  # for a sweep: it ends long before, unless it hangs [s]
_END = 120.0  # within which the processes of a sweep that has ended are gone [s]
_WORDS = [
    "system=double_integrator", "steps=2", "data.samples=25", "model.restarts=0",
    "horizon=3", "recorder=none",
]  # fmt: skip
_MAIN = "from gpmpc.cli import main; main()"


def disturbed(*kinds: str) -> str:
    """Returns the override that takes the disturbances of ``slow``, each in turn."""
    lists = [f"[{{_target_: benchmarks.cluster.slow.{kind}}}]" for kind in kinds]
    return f"disturbances={','.join(lists)}"


def hold_of(folder: Path) -> Path:
    """Returns the file that holds the runs of a sweep's folder while it is there."""
    return folder.with_name(f"{folder.name}.hold")


@dataclass
class Sweep:
    """One sweep that an act flies, in a folder of its own.

    Args:
        folder: Where its runs go.
        runs: Seeds.
        kinds: Of disturbances.
        launcher: Settings of the launcher.
        environment: In which the launcher finds its cluster.
    """

    folder: Path
    runs: int
    kinds: Sequence[str]
    launcher: Sequence[str]
    environment: Mapping[str, str]

    @contextmanager
    def holding_runs(self) -> Iterator[None]:
        """Keeps every step of a run from ending inside; then lets them all go.

        So runs do not wait for ever, and keep nodes busy, where an act fails meanwhile.
        """
        hold = hold_of(self.folder)
        hold.touch()
        try:
            yield
        finally:
            hold.unlink()

    def start(self, *words: str) -> subprocess.Popen:
        """Starts the command, as a user does."""
        command = [
            sys.executable, "-c", _MAIN, "run", "-m", *_WORDS, disturbed(*self.kinds),
            f"seed=range({self.runs})", f"folder={self.folder}", *self.launcher, *words,
        ]  # fmt: skip
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        marks = {
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

    def start_planned(self) -> subprocess.Popen:
        """Starts the command, and waits until it is about to launch runs."""
        began = time.time()
        process = self.start()

        def is_planned() -> bool:
            plans = self.folder.glob("sweep-*.json")
            return any(plan.stat().st_mtime > began for plan in plans)

        self._wait_for(f"another plan of {self.folder.name}", is_planned, process)
        return process

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

    def wait_for(self, count: int, state: RunState, process: subprocess.Popen) -> None:
        """Waits until so many runs of a command are so far."""
        self._wait_for(
            f"{count} {state.value} of {self.folder.name}",
            lambda: self.states().count(state) >= count,
            process,
        )

    def _wait_for(
        self, what: str, ready: Callable[[], bool], process: subprocess.Popen
    ) -> None:
        """Waits while a command goes on.

        Raises:
            AssertionError: It ends before.
        """

        def ready_or_ended() -> bool:
            return ready() or process.poll() is not None

        wait_for(what, ready_or_ended, _PATIENCE)
        assert process.poll() is None, f"{what}: {end_of(process)}"

    def workers(self) -> list[int]:
        """Returns the processes of this machine that fly runs."""
        return [
            int(folder.last_worker.split()[1])
            for folder in self.folders()
            if folder.state is RunState.RUNNING
        ]

    def wait_until_alone(self) -> None:
        """Waits until no process of the sweep is left."""
        wait_for(
            f"no process of {self.folder.name}",
            lambda: not processes_with(f"{_MARK}={self.folder}"),
            _END,
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
        self.wait_until_alone()


def end_of(process: subprocess.Popen) -> tuple[int, str]:
    """Waits for a command; returns its exit code and what it printed."""
    printed, _ = process.communicate(timeout=_PATIENCE)
    return process.returncode, printed


def kill_command(process: subprocess.Popen) -> None:
    """Kills a command alone; what it started here is to end by itself.

    Raises:
        TimeoutExpired: It does not, and holds the command's output open.
    """
    process.kill()
    process.communicate(timeout=_END)
