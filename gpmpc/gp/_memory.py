"""The memory that is left for this process, so that work which needs more says so at its start."""

import os
from pathlib import Path

GIB = 2**30


def available_memory() -> int | None:
    """Bytes that this process may still take without swapping; None where the system does not say.

    What Linux calls available, or what the process's control group (v2; a container, a Slurm job) leaves, whichever is
    less. Elsewhere all physical memory, which is an upper bound.
    """
    found = [amount for amount in (_by_kernel(), _by_control_group()) if amount is not None]
    if found:
        return max(min(found), 0)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _by_kernel(path: Path = Path("/proc/meminfo")) -> int | None:
    try:
        lines = path.read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, IndexError, StopIteration):
        return None


def _by_control_group(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> int | None:
    """The least that the process's group and those above it leave; file pages that can be dropped count as free."""
    try:
        lines = own.read_text().splitlines()
        group = root / next(line[3:] for line in lines if line.startswith("0::")).strip("/")
    except (OSError, StopIteration):
        return None
    left = [_left(folder) for folder in (group, *group.parents) if folder.is_relative_to(root)]
    return min((amount for amount in left if amount is not None), default=None)


def _left(folder: Path) -> int | None:
    try:
        limit = int((folder / "memory.max").read_text())  # "max" where there is none
        used = int((folder / "memory.current").read_text())
        kinds = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return limit - used + int(kinds.get("inactive_file", 0))
    except (OSError, ValueError):
        return None
