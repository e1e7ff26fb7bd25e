"""Reads thousands of damaged copies of a recording, and says what came of each.

``python study.py RECORDING SEED FIRST END`` writes a line of JSON per damaged file: the
damage, what came of every operation, the processor time of the slowest [s], and the
largest memory of the process [MB]. All are read by one process, whose peak the kernel
resets before each: memory that one file leaves behind counts for the next.
"""

import contextlib
import io
import json
import re
import resource
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import numpy as np

from gpmpc.exceptions import GpmpcError
from gpmpc.recording import layout, read_run, recover, replay
from tests.cli.command import called
from tests.recording import damage

# enough to see how much too much is taken
MEMORY = 2**31
SECONDS = 60
ARRAYS = (
    "steps",
    "times",
    "references",
    "states",
    "measured",
    "inputs",
    "input_bounds",
    "innovations",
    "failed",
)
ARRAYS += (
    "belief_covariances",
    "plan_inputs",
    "plan_means",
    "plan_stds",
    "plan_covariances",
    "iterations",
)
ARRAYS += ("active_set_sizes", "residuals", "timings", "gp_sizes", "gp_versions")
PROBLEM = ("P", "q", "G", "lower", "upper", "softness", "x", "multipliers")


def same(run, other):
    """Whether two runs hold the same, to the last bit."""
    return (
        all(
            np.array_equal(getattr(run, name), getattr(other, name), equal_nan=True)
            for name in ARRAYS
        )
        and (run.statuses, run.metadata, run.config)
        == (other.statuses, other.metadata, other.config)
        and (run.channels, run.state_names, run.input_names)
        == (other.channels, other.state_names, other.input_names)
        and run.problems.keys() == other.problems.keys()
        and all(
            np.array_equal(getattr(problem, name), getattr(other.problems[k], name))
            for k, problem in run.problems.items()
            for name in PROBLEM
        )
    )


def outcome(operation, path, original):
    """Names what came of an operation, or the exception that got out.

    "error" (of the package), "same" content, "unfinished" or "other" content.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            run = operation()
    except GpmpcError as error:
        return "error" if path.stem in str(error) else f"unnamed: {error}"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"[:200]
    if run is None:
        return "done"
    return (
        "unfinished" if not run.finished else "same" if same(run, original) else "other"
    )


def gpmpc_log(action, *paths):
    """Runs the command; an error of it is raised as it is."""
    done = called("log", action, *map(str, paths), "--debug", cwd=paths[0].parent)
    assert done.returncode in (0, 2), done


def operations(path):
    """Everything that is done with a recording."""
    recovered = path.with_suffix(".recovered.mcap")

    def replays():
        run = read_run(path)
        for k in (*list(run.problems)[:2], 10**9):
            with (
                contextlib.suppress(GpmpcError)
                if k == 10**9
                else contextlib.nullcontext()
            ):
                replay(run, k)

    yield "read", lambda: read_run(path)
    yield "layout", lambda: layout(read_run(path)) and None
    yield "replay", replays
    yield "info", lambda: gpmpc_log("info", path)
    yield "export", lambda: gpmpc_log("export", path, path.with_suffix(".csv"))
    yield "recover", lambda: recover(path, recovered) and None
    if recovered.exists():
        yield "recovered", lambda: read_run(recovered)


def examine(path, original):
    """What came of every operation, and what the largest of them took."""
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    outcomes = {}
    slowest = 0.0
    for name, operation in operations(path):
        signal.alarm(SECONDS)  # ends the process, and so the study
        start = time.process_time()
        outcomes[name] = outcome(operation, path, original)
        slowest = max(slowest, time.process_time() - start)
    signal.alarm(0)
    peak = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    for left in path.parent.iterdir():
        left.unlink()
    return {"outcomes": outcomes, "seconds": slowest, "megabytes": int(peak[1]) / 1024}


def study(recording, seed, first, end):
    original = read_run(recording)
    data = recording.read_bytes()
    replay(original, int(original.steps[0]))  # compiles
    kinds = (*damage.DAMAGES, *damage.DAMAGES, *damage.EDITS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "damaged.mcap"
        path.write_bytes(data)
        bare = examine(path, original)["megabytes"]  # imports
        mapped = (
            int(Path("/proc/self/statm").read_text().split()[0])
            * resource.getpagesize()
        )  # libraries take much
        resource.setrlimit(
            resource.RLIMIT_AS, (mapped + MEMORY, resource.RLIM_INFINITY)
        )
        for i in range(first, end):
            rng = np.random.default_rng([seed, i])
            kind = kinds[i % len(kinds)]
            path.write_bytes(kind(data, rng))
            line = {
                "seed": [seed, i],
                "damage": kind.__name__,
                "size": path.stat().st_size,
            }
            line |= examine(path, original)
            yield line | {"megabytes": line["megabytes"] - bare}


if __name__ == "__main__":
    for line in study(Path(sys.argv[1]), *map(int, sys.argv[2:])):
        print(json.dumps(line), flush=True)
