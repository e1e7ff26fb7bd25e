"""Refuses a training that would not fit the memory, before the work begins."""

from contextlib import suppress
from pathlib import Path

from gpmpc.exceptions import DataError

_GIB = 2**30


def check_memory(size: int, outputs: int) -> None:
    """Raises ``DataError`` where exact GPs would not fit the available memory.

    Args:
        size: Number of training points, N.
        outputs: Number of GPs, k.
    """
    available = available_memory()
    one_matrix = 8 * size**2
    # Those of the posterior's factors, and two more while one is made.
    needed = one_matrix * (outputs + 2)
    if available is None or needed <= available:
        return
    fitting = int((available / needed) ** 0.5 * size)
    raise DataError(
        f"exact GPs of {size} points and {outputs} outputs need "
        f"{needed / _GIB:.3g} GiB, {one_matrix / _GIB:.3g} GiB a kernel matrix; "
        f"{available / _GIB:.3g} GiB are available: train on {fitting} points or "
        "fewer, or sparse GPs (SparseTrainer)"
    )


def check_sparse_memory(size: int, outputs: int, inducing: int) -> None:
    """Raises ``DataError`` where sparse GPs would not fit the available memory.

    Args:
        size: Number of training points, N.
        outputs: Number of GPs, k.
        inducing: Number of inducing points, M.
    """
    available = available_memory()
    count = min(inducing, size)
    # The rows of the factor that chooses the points.
    needed = 8 * outputs * count * size
    if available is None or needed <= available:
        return
    raise DataError(
        f"sparse GPs of {size} points, {count} inducing points and {outputs} outputs "
        f"need {needed / _GIB:.3g} GiB; {available / _GIB:.3g} GiB are available: take "
        f"{int(available / needed * count)} inducing points or fewer, or train on "
        "fewer rows"
    )


def available_memory(system: Path = Path("/")) -> int | None:
    """Returns the bytes that this process may still take without swapping.

    They are what Linux calls available, or what the process's control groups (v2; a
    container, a Slurm job) leave, whichever is less; file pages that can be dropped
    count as free. None where the system does not say.
    """
    limits: list[int] = []
    with suppress(OSError):
        for line in (system / "proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                limits.append(1024 * int(line.split()[1]))
    with suppress(OSError):
        for folder in _control_groups(system):
            with suppress(OSError, ValueError):  # "max" where there is no limit
                limits.append(_left_in_group(folder))
    return max(min(limits), 0) if limits else None


def _control_groups(system: Path) -> set[Path]:
    """Folders of the control groups of this process, and of those above them."""
    root = system / "sys/fs/cgroup"
    folders: set[Path] = set()
    for line in (system / "proc/self/cgroup").read_text().splitlines():
        if line.startswith("0::"):
            group = root / line[3:].strip("/")
            folders.update([group, *group.parents])
    return folders


def _left_in_group(folder: Path) -> int:
    """Returns the bytes that a control group leaves."""
    statistics = (folder / "memory.stat").read_text().splitlines()
    pages = dict(line.split() for line in statistics)
    droppable = int(pages.get("inactive_file", 0))
    occupied = int((folder / "memory.current").read_text()) - droppable
    return int((folder / "memory.max").read_text()) - occupied
