"""Collects what made a result: versions, source commit, machine, command."""

import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("gpmpc", "torch", "gpytorch", "numpy", "scipy", "casadi", "hydra-core")


def provenance() -> dict:
    """What a reader needs to run the same again, as plain data."""
    return {
        "created": now(),
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "git": _git_commit(),
        "python": platform.python_version(),
        "versions": versions(),
        "machine": {
            "system": platform.system(),
            "processor": processor(),
            "cores": os.cpu_count(),
        },
    }


def flattened(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns nested data as one dictionary, keys dotted."""
    leaves: dict[str, Any] = {}
    for key, value in data.items():
        leaves |= (
            flattened(value, f"{prefix}{key}.")
            if isinstance(value, Mapping)
            else {f"{prefix}{key}": value}
        )
    return leaves


def environment() -> dict[str, str | None]:
    """What computes: the versions that matter, the BLAS library, the processor; a line each of a report of a bug."""
    import numpy as np

    configuration: Any = np.show_config(mode="dicts")
    blas = configuration["Build Dependencies"]["blas"]
    return {
        "gpmpc": version("gpmpc"),
        "python": platform.python_version(),
        **versions(("torch", "gpytorch", "numba", "numpy", "scipy", "casadi")),
        "BLAS": f"{blas['name']} {blas['version']}",
        "CPU": f"{processor()}, {os.cpu_count()} cores",
        "system": f"{platform.system()} {platform.release()}",
    }


def processor() -> str:
    """The processor's name, where the system tells it; else its architecture."""
    with (
        suppress(OSError),
        open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file,
    ):
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def now() -> str:
    """The time in UTC, to the second (ISO 8601)."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def versions(packages: Sequence[str] = _PACKAGES) -> dict[str, str | None]:
    """The installed versions by name; None where a package is not installed."""
    found: dict[str, str | None] = dict.fromkeys(packages)
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _git_commit() -> dict | None:
    """Commit of the source checkout, and whether it has uncommitted changes; None for an installed package."""
    root = Path(__file__).resolve().parents[1]
    if not (root / "pyproject.toml").exists():
        return None
    # Without the lock that refreshes the index: a run that is killed would leave it, and git would refuse to commit.
    git = ["git", "--no-optional-locks", "-C", str(root)]
    run = partial(
        subprocess.check_output, stderr=subprocess.DEVNULL, text=True, timeout=10
    )
    try:
        return {
            "commit": run([*git, "rev-parse", "HEAD"]).strip(),
            "dirty": bool(run([*git, "status", "--porcelain"])),
        }
    except (OSError, subprocess.SubprocessError):
        return None
