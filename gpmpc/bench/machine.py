"""Problem: a time means nothing without the machine: its processor, its caches, and what it can do at its best.

Two rates are measured in the same process and with the same thread as everything else: floating point operations in a
matrix product, and bytes in a walk through memory. They make times of two machines comparable, roughly.
"""

import os
import platform
import re
import time
from pathlib import Path

import numpy as np
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from gpmpc.parallel import THREADS

SIDE = 1000  # of the matrices that are multiplied
WALK = 128 * 2**20  # bytes that are summed: more than any cache


def one_thread() -> None:
    """From now on this process uses one thread, whatever library asks."""
    os.environ.update(dict.fromkeys(THREADS, "1"))  # for libraries that are not loaded yet
    threadpool_limits(1)
    torch.set_num_threads(1)


def machine() -> dict:
    """Processor, cores, caches, threads, and the two rates, as plain data."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "caches": _caches(),
        "threads": max((pool["num_threads"] for pool in threadpool_info()), default=1),
        "load": _load(),
        "dgemm_gflops": round(product_rate(), 1),
        "memory_gb_per_s": round(memory_rate(), 1),
    }


def product_rate() -> float:
    """GFlop/s of a product of two float64 matrices, best of five."""
    left, right = np.ones((SIDE, SIDE)), np.ones((SIDE, SIDE))
    return 2 * SIDE**3 / _least(lambda: left @ right) / 1e9


def memory_rate() -> float:
    """GB/s of reading float64 numbers that are in no cache, best of five."""
    numbers = np.ones(WALK // 8)
    return WALK / _least(numbers.sum) / 1e9


def _least(call) -> float:
    taken = []
    for _ in range(5):
        began = time.thread_time()
        call()
        taken.append(time.thread_time() - began)
    return min(taken)


def _processor() -> str:
    """The processor's name; what the platform says where the system does not tell."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1] if found else platform.processor() or platform.machine()


def _caches() -> dict[str, str]:
    """Sizes of the caches of the first core, by level, as Linux tells them."""
    sizes = {}
    for folder in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        try:
            level, kind, size = ((folder / name).read_text().strip() for name in ("level", "type", "size"))
        except OSError:
            continue
        if kind != "Instruction":
            sizes[f"L{level}"] = size
    return sizes


def _load() -> float | None:
    """Processes that wanted a core over the last minute, these ones included."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
