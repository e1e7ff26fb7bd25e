"""What clusters do to sweeps, one act after another; each raises where it fails."""

import os
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.cluster.processes import kill, running
from benchmarks.cluster.ray_nodes import RayNodes
from benchmarks.cluster.slow import HOLD
from benchmarks.cluster.slurm import Slurm
from benchmarks.cluster.sweeps import Sweep, end_of, hold_of, kill_command
from gpmpc.studies._run_folder import RunState

Act = Callable[[], None]
MANY = 200
_FEW = 6
_SHARED = ["chunk=25"]  # of the many: two rounds on two nodes of two processors
_SLURM = ["launcher=slurm", "hydra.launcher.mem_gb=2"]
_KILLS = 10  # of a driver on one machine, each at another moment
_KILL_INTERVAL = 0.7  # between two of these moments [s]
_WALL_TIME = 3  # which only a run that hangs reaches, on a busy machine, too [min]


@dataclass(frozen=True)
class Stage:
    """Where acts take place."""

    folder: Path
    #: numbers of the basic launcher by seed
    reference: Mapping[int, Any]


class _Job(NamedTuple):
    """A job as squeue tells it."""

    number: str  # of its array and in it, such as 7_0
    state: str
    host: str


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
            "a running job started anew": self._requeued,
            "a node killed": self._node,
            "the driver killed and called again": self._driver,
            "three drivers on one sweep": self._three_drivers,
            "a node without the folder": self._blind,
        }

    def _many(self) -> None:
        act = self._sweep("many", MANY, words=_SHARED)
        code, printed = act.fly()
        assert code == 0, printed
        hosts = {job.host for job in self._jobs(act)}
        assert hosts == {"n1", "n2"}, hosts
        act.check(code, self._stage.reference)

    def _two_cancelled(self) -> None:
        def cancel() -> None:
            for state in ("RUNNING", "PENDING"):
                self._slurm.ask("scancel", self._number(act, state))

        act = self._sweep("cancelled")
        self._cancelled(act, cancel, failed=2)

    def _all_cancelled(self) -> None:
        def cancel() -> None:
            array = self._number(act, "RUNNING").partition("_")[0]
            self._slurm.ask("scancel", array)

        act = self._sweep("array")
        self._cancelled(act, cancel, failed=_FEW)

    def _cancelled(self, act: Sweep, cancel: Act, failed: int) -> None:
        code, _ = _fly_through(act, 4, cancel)
        act.check(code, self._stage.reference)
        kinds = [error["kind"] for error in act.errors()]
        assert kinds == failed * ["cancelled"], kinds
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
        words = ["chunk=1", f"hydra.launcher.timeout_min={_WALL_TIME}"]
        act = self._sweep("time", 1, kinds=["Slow", "Stuck"], words=words)
        code, printed = act.fly()
        act.check(code, self._stage.reference)
        assert [error["kind"] for error in act.errors()] == ["time"]
        assert "hydra.launcher.timeout_min" in printed

    def _requeued(self) -> None:
        def requeue() -> None:
            self._slurm.ask("scontrol", "requeue", self._number(act, "RUNNING"))

        act = self._sweep("requeued")
        code, printed = _fly_through(act, 4, requeue)
        assert code == 0, printed
        act.check(code, self._stage.reference)

    def _node(self) -> None:
        act = self._sweep("node")
        code, printed = _fly_through(act, 4, lambda: self._slurm.kill_node("n1"))
        assert code == 0, printed
        act.check(code, self._stage.reference)
        self._slurm.start_node("n1")
        self._slurm.wait_until_idle()

    def _driver(self) -> None:
        act = self._sweep("driver")
        code, printed = _kill_and_repeat(act, 4)
        assert code == 0, printed
        assert len(self._jobs(act)) == _FEW  # of one array
        act.check(code, self._stage.reference)

    def _three_drivers(self) -> None:
        act = self._sweep("three")
        _start_thrice(act, 4)
        assert len(self._jobs(act)) == _FEW
        act.check(0, self._stage.reference)

    def _blind(self) -> None:
        act = self._sweep("blind")
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
        self._slurm.wait_until_down("n2")
        self._slurm.start_node("n2", blind_to)
        self._slurm.wait_until_idle()

    def _sweep(
        self,
        name: str,
        runs: int = _FEW,
        kinds: Sequence[str] = ("Slow",),
        words: Sequence[str] = ("chunk=1",),
    ) -> Sweep:
        folder = self._stage.folder / f"{self._slurm.folder.name}-{name}"
        setup = f"hydra.launcher.setup=['export {HOLD}=\"{hold_of(folder)}\"']"
        return Sweep(
            folder=folder,
            runs=runs,
            kinds=kinds,
            launcher=[*_SLURM, setup, *words],
            environment=self._slurm.environment,
        )

    def _jobs(self, act: Sweep) -> list[_Job]:
        """Returns the jobs of the only array of a sweep."""
        (folder,) = (act.folder / ".slurm").glob("gpmpc-*")
        answer = self._slurm.ask(
            "squeue", "--noheader", "--array", f"--name={folder.name}",
            "--states=all", "--format=%F_%K|%T|%N",
        )  # fmt: skip
        return [_Job(*line.split("|")) for line in answer.splitlines()]

    def _number(self, act: Sweep, state: str) -> str:
        """Returns the number of a job in a state."""
        return next(job.number for job in self._jobs(act) if job.state == state)


class JoblibActs:
    """What happens to sweeps in processes of one machine.

    Args:
        stage: Where the acts take place.
    """

    def __init__(self, stage: Stage):
        self._stage = stage

    def by_name(self) -> dict[str, Act]:
        """Returns the acts, by what they show."""
        return {
            f"{MANY} runs in two processes": self._many,
            "a process killed": self._process,
            f"the driver killed, {_KILLS} times": self._driver,
        }

    def _many(self) -> None:
        act = self._sweep("many", MANY, words=())
        code, printed = act.fly()
        assert code == 0, printed
        act.check(code, self._stage.reference)

    def _process(self) -> None:
        act = self._sweep("process")
        # The command looks at the disturbances itself, before it launches runs.
        process = act.start_planned()
        with act.holding_runs():
            act.wait_for(2, RunState.RUNNING, process)
            kill(act.workers()[:1])
        code, printed = end_of(process)
        assert code == 0, printed
        assert "1 of the runs were flown again" in printed, printed
        act.check(code, self._stage.reference)

    def _driver(self) -> None:
        act = self._sweep("driver")
        for index in range(_KILLS):
            process = act.start_planned()
            with act.holding_runs():
                # While processes start, import, begin runs and fly.
                time.sleep(index * _KILL_INTERVAL)
                if index == _KILLS - 1:
                    act.wait_for(2, RunState.RUNNING, process)
                kill_command(process)
                act.wait_until_alone()
        code, printed = act.fly()
        assert code == 0, printed
        act.check(code, self._stage.reference)

    def _sweep(
        self, name: str, runs: int = _FEW, words: Sequence[str] = ("chunk=1",)
    ) -> Sweep:
        folder = self._stage.folder / f"joblib-{name}"
        return Sweep(
            folder=folder,
            runs=runs,
            kinds=["Slow"],
            launcher=["launcher=joblib", "hydra.launcher.n_jobs=2", *words],
            environment={**os.environ, HOLD: str(hold_of(folder))},
        )


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
            "three drivers on one sweep": self._three_drivers,
            "a node without the folder": self._blind,
        }

    def _many(self) -> None:
        with running(self._nodes("many")) as nodes:
            act = self._sweep("many", nodes, MANY, words=_SHARED)
            self._check_finished(act, *act.fly())

    def _raylet(self) -> None:
        with running(self._nodes("raylet")) as nodes:
            act = self._sweep("raylet", nodes)
            end = _fly_through(act, 3, lambda: nodes.kill_node("second"))
            self._check_finished(act, *end)

    def _driver(self) -> None:
        with running(self._nodes("driver")) as nodes:
            act = self._sweep("driver", nodes)
            self._check_finished(act, *_kill_and_repeat(act, 3))

    def _three_drivers(self) -> None:
        with running(self._nodes("three")) as nodes:
            act = self._sweep("three", nodes)
            _start_thrice(act, 3)
            act.check(0, self._stage.reference)

    def _blind(self) -> None:
        folder = self._folder("blind")
        folder.mkdir()
        with running(self._nodes("blind", blind_to=folder)) as nodes:
            act = self._sweep("blind", nodes, 2 * _FEW)
            code, printed = act.fly()
            act.check(code, self._stage.reference)
            errors = act.errors()
            assert errors, printed
            assert all("127.0.0.2" in error["host"] for error in errors), errors

    def _folder(self, name: str) -> Path:
        """Returns where the runs of an act go."""
        return self._stage.folder / f"ray-{name}"

    def _nodes(self, name: str, blind_to: Path | None = None) -> RayNodes:
        """Returns the cluster of an act."""
        variables = {HOLD: str(hold_of(self._folder(name)))}
        return RayNodes(self._stage.folder / f"r-{name}", blind_to, variables)

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
            folder=self._folder(name),
            runs=runs,
            kinds=["Slow"],
            launcher=["launcher=ray", address, *words],
            environment=nodes.environment,
        )


def _fly_through(act: Sweep, count: int, disturb: Act) -> tuple[int, str]:
    """Flies a sweep, and disturbs it while ``count`` of its runs fly."""
    with act.holding_runs():
        process = act.start()
        act.wait_for(count, RunState.RUNNING, process)
        disturb()
    return end_of(process)


def _kill_and_repeat(act: Sweep, count: int) -> tuple[int, str]:
    """Kills a sweep while ``count`` of its runs fly, and flies it again.

    The runs are held until the second command has seen them.
    """
    with act.holding_runs():
        process = act.start()
        act.wait_for(count, RunState.RUNNING, process)
        kill_command(process)
        successor = act.start_planned()
    return end_of(successor)


def _start_thrice(act: Sweep, count: int) -> None:
    """Flies a sweep by two commands at once, and a third one; all are to end well.

    The runs are held until the third command has seen them.
    """
    with act.holding_runs():
        processes = [act.start(), act.start()]
        act.wait_for(count, RunState.RUNNING, processes[0])
        processes.append(act.start_planned())
    ends = [end_of(process) for process in processes]
    assert [code for code, _ in ends] == [0, 0, 0], ends


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
