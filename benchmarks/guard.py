"""Whether anything became slower: this code beside that of a commit, in one run.

    make guard                                     # exit code 1 where a call is slower
    .venv/bin/python -m benchmarks.guard --base v0.2.0

Both sides run at once, each in a process of its own, and take turns of a few calls, so
that a slow minute of the machine slows both. Without ``--base`` the other side is the
last commit, or the one before it where nothing has changed since. Its package is
unpacked below ``outputs/guard/``; the first run with a commit compiles it, which takes
a minute.

A ratio is the median over the turns of this code's time divided by the other's, with an
interval that holds the true median in 95 of 100 runs. A call counts as slower where the
whole interval lies above ``MARGIN``. Since two processes lay out their memory
differently, which can make two per cent, the processes are started anew several times.
One thread, processor time.
"""

import argparse
import io
import json
import os
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "outputs" / "guard"
MARGIN = 1.03
STARTS = 4  # of both processes
TURNS = 25  # of each case and start
TURN_SECONDS = 0.01  # of calls in a turn
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Comparison:
    """Times of one case with this code and with the other, turn by turn.

    Attributes:
        here: Median seconds a call with this code (T,).
        base: Median seconds a call with the other code (T,).
    """

    here: np.ndarray
    base: np.ndarray

    @property
    def ratio(self) -> float:
        """Median ratio of this code's time to the other's."""
        return float(np.median(self.here / self.base))

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper end of the ratio's interval, by order statistics."""
        ratios = np.sort(self.here / self.base)
        tail = (1.0 - CONFIDENCE) / 2.0
        below = max(int(binom.ppf(tail, len(ratios), 0.5)) - 1, 0)
        return float(ratios[below]), float(ratios[-1 - below])

    @property
    def slower(self) -> bool:
        """Whether this code is slower by more than the margin, beyond chance."""
        return self.interval[0] > MARGIN


class Side:
    """A process that times the guarded calls with one package.

    Args:
        package_root: The folder that holds ``gpmpc``.
    """

    def __init__(self, package_root: Path) -> None:
        # The benchmarks are those of this checkout on both sides.
        search_path = os.pathsep.join([str(package_root), str(ROOT)])
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.guard_cases"],
            cwd=package_root,
            env=os.environ | {"PYTHONPATH": search_path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def read(self) -> Any:
        """Returns the next line that the process prints.

        Raises:
            SystemExit: The process has ended.
        """
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            sys.exit("guard: the cases do not run with one of the packages (see above)")
        return json.loads(line)

    def seconds(self, case: str, calls: int) -> float:
        """Returns the median time of some calls of a case [s]."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"case": case, "calls": calls}) + "\n")
        self._process.stdin.flush()
        return self.read()

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def main() -> None:
    """Measures, prints a table and judges."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", help="commit to compare with")
    arguments = parser.parse_args()
    base = full_name(arguments.base or default_base())
    print(f"this code beside {base[:12]}; a ratio above 1 is slower", flush=True)
    comparisons = compare(unpacked(base))
    for name, comparison in comparisons.items():
        print(row(name, comparison))
    sys.exit(any(comparison.slower for comparison in comparisons.values()))


def default_base() -> str:
    """Returns the last commit, or the one before it where nothing has changed since."""
    changed = git("status", "--porcelain", "gpmpc", "benchmarks")
    return "HEAD" if changed else "HEAD~1"


def full_name(commit: str) -> str:
    """Returns the hash of a commit."""
    return git("rev-parse", "--verify", f"{commit}^{{commit}}").decode().strip()


def git(*arguments: str) -> bytes:
    """Returns what a git command prints.

    Raises:
        SystemExit: It fails.
    """
    result = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True)
    if result.returncode:
        sys.exit(f"guard: {result.stderr.decode().strip()}")
    return result.stdout


def unpacked(commit: str) -> Path:
    """Returns a folder with the package of a commit; makes it if it is missing."""
    folder = FOLDER / commit
    if not folder.exists():
        partial = FOLDER / f"{commit}.partial"
        archive = git("archive", commit, "gpmpc")
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            files.extractall(partial, filter="data")
        partial.rename(folder)
    return folder


def compare(base: Path) -> dict[str, Comparison]:
    """Times every case with this code and with the package in a folder."""
    times: dict[str, list[tuple[float, float]]] = {}
    for _ in range(STARTS):
        sides = (Side(ROOT), Side(base))
        names, _ = (side.read() for side in sides)
        for name in names:
            times.setdefault(name, []).extend(take_turns(name, *sides))
        for side in sides:
            side.close()
    return {name: Comparison(*np.array(pairs).T) for name, pairs in times.items()}


def take_turns(name: str, here: Side, base: Side) -> list[tuple[float, float]]:
    """Returns the times of both sides of a case, turn by turn [s]."""
    for side in (here, base):  # the first calls compile, load and allocate
        side.seconds(name, calls=3)
    expected = here.seconds(name, calls=3)
    calls = max(3, round(TURN_SECONDS / expected))
    pairs = []
    for turn in range(TURNS):
        if turn % 2 == 0:
            seconds_here = here.seconds(name, calls)
            seconds_base = base.seconds(name, calls)
        else:
            seconds_base = base.seconds(name, calls)
            seconds_here = here.seconds(name, calls)
        pairs.append((seconds_here, seconds_base))
    return pairs


def row(name: str, comparison: Comparison) -> str:
    """Formats a case: both times, their ratio with its interval, and a verdict."""
    lower, upper = comparison.interval
    milliseconds_here = 1e3 * np.median(comparison.here)
    milliseconds_base = 1e3 * np.median(comparison.base)
    verdict = "SLOWER" if comparison.slower else ""
    return (
        f"{name:30}{milliseconds_here:9.4f} ms, was {milliseconds_base:9.4f} ms: "
        f"{comparison.ratio:.3f} [{lower:.3f}, {upper:.3f}] {verdict}"
    ).rstrip()


if __name__ == "__main__":
    main()
