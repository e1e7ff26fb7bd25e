"""What clusters do to sweeps, one act after another; each raises where it fails."""

import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.cluster.processes import running
from benchmarks.cluster.ray_nodes import RayNodes
from benchmarks.cluster.slow import SLOW
from benchmarks.cluster.slurm import Slurm
from benchmarks.cluster.sweeps import Sweep, end_of
from gpmpc.studies._run_folder import RunState

Act = Callable[[], None]
MANY = 200
_FEW = 6
_SLOW = 8.0  # seconds that a step takes where something is to happen meanwhile
_SLURM = ["launcher=slurm", "hydra.launcher.mem_gb=2"]


@dataclass(frozen=True)
class Stage:
    """Where acts take place."""

    folder: Path
    #: numbers of the basic launcher by seed
    reference: Mapping[int, Any]


class SlurmActs:
    """What Slurm does to sweeps.

    Args:
        stage: Where the acts take place.
        slurm: The cluster, which is running.
    """

    def __init__(self, stage: Stage, slurm: Slurm):
        self._stage = stage
        self._slurm = slurm

    def by_name(self) -> dict[str, Act]:
        """Returns the acts, by what they show."""
        return {
            f"{MANY} runs over two nodes": self._many,
            "scancel of a running and a pending job": self._two_cancelled,
            "scancel of a whole array": self._all_cancelled,
            "a job over its memory": self._memory,
            "a job over its wall time": self._wall_time,
            "a node killed": self._node,
            "the driver killed and called again": self._driver,
            "two drivers on one sweep": self._two_drivers,
            "a node without the folder": self._blind,
        }

    def _many(self) -> None:
        act = self._sweep("many", MANY, words=["chunk=10"])
        code, _ = act.fly()
        hosts = {row.split("|")[2] for row in self._jobs(act).values()}
        assert hosts == {"n1", "n2"}, hosts
        act.check(code, self._stage.reference)

    def _two_cancelled(self) -> None:
        def cancel() -> None:
            for state in ("RUNNING", "PENDING"):
                self._slurm.ask("scancel", self._number(act, state))

        act = self._sweep("cancelled", slow=_SLOW)
        self._cancelled(act, cancel, failed=2)

    def _all_cancelled(self) -> None:
        def cancel() -> None:
            array = self._number(act, "RUNNING").partition("_")[0]
            self._slurm.ask("scancel", array)

        act = self._sweep("array", slow=_SLOW)
        self._cancelled(act, cancel, failed=_FEW)

    def _cancelled(self, act: Sweep, cancel: Act, failed: int) -> None:
        code, _ = _fly_through(act, 4, cancel)
        act.check(code, self._stage.reference)
        kinds = [error["kind"] for error in act.errors()]
        assert kinds == failed * ["cancelled"], kinds
        act.slow = 0.0
        code, printed = act.fly()
        assert code == 0, printed
        assert f"{failed} of the runs were flown again" in printed
        act.check(code, self._stage.reference)

    def _memory(self) -> None:
        act = self._sweep("memory", 2, kinds=["Slow", "Hungry"])
        code, printed = act.fly()
        act.check(code, self._stage.reference)
        errors = act.errors()
        assert [error["kind"] for error in errors] == 2 * ["memory"], errors
        assert "hydra.launcher.mem_gb" in printed
        code, printed = act.fly("retries=0")
        assert "2 of the runs were ended by a cluster or a crash" in printed, printed
        act.check(code, self._stage.reference)

    def _wall_time(self) -> None:
        words = ["chunk=1", "hydra.launcher.timeout_min=1"]
        act = self._sweep("time", 1, kinds=["Slow", "Stuck"], words=words)
        code, printed = act.fly()
        act.check(code, self._stage.reference)
        assert [error["kind"] for error in act.errors()] == ["time"]
        assert "hydra.launcher.timeout_min" in printed

    def _node(self) -> None:
        act = self._sweep("node", slow=_SLOW)
        code, printed = _fly_through(act, 4, lambda: self._slurm.kill_node("n1"))
        assert code == 0, printed
        act.check(code, self._stage.reference)
        self._slurm.start_node("n1")
        self._slurm.wait_until_idle()

    def _driver(self) -> None:
        act = self._sweep("driver", slow=_SLOW)
        code, printed = _kill_and_repeat(act, 4)
        assert code == 0, printed
        assert len(self._jobs(act)) == _FEW  # of one array
        act.check(code, self._stage.reference)

    def _two_drivers(self) -> None:
        act = self._sweep("two", slow=2.0)
        _start_twice(act)
        assert len(self._jobs(act)) == _FEW
        act.check(0, self._stage.reference)

    def _blind(self) -> None:
        act = self._sweep("blind", slow=2.0)
        act.folder.mkdir()
        self._restart_second_node(blind_to=act.folder)
        code, printed = act.fly()
        act.check(code, self._stage.reference)
        errors = act.errors()
        assert errors, printed
        assert all(error["host"] == "n2" for error in errors), errors
        self._restart_second_node()

    def _restart_second_node(self, blind_to: Path | None = None) -> None:
        self._slurm.kill_node("n2")
        self._slurm.start_node("n2", blind_to)
        time.sleep(15.0)  # until the controller has noticed
        self._slurm.wait_until_idle()

    def _sweep(
        self,
        name: str,
        runs: int = _FEW,
        kinds: Sequence[str] = ("Slow",),
        words: Sequence[str] = ("chunk=1",),
        slow: float = 0.0,
    ) -> Sweep:
        return Sweep(
            folder=self._stage.folder / f"{self._slurm.folder.name}-{name}",
            runs=runs,
            kinds=kinds,
            launcher=[*_SLURM, *words],
            environment=self._slurm.environment,
            slow=slow,
        )

    def _jobs(self, act: Sweep) -> dict[int, str]:
        """Returns the state of the only array of a sweep, by number of the job."""
        (folder,) = (act.folder / ".slurm").glob("gpmpc-*")
        listed = self._slurm.ask(
            "squeue", "--noheader", "--array", f"--name={folder.name}",
            "--states=all", "--format=%K|%F_%K|%T|%N",
        )  # fmt: skip
        rows = [line.split("|") for line in listed.splitlines()]
        return {int(index): "|".join(row) for index, *row in rows}

    def _number(self, act: Sweep, state: str) -> str:
        """Returns the number of a job in a state."""
        rows = [row.split("|") for row in self._jobs(act).values()]
        return next(row[0] for row in rows if row[1] == state)


class RayActs:
    """What Ray does to sweeps, each on a cluster of its own.

    Args:
        stage: Where the acts take place.
    """

    def __init__(self, stage: Stage):
        self._stage = stage

    def by_name(self) -> dict[str, Act]:
        """Returns the acts, by what they show."""
        return {
            f"{MANY} runs over two nodes": self._many,
            "a raylet killed": self._raylet,
            "the driver killed and called again": self._driver,
            "two drivers on one sweep": self._two_drivers,
            "a node without the folder": self._blind,
        }

    def _many(self) -> None:
        with running(_ray_nodes("many")) as nodes:
            act = self._sweep("many", nodes, MANY, words=["chunk=10"])
            self._check_finished(act, *act.fly())

    def _raylet(self) -> None:
        with running(_ray_nodes("raylet", slow=_SLOW)) as nodes:
            act = self._sweep("raylet", nodes)
            end = _fly_through(act, 3, lambda: nodes.kill_node("second"))
            self._check_finished(act, *end)

    def _driver(self) -> None:
        with running(_ray_nodes("driver", slow=_SLOW)) as nodes:
            act = self._sweep("driver", nodes)
            self._check_finished(act, *_kill_and_repeat(act, 3))

    def _two_drivers(self) -> None:
        with running(_ray_nodes("two")) as nodes:
            act = self._sweep("two", nodes)
            _start_twice(act)
            act.check(0, self._stage.reference)

    def _blind(self) -> None:
        folder = self._stage.folder / "ray-blind"
        folder.mkdir()
        with running(_ray_nodes("blind", blind_to=folder)) as nodes:
            act = self._sweep("blind", nodes, 2 * _FEW)
            code, printed = act.fly()
            act.check(code, self._stage.reference)
            errors = act.errors()
            assert errors, printed
            assert all("127.0.0.2" in error["host"] for error in errors), errors

    def _check_finished(self, act: Sweep, code: int, printed: str) -> None:
        assert code == 0, printed
        act.check(code, self._stage.reference)

    def _sweep(
        self,
        name: str,
        nodes: RayNodes,
        runs: int = _FEW,
        words: Sequence[str] = ("chunk=1",),
    ) -> Sweep:
        address = f"hydra.launcher.ray.init.address={nodes.address}"
        return Sweep(
            folder=self._stage.folder / f"ray-{name}",
            runs=runs,
            kinds=["Slow"],
            launcher=["launcher=ray", address, *words],
            environment=nodes.environment,
        )


def _ray_nodes(name: str, slow: float = 0.0, blind_to: Path | None = None) -> RayNodes:
    """Returns a cluster on which a step takes ``slow`` seconds."""
    folder = Path(tempfile.gettempdir()) / f"gpmpc-ray-{name}"
    return RayNodes(folder, blind_to, {SLOW: str(slow)})


def _fly_through(act: Sweep, count: int, disturb: Act) -> tuple[int, str]:
    """Flies a sweep, and disturbs it while ``count`` of its runs fly."""
    process = act.start()
    act.wait_for(count, RunState.RUNNING)
    disturb()
    return end_of(process)


def _kill_and_repeat(act: Sweep, count: int) -> tuple[int, str]:
    """Kills a sweep while ``count`` of its runs fly, and flies it again."""
    process = act.start()
    act.wait_for(count, RunState.RUNNING)
    process.kill()
    process.communicate()
    return act.fly()


def _start_twice(act: Sweep) -> None:
    """Flies a sweep by two commands at once; both are to end well."""
    ends = [end_of(process) for process in [act.start(), act.start()]]
    assert [code for code, _ in ends] == [0, 0], ends


def run(acts: Mapping[str, Act], where: str) -> list[tuple[str, str, str, float]]:
    """Plays acts; returns where, what, how it ended, and its seconds."""
    rows = []
    for name, act in acts.items():
        began = time.monotonic()
        try:
            act()
            outcome = "pass"
        except (
            AssertionError,
            OSError,
            ValueError,
            LookupError,
            StopIteration,
            subprocess.SubprocessError,
        ) as error:
            text = " ".join(str(error).split())
            outcome = f"FAIL: {type(error).__name__}: {text[:600]}"
        seconds = time.monotonic() - began
        rows.append((where, name, outcome, seconds))
        print(f"{where}: {name}: {outcome} ({seconds:.0f} s)", flush=True)
    return rows
