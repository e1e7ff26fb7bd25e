"""Starts a real cluster of Ray of two nodes on this machine, and stops it again."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from benchmarks.cluster.processes import (
    descendants,
    free_ports,
    kill,
    start_daemon,
    wait_for,
    without_folder,
)

_NAMES = ("head", "second")
_ADDRESSES = {"head": "127.0.0.1", "second": "127.0.0.2"}
_STORE = 100_000_000  # [bytes] of objects; a sweep has next to none


def missing() -> list[str]:
    """Returns what a cluster needs and this environment lacks."""
    if Path(sys.executable).with_name("ray").exists():
        return []
    return ["ray (pip install 'gpmpc[ray]')"]


class RayNodes:
    """A cluster of two raylets.

    Args:
        folder: Where it keeps everything; its path is short, since sockets lie there.
        blind_to: A folder that the second node does not see.
        variables: Of the environment of all tasks, and not of commands.
    """

    def __init__(
        self,
        folder: Path,
        blind_to: Path | None = None,
        variables: Mapping[str, str] | None = None,
    ):
        self.folder = folder
        self.blind_to = blind_to
        #: what a command needs
        self.environment = os.environ | {
            "RAY_AUTH_MODE": "disabled",
            "RAY_USAGE_STATS_ENABLED": "0",
        }
        self._environment_of_tasks = {**self.environment, **(variables or {})}
        (self._port,) = free_ports(1)
        self._daemons: dict[str, subprocess.Popen] = {}

    @property
    def address(self) -> str:
        """Where a sweep finds it."""
        return f"{_ADDRESSES['head']}:{self._port}"

    def start(self) -> None:
        """Starts both nodes."""
        for name in _NAMES:
            self.start_node(name)

    def start_node(self, name: str) -> None:
        """Starts a raylet, the first one with the head, and waits until it is there."""
        ray = str(Path(sys.executable).with_name("ray"))
        command = [
            ray, "start", "--block", "--num-cpus=2", "--disable-usage-stats",
            f"--node-ip-address={_ADDRESSES[name]}",
            f"--object-store-memory={_STORE}",
        ]  # fmt: skip
        if name == "head":
            command += [
                "--head",
                f"--port={self._port}",
                "--include-dashboard=false",
                f"--temp-dir={self.folder}",
                "--min-worker-port=0",
                "--max-worker-port=0",
            ]
        else:
            command.append(f"--address={self.address}")
            command = without_folder(self.blind_to, command)
        self.folder.mkdir(parents=True, exist_ok=True)
        log = self.folder.with_name(f"{self.folder.name}-{name}.out")
        log.unlink(missing_ok=True)
        self._daemons[name] = start_daemon(command, self._environment_of_tasks, log)
        wait_for(f"ray, {name}", lambda: "Ray runtime started" in log.read_text())

    def kill_node(self, name: str) -> None:
        """Kills a raylet with all that it started, as a power cut would."""
        daemon = self._daemons.pop(name)
        kill([*descendants(daemon.pid), daemon.pid])
        daemon.wait()

    def stop(self) -> None:
        """Ends both nodes."""
        for name in reversed(_NAMES):
            if name in self._daemons:
                self.kill_node(name)
