"""``gpmpc warmup``: compiles the numerical kernels, which are kept on this machine for every later run."""

import argparse
import time

from gpmpc.cli._arguments import Command, Result
from gpmpc.cli._configuration import compose, settings
from gpmpc.cli._run import experiment_of
from gpmpc.cli._terminal import progress_bar

_FLOWN = ("controller=convex", "controller=paper", "controller=nonlinear", "controller=lqr")
_SHORT = ("data.samples=12", "model.restarts=0", "steps=2", "horizon=3")


def _warmup(given: argparse.Namespace) -> Result:
    """Flies two steps with every controller on a learned model, and prints how long that took."""
    from rich.console import Console

    from gpmpc.compiling import report_compilation
    from gpmpc.studies.flight import run_trial

    console, began = Console(), time.perf_counter()
    with progress_bar(console) as bar, report_compilation(), settings():
        task = bar.add_task("", total=len(_FLOWN))
        for words in _FLOWN:
            bar.update(task, description=f"compiling what {words} needs")
            run_trial(experiment_of(compose("run", [words, *_SHORT])))
            bar.advance(task)
    seconds = round(time.perf_counter() - began, 3)
    console.print(f"ready after {seconds:.1f} s")
    return Result({"seconds": seconds})


COMMAND = Command("Compiles the numerical kernels now, instead of at the first flight", _warmup)
