"""``gpmpc warmup``: compiles the numerical kernels."""

import argparse
import time

from rich.console import Console

from gpmpc._compiling import report_compilation
from gpmpc.cli._commands import Result
from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._settings import compose, settings_folders
from gpmpc.cli._terminal import progress_bar
from gpmpc.mpc._control_step import rare_kernels_loaded
from gpmpc.studies.flight import run_trial

_CONTROLLERS = (
    "controller=convex",
    "controller=paper",
    "controller=nonlinear",
    "controller=lqr",
)
_SHORT_FLIGHT = ("data.samples=12", "model.restarts=0", "steps=2", "horizon=3")


def warmup(arguments: argparse.Namespace) -> Result:
    """Flies two steps with every controller, and prints how long that took."""
    console = Console()
    began = time.perf_counter()
    with (
        progress_bar(console) as bar,
        report_compilation(),
        settings_folders(),
        rare_kernels_loaded(),
    ):
        task = bar.add_task("", total=len(_CONTROLLERS))
        for controller in _CONTROLLERS:
            bar.update(task, description=f"compiling what {controller} needs")
            run_trial(experiment_of(compose("run", [controller, *_SHORT_FLIGHT])))
            bar.advance(task)
    seconds = round(time.perf_counter() - began, 3)
    console.print(f"ready after {seconds:.1f} s")
    return Result({"seconds": seconds})
