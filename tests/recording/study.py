"""Reads thousands of damaged copies of a recording, each in a process of its own, and says what came of each.

``python study.py RECORDING SEED COUNT`` writes a line of JSON per damaged file: the damage, what came of every
operation, the processor time of the slowest [s], and the memory that they took together beyond that of the process.
"""

import contextlib
import io
import json
import os
import resource
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import numpy as np

from gpmpc.cli.command import COMMANDS
from gpmpc.cli.log import log
from gpmpc.exceptions import GpmpcError
from gpmpc.recording import layout, read_run, recover, replay
from tests.recording import damage

MEMORY, SECONDS = 2**31, 60  # enough to see how much too much is taken
ARRAYS = ("steps", "times", "references", "states", "measured", "inputs", "input_bounds", "innovations", "failed")
ARRAYS += ("belief_covariances", "plan_inputs", "plan_means", "plan_stds", "plan_covariances", "iterations")
ARRAYS += ("active_set_sizes", "residuals", "timings", "gp_sizes", "gp_versions")
PROBLEM = ("P", "q", "G", "lower", "upper", "softness", "x", "multipliers")


def same(run, other):
    """Whether two runs hold the same, to the last bit."""
    return (
        all(np.array_equal(getattr(run, name), getattr(other, name), equal_nan=True) for name in ARRAYS)
        and (run.statuses, run.metadata, run.config) == (other.statuses, other.metadata, other.config)
        and (run.channels, run.state_names, run.input_names) == (other.channels, other.state_names, other.input_names)
        and run.problems.keys() == other.problems.keys()
        and all(
            np.array_equal(getattr(problem, name), getattr(other.problems[k], name))
            for k, problem in run.problems.items()
            for name in PROBLEM
        )
    )


def outcome(operation, path, original):
    """Of an operation: "error" (of the package), "same" content, "unfinished", "other" content; or what got out."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            run = operation()
    except GpmpcError as error:
        return "error" if path.stem in str(error) else f"unnamed: {error}"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"[:200]
    if run is None:
        return "done"
    return "unfinished" if not run.finished else "same" if same(run, original) else "other"


def given(*arguments):
    return COMMANDS["log"].parser("log").parse_args(arguments)


def operations(path, original):
    """Everything that is done with a recording."""
    recovered = path.with_suffix(".recovered.mcap")

    def replays():
        run = read_run(path)
        for k in (*list(run.problems)[:2], 10**9):
            with contextlib.suppress(GpmpcError) if k == 10**9 else contextlib.nullcontext():
                replay(run, k)

    yield "read", lambda: read_run(path)
    yield "layout", lambda: layout(read_run(path)) and None
    yield "replay", replays
    yield "info", lambda: log(given("info", str(path)))
    yield "export", lambda: log(given("export", str(path), str(path.with_suffix(".csv"))))
    yield "recover", lambda: recover(path, recovered) and None
    if recovered.exists():
        yield "recovered", lambda: read_run(recovered)


def study(recording, seed, count):
    original, data = read_run(recording), recording.read_bytes()
    if original.problems:
        replay(original, int(original.steps[0]))  # compiles
    bare = _apart(None, None)["megabytes"]
    kinds = (*damage.DAMAGES, *damage.DAMAGES, *damage.EDITS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "damaged.mcap"
        for i in range(count):
            rng = np.random.default_rng([seed, i])
            kind = kinds[i % len(kinds)]
            path.write_bytes(kind(data, rng))
            found = {"seed": [seed, i], "damage": kind.__name__, "size": path.stat().st_size} | _apart(path, original)
            yield found | {"megabytes": found["megabytes"] - bare}
            for left in path.parent.iterdir():
                left.unlink()


def _apart(path, original):
    """In a process of its own."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        with os.fdopen(writing, "w") as answer:
            for name, operation in operations(path, original) if path else ():
                signal.alarm(SECONDS)
                start = time.process_time()
                print(
                    json.dumps([name, outcome(operation, path, original), time.process_time() - start]),
                    file=answer,
                    flush=True,
                )
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as answers:
        lines = [json.loads(line) for line in answers]
    _, status, usage = os.wait4(child, 0)
    found = {name: result for name, result, _ in lines}
    if status:
        found["process"] = f"signal {status}"
    return {"outcomes": found, "seconds": max((s for *_, s in lines), default=0.0), "megabytes": usage.ru_maxrss / 1024}


if __name__ == "__main__":
    for line in study(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])):
        print(json.dumps(line), flush=True)
