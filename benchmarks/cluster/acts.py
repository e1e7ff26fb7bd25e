"""What clusters do to sweeps, one act after another; each raises where it fails."""

import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


def slurm_acts(stage: Stage, slurm: Slurm) -> dict[str, Act]:
    """Returns the acts on Slurm, by what they show."""

    def sweep(name: str, runs: int = _FEW, **more: Any) -> Sweep:
        return Sweep(
            folder=stage.folder / f"{slurm.folder.name}-{name}",
            runs=runs,
            kinds=more.pop("kinds", ["Slow"]),
            launcher=[*_SLURM, *more.pop("words", ["chunk=1"])],
            environment=slurm.environment,
            **more,
        )

    def jobs(name: str) -> dict[int, str]:
        """Returns the state of the newest array of a sweep, by number of the job."""
        (folder,) = [*(stage.folder / name / ".slurm").glob("gpmpc-*")]
        listed = slurm.ask(
            "squeue", "--noheader", "--array", f"--name={folder.name}",
            "--states=all", "--format=%K|%F_%K|%T|%N",
        )  # fmt: skip
        rows = [line.split("|") for line in listed.splitlines()]
        return {int(index): "|".join(row) for index, *row in rows}

    def number(name: str, state: str) -> str:
        """Returns the number of a job in a state."""
        rows = [row.split("|") for row in jobs(name).values()]
        return next(row[0] for row in rows if row[1] == state)

    def many() -> None:
        act = sweep("many", MANY, words=["chunk=10"])
        code, _ = act.fly()
        hosts = {row.split("|")[2] for row in jobs(act.folder.name).values()}
        assert hosts == {"n1", "n2"}, hosts
        act.check(code, stage.reference)

    def cancelled(name: str, cancel: Callable[[str], None], failed: int) -> None:
        act = sweep(name, slow=_SLOW)
        process = act.start()
        act.wait_for(4, RunState.RUNNING)
        cancel(act.folder.name)
        code, _ = end_of(process)
        act.check(code, stage.reference)
        kinds = [error["kind"] for error in act.errors()]
        assert kinds == failed * ["cancelled"], kinds
        act.slow = 0.0
        code, printed = act.fly()
        assert code == 0, printed
        assert f"{failed} of the runs were flown again" in printed
        act.check(code, stage.reference)

    def cancel_two(name: str) -> None:
        for state in ("RUNNING", "PENDING"):
            slurm.ask("scancel", number(name, state))

    def cancel_all(name: str) -> None:
        slurm.ask("scancel", number(name, "RUNNING").partition("_")[0])

    def memory() -> None:
        act = sweep("memory", 2, kinds=["Slow", "Hungry"])
        code, printed = act.fly()
        act.check(code, stage.reference)
        errors = act.errors()
        assert [error["kind"] for error in errors] == 2 * ["memory"], errors
        assert "hydra.launcher.mem_gb" in printed
        code, printed = act.fly("retries=0")
        assert "2 of the runs were ended by a cluster or a crash" in printed, printed
        act.check(code, stage.reference)

    def wall_time() -> None:
        words = ["chunk=1", "hydra.launcher.timeout_min=1"]
        act = sweep("time", 1, kinds=["Slow", "Stuck"], words=words)
        code, printed = act.fly()
        act.check(code, stage.reference)
        assert [error["kind"] for error in act.errors()] == ["time"]
        assert "hydra.launcher.timeout_min" in printed

    def node() -> None:
        act = sweep("node", slow=_SLOW)
        process = act.start()
        act.wait_for(4, RunState.RUNNING)
        slurm.kill_node("n1")
        code, printed = end_of(process)
        assert code == 0, printed
        act.check(code, stage.reference)
        slurm.start_node("n1")
        slurm.wait_until_idle()

    def driver() -> None:
        act = sweep("driver", slow=_SLOW)
        process = act.start()
        act.wait_for(4, RunState.RUNNING)
        process.kill()
        process.communicate()
        code, printed = act.fly()
        assert code == 0, printed
        assert len(jobs(act.folder.name)) == _FEW  # of one array
        act.check(code, stage.reference)

    def two() -> None:
        act = sweep("two", slow=2.0)
        ends = [end_of(process) for process in [act.start(), act.start()]]
        assert [code for code, _ in ends] == [0, 0], ends
        assert len(jobs(act.folder.name)) == _FEW
        act.check(0, stage.reference)

    def blind() -> None:
        act = sweep("blind", slow=2.0)
        act.folder.mkdir()
        slurm.kill_node("n2")
        slurm.start_node("n2", blind_to=act.folder)
        time.sleep(15.0)  # until the controller has noticed
        slurm.wait_until_idle()
        code, printed = act.fly()
        act.check(code, stage.reference)
        errors = act.errors()
        assert errors, printed
        assert all(error["host"] == "n2" for error in errors), errors
        slurm.kill_node("n2")
        slurm.start_node("n2")
        time.sleep(15.0)
        slurm.wait_until_idle()

    return {
        f"{MANY} runs over two nodes": many,
        "scancel of a running and a pending job": lambda: cancelled(
            "cancelled", cancel_two, 2
        ),
        "scancel of a whole array": lambda: cancelled("array", cancel_all, _FEW),
        "a job over its memory": memory,
        "a job over its wall time": wall_time,
        "a node killed": node,
        "the driver killed and called again": driver,
        "two drivers on one sweep": two,
        "a node without the folder": blind,
    }


def ray_acts(stage: Stage) -> dict[str, Act]:
    """Returns the acts on Ray, by what they show."""

    def sweep(name: str, nodes: RayNodes, runs: int = _FEW, **more: Any) -> Sweep:
        address = f"hydra.launcher.ray.init.address={nodes.address}"
        return Sweep(
            folder=stage.folder / f"ray-{name}",
            runs=runs,
            kinds=["Slow"],
            launcher=["launcher=ray", address, *more.pop("words", ["chunk=1"])],
            environment=nodes.environment,
            **more,
        )

    def cluster(name: str, slow: float = 0.0, blind_to: Path | None = None) -> RayNodes:
        folder = Path(tempfile.gettempdir()) / f"gpmpc-ray-{name}"
        return RayNodes(folder, blind_to, {SLOW: str(slow)})

    def many() -> None:
        with cluster("many") as nodes:
            act = sweep("many", nodes, MANY, words=["chunk=10"])
            code, printed = act.fly()
            assert code == 0, printed
            act.check(code, stage.reference)

    def raylet() -> None:
        with cluster("raylet", slow=_SLOW) as nodes:
            act = sweep("raylet", nodes)
            process = act.start()
            act.wait_for(3, RunState.RUNNING)
            nodes.kill_node("second")
            code, printed = end_of(process)
            assert code == 0, printed
            act.check(code, stage.reference)

    def driver() -> None:
        with cluster("driver", slow=_SLOW) as nodes:
            act = sweep("driver", nodes)
            process = act.start()
            act.wait_for(3, RunState.RUNNING)
            process.kill()
            process.communicate()
            code, printed = act.fly()
            assert code == 0, printed
            act.check(code, stage.reference)

    def two() -> None:
        with cluster("two") as nodes:
            act = sweep("two", nodes)
            ends = [end_of(process) for process in [act.start(), act.start()]]
            assert [code for code, _ in ends] == [0, 0], ends
            act.check(0, stage.reference)

    def blind() -> None:
        folder = stage.folder / "ray-blind"
        folder.mkdir()
        with cluster("blind", blind_to=folder) as nodes:
            act = sweep("blind", nodes, 2 * _FEW)
            code, printed = act.fly()
            act.check(code, stage.reference)
            errors = act.errors()
            assert errors, printed
            assert all("127.0.0.2" in error["host"] for error in errors), errors

    return {
        f"{MANY} runs over two nodes": many,
        "a raylet killed": raylet,
        "the driver killed and called again": driver,
        "two drivers on one sweep": two,
        "a node without the folder": blind,
    }


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
