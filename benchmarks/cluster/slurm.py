"""Starts a real Slurm of two nodes on this machine, and stops it again.

Everything is in one folder and bound to loopback: configuration, keys, state and logs.
Needs the packages slurmctld, slurmd, slurm-client and munge of Debian or Ubuntu, and
with accounting slurmdbd and mariadb-server. It installs nothing.
"""

import getpass
import os
import secrets
import shutil
import socket
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.cluster.processes import (
    answers,
    descendants,
    free_ports,
    kill,
    processes_with,
    start_daemon,
    wait_for,
    without_folder,
)

NODES = ("n1", "n2")
NEEDED = ("slurmctld", "slurmd", "munged", "sbatch", "squeue", "scontrol")
FOR_ACCOUNTING = ("slurmdbd", "mariadbd", "mariadb-install-db", "sacct")
_NODE_MARK = "GPMPC_NODE"  # variable of the daemons of a node, and of what they start
_PATIENCE = 120.0  # until a command of Slurm answers, or a daemon ends [s]
_PATH = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])

_CONFIGURATION = """
ClusterName=here
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={control_port}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
StateSaveLocation={folder}/state
SlurmctldPidFile={folder}/slurmctld.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdSpoolDir={folder}/spool-%n
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmdLogFile={folder}/slurmd-%n.log
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=1
JobAcctGatherParams=OverMemoryKill
SlurmdTimeout=20
MessageTimeout=30
KillWait=2
ReturnToService=2
MaxArraySize=51
SchedulerParameters=sched_interval=5,bf_interval=5
"""
_ACCOUNTING = """
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=127.0.0.1
AccountingStoragePort={database_port}
AccountingStoragePass={folder}/munge.socket
"""
_NODE = """
NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} \\
CPUs=2 RealMemory=8000
"""
_PARTITION = """
PartitionName=cpu Nodes={nodes} Default=YES MaxTime=INFINITE State=UP
"""
_DATABASE = """
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
DbdHost=localhost
DbdAddr=127.0.0.1
DbdPort={database_port}
SlurmUser={user}
StorageType=accounting_storage/mysql
StorageHost=127.0.0.1
StoragePort={mysql_port}
StorageUser=slurm
StoragePass=slurm
StorageLoc=slurm
LogFile={folder}/slurmdbd.log
PidFile={folder}/slurmdbd.pid
"""


def missing(accounting: bool) -> list[str]:
    """Returns the programs that a cluster needs and this machine lacks."""
    needed = [*NEEDED, *(FOR_ACCOUNTING if accounting else ())]
    return [name for name in needed if shutil.which(name, path=_PATH) is None]


class Slurm:
    """A Slurm of two nodes.

    Args:
        folder: Where it keeps everything.
        accounting: Whether a database remembers ended jobs.
    """

    def __init__(self, folder: Path, accounting: bool = False):
        self.folder = folder
        self.accounting = accounting
        #: what a command needs to find this cluster
        self.environment = os.environ | {
            "PATH": _PATH,
            "SLURM_CONF": str(folder / "slurm.conf"),
        }
        self._daemons: dict[str, subprocess.Popen] = {}

    def start(self) -> None:
        """Writes its configuration, and starts every daemon."""
        self.folder.mkdir(parents=True)
        self.folder.chmod(0o755)
        self._write_configuration()
        self._start_daemons()

    def ask(self, *command: str) -> str:
        """Returns what a command of Slurm answers.

        Raises:
            CalledProcessError: It refuses.
        """
        answer = self._run(*command)
        answer.check_returncode()
        return answer.stdout

    def _run(self, *command: str) -> subprocess.CompletedProcess[str]:
        """Runs a command of Slurm to its end, whatever that is."""
        return subprocess.run(
            command,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=False,
        )

    def kill_node(self, name: str) -> None:
        """Kills a node as a power cut would: its daemon, and all that it started."""
        daemon = self._daemons.pop(name)
        here = {*processes_with(f"SLURM_CONF={self.folder}/slurm.conf")}
        steps = here & {*processes_with(f"{_NODE_MARK}={name}")}
        tasks = here & {*processes_with(f"SLURMD_NODENAME={name}")}
        # From the top, so that none can tell what happened to those below it.
        kill([daemon.pid, *descendants(daemon.pid), *steps, *tasks])
        daemon.wait()

    def start_node(self, name: str, blind_to: Path | None = None) -> None:
        """Starts the daemon of a node, which may not see a folder."""
        command = without_folder(blind_to, ["slurmd", "-D", "-N", name])
        self._start(name, command, {_NODE_MARK: name})

    def wait_until_down(self, name: str) -> None:
        """Waits until the controller has noticed that a node is gone."""
        wait_for(f"{name} down", lambda: self._state_of(name).startswith("down"))

    def wait_until_idle(self) -> None:
        """Waits until all nodes are there, without a job."""
        wait_for("two idle nodes", self._is_ready)

    def stop(self) -> None:
        """Ends the jobs and every daemon."""
        if "slurmctld" in self._daemons:
            self._run("scancel", "--full", f"--user={getpass.getuser()}")
        for name in NODES:
            if name in self._daemons:
                self.kill_node(name)
        while self._daemons:
            _, daemon = self._daemons.popitem()
            daemon.terminate()
            try:
                daemon.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                daemon.kill()
                daemon.wait()

    def _write_configuration(self) -> None:
        for name in ("state", "database"):
            (self.folder / name).mkdir()
        ports = free_ports(3 + len(NODES))
        values = {
            "host": socket.gethostname(),
            "user": getpass.getuser(),
            "folder": self.folder,
            "control_port": ports[0],
            "database_port": ports[1],
            "mysql_port": ports[2],
        }
        self._mysql_port = ports[2]
        parts = [_CONFIGURATION.format(**values)]
        if self.accounting:
            parts.append(_ACCOUNTING.format(**values))
            database = self.folder / "slurmdbd.conf"
            database.write_text(_DATABASE.format(**values))
            database.chmod(0o600)
        for name, port in zip(NODES, ports[3:], strict=True):
            parts.append(_NODE.format(name=name, host=values["host"], port=port))
        parts.append(_PARTITION.format(nodes=",".join(NODES)))
        (self.folder / "slurm.conf").write_text("".join(parts))
        key = self.folder / "munge.key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o400)

    def _start_daemons(self) -> None:
        folder = self.folder
        self._start(
            "munged",
            [
                "munged",
                "--foreground",
                "--force",
                f"--key-file={folder}/munge.key",
                f"--socket={folder}/munge.socket",
                f"--pid-file={folder}/munge.pid",
                f"--seed-file={folder}/munge.seed",
                f"--log-file={folder}/munge.log",
            ],
        )
        wait_for("munged", (folder / "munge.socket").exists)
        if self.accounting:
            self._start_database()
        self._start("slurmctld", ["slurmctld", "-D"])
        for name in NODES:
            self.start_node(name)
        wait_for("slurm", self._is_ready)

    def _start_database(self) -> None:
        """Starts the database of ended jobs, and what writes to it."""
        folder = self.folder
        data = folder / "database"
        user = getpass.getuser()
        subprocess.run(
            ["mariadb-install-db", "--no-defaults", f"--user={user}",
             f"--datadir={data}", "--auth-root-authentication-method=normal"],
            env=self.environment, capture_output=True, check=True,
        )  # fmt: skip
        first = folder / "first.sql"
        first.write_text(
            "CREATE DATABASE slurm;\n"
            "CREATE USER 'slurm'@'%' IDENTIFIED BY 'slurm';\n"
            "GRANT ALL ON slurm.* TO 'slurm'@'%';\n"
        )
        self._start(
            "mariadbd",
            ["mariadbd", "--no-defaults", f"--user={user}", f"--datadir={data}",
             f"--socket={folder}/mysql.socket", f"--pid-file={folder}/mysql.pid",
             "--bind-address=127.0.0.1", f"--port={self._mysql_port}",
             f"--init-file={first}", "--skip-name-resolve"],
        )  # fmt: skip
        wait_for("mariadbd", lambda: answers(self._mysql_port))
        self._start("slurmdbd", ["slurmdbd", "-D"])
        wait_for("slurmdbd", self._has_accounts)

    def _has_accounts(self) -> bool:
        return self._run("sacctmgr", "--noheader", "list", "cluster").returncode == 0

    def _is_ready(self) -> bool:
        return all(self._state_of(name) == "idle" for name in NODES)

    def _state_of(self, name: str) -> str:
        """Returns the state of a node as Slurm writes it; empty if it is silent."""
        command = ["sinfo", "--noheader", "--Node", f"--nodes={name}", "--format=%T"]
        return self._run(*command).stdout.strip()

    def _start(
        self, name: str, command: Sequence[str], marks: Mapping[str, str] | None = None
    ) -> None:
        environment = self.environment | dict(marks or {})
        log = self.folder / f"{name}.out"
        self._daemons[name] = start_daemon(command, environment, log)
