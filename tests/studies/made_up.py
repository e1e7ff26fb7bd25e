"""Runs that were never flown, with the folders and the content of real ones."""

import io
import json
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pandas as pd
from rich.console import Console

from gpmpc.gp import Trainer
from gpmpc.mpc import Box, Timing
from gpmpc.simulation import Rollout
from gpmpc.status import Status
from gpmpc.studies import report as reporting
from gpmpc.studies._document import terminal
from gpmpc.studies._run_folder import PLAN_PREFIX, RunFolder, folder_name, run_header
from gpmpc.studies.flight import Experiment, Flown, metrics
from gpmpc.studies.report import report_document
from gpmpc.studies.study import Document, Table
from gpmpc.systems import translational

SETTINGS = {
    "data": {"size": None},
    "horizon": 10,
    "seed": 0,
    "options": {"controller": "convex"},
}
PLANT = translational()


def metrics_of(error, steps=20, failing=0, constraints=()):
    """The metrics of a flight that is always ``error`` [m] from its reference in x."""
    problem = SimpleNamespace(
        inputs=Box(np.zeros(3), np.full(3, 10.0)), constraints=constraints
    )
    references = np.zeros((steps + 1, 6))
    states = references.copy()
    states[:, 0] = error
    statuses = (Status.INFEASIBLE,) * failing + (Status.SOLVED,) * (steps - failing)
    nothing = np.full((steps, 6), np.nan)
    timing = Timing(1e-3, 1e-4, 2e-3)
    rollout = Rollout(
        states,
        np.zeros((steps + 1, 6, 6)),
        states[:-1],
        np.ones((steps, 3)),
        references,
        nothing,
        np.full((steps, 6, 6), np.nan),
        statuses,
        np.ones(steps, int),
        (timing,) * steps,
        1.0,
    )
    experiment = Experiment(
        data=None,
        trajectory=None,
        system=PLANT,
        train=Trainer(),
        controller=lambda plant: None,
        steps=steps,
    )
    return metrics(
        experiment, Flown(rollout, SimpleNamespace(problem=problem, horizon=2), None)
    )


def folder_of(tree, choices):
    """The folder of the run of some choices in a tree."""
    return tree / folder_name(choices)


def record_of(settings, choices=()):
    """What a run with settings keeps about itself."""
    return run_header(list(choices), settings, "gpmpc run")


def shown_number(value):
    """How a document shows a number."""
    document = Document("", [Table(["x"], [[value]])], pd.DataFrame())
    return document.markdown().split("|")[-2].strip()


def on_terminal(table, width):
    """The text of a table on a terminal of ``width`` columns."""
    stream = io.StringIO()
    Console(file=stream, width=width).print(terminal([table]))
    return stream.getvalue()


def made_up_run(tree, choices, settings, result=None, error=None):
    folder = RunFolder(folder_of(tree, choices))
    folder.path.mkdir(parents=True)
    about = record_of(settings, choices)
    if error is None:
        folder.finish(about | result)
    else:
        folder.fail(ValueError(error), about)


def plan(tree, runs):
    tree.mkdir(parents=True, exist_ok=True)
    (tree / f"{PLAN_PREFIX}0.json").write_text(json.dumps({"runs": runs}))


def chosen(controller, seed, **more):
    settings = SETTINGS | {"seed": seed, "options": {"controller": controller}}
    return sorted(
        [
            f"controller={controller}",
            f"seed={seed}",
            *(f"{k}={v}" for k, v in more.items()),
        ]
    ), settings


def add(tree, controller, seed, error, **how):
    made_up_run(tree, *chosen(controller, seed), result=metrics_of(error, **how))


def undrawn(report, *comparison):
    """A report without its figures, which take their time."""
    with patch.object(reporting, "_figures", return_value={}):
        return report_document(report, *comparison)


def texts(report, *comparison):
    """Every text of a report, by the name of its file."""
    document = undrawn(report, *comparison)
    return document.files("report") | {"report.html": document.html()}


def documents(report, comparison=()):
    """Every file of a report, by name."""
    document = report_document(report, comparison)
    return document.files("report") | {"report.html": document.html()}


def lose(tree, choices, command="gpmpc run"):
    """Leaves a run whose process died before it could say what its settings were."""
    about = {
        "choices": choices,
        "settings": {},
        "provenance": {"command": command},
    }
    RunFolder(folder_of(tree, choices)).end_from_outside(
        "its process died", "crash", about
    )
