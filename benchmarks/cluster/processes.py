"""Starts daemons and waits for them; finds and ends processes."""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol, TypeVar

_PATIENCE = 300.0  # until a daemon answers, on a machine with other work [s]


class Cluster(Protocol):
    """Daemons that work together."""

    def start(self) -> None:
        """Starts all of them, and waits until they are there."""
        ...

    def stop(self) -> None:
        """Ends those that were started."""
        ...


AnyCluster = TypeVar("AnyCluster", bound=Cluster)


@contextmanager
def running(cluster: AnyCluster) -> Iterator[AnyCluster]:
    """Starts a cluster, and stops it whatever happens."""
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop()


def start_daemon(
    command: Sequence[str], environment: Mapping[str, str], log: Path
) -> subprocess.Popen:
    """Starts a program in a session of its own, which writes into a log."""
    with log.open("ab") as output:
        return subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )


def without_folder(folder: Path | None, command: Sequence[str]) -> list[str]:
    """Returns a command whose program does not see a folder; None hides none."""
    if folder is None:
        return [*command]
    hidden = f'mount -t tmpfs none "{folder}" && exec "$@"'
    return ["unshare", "-m", "sh", "-c", hidden, "sh", *command]


def descendants(root: int) -> list[int]:
    """Returns the processes that a process started, directly or not."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(path.parent.name)] = int(fields[1])
    family = [root]
    for process in family:
        family += [child for child, parent in parents.items() if parent == process]
    return family[1:]


def processes_with(variable: str) -> list[int]:
    """Returns the processes with an environment variable, given as NAME=VALUE."""
    processes = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            variables = (path / "environ").read_bytes().split(b"\0")
        except OSError:
            continue
        if variable.encode() in variables:
            processes.append(int(path.name))
    return processes


def command_of(process: int) -> str:
    """Returns the beginning of a process's command; empty where it has ended."""
    try:
        words = Path(f"/proc/{process}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return ""
    return b" ".join(words).decode(errors="replace")[:80]


def kill(processes: Iterable[int]) -> None:
    """Kills processes, one after another."""
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)


def free_ports(count: int) -> list[int]:
    """Returns ports of the loopback that nobody listens on."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def answers(port: int) -> bool:
    """Whether somebody listens on a port of the loopback."""
    try:
        socket.create_connection(("127.0.0.1", port), 1).close()
    except OSError:
        return False
    return True


def wait_for(what: str, ready: Callable[[], object], patience: float = _PATIENCE):
    """Waits until a condition holds.

    Raises:
        TimeoutError: It does not.
    """
    deadline = time.monotonic() + patience
    while not ready():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what}: not so after {patience:.0f} s")
        time.sleep(0.2)
