"""Points of an exported controller: all, as many as were asked for, or as many as fit.

budget -> flights of the run with fewer points, code compiled -> table, number
"""

import argparse
import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from rich.console import Console

from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import SettingError, check_number
from gpmpc.export import Budget, PointChoice, choose_points, with_points
from gpmpc.export._points import posterior_of
from gpmpc.export._write import MARK
from gpmpc.mpc import GPMPC
from gpmpc.simulation import Rollout
from gpmpc.studies.flight import Experiment, run_trial

# of the cost of all points, above which the user is told
_DEAR = 1.1


class KeptPoints(NamedTuple):
    """A controller, and how many of its points are exported."""

    controller: GPMPC  #: of the points that are kept
    points: int | None = None  #: how many; None where nobody asked for fewer
    all_points: int | None = None  #: how many its model has
    choice: PointChoice | None = None

    @property
    def lines(self) -> list[str]:
        """Returns what a user is told in the end."""
        if self.points is None:
            return []
        lines = [f"points            {self.points} of {self.all_points} are kept"]
        if self.choice is not None and self.choice.chosen.cost > _DEAR:
            cost = self.choice.chosen.cost
            times = f"costs {cost:.3g} times as much as"
            if not math.isfinite(cost):
                times = "is lost, other than"
            lines.append(
                f"with {self.points} points the flight {times} with all: "
                "a larger budget holds more"
            )
        return lines

    @property
    def data(self) -> dict[str, Any]:
        """Returns the same as plain data, with the rows of the table."""
        if self.points is None:
            return {}
        data: dict[str, Any] = {"points": self.points, "all_points": self.all_points}
        if self.choice is None:
            return data
        data["measured_by"] = self.choice.chosen.footprint.compiler
        data["rows"] = [
            {
                "points": row.points,
                "error_ratio": row.error,
                "cost_ratio": row.cost,
                "flash_bytes": row.footprint.flash,
                "ram_bytes": row.footprint.ram,
                "stack_bytes": row.footprint.stack,
                "instructions": row.footprint.worst,
            }
            for row in self.choice.rows
        ]
        return data

    def document(self, budget: str) -> str:
        """Returns the page of the exported folder that says how many are kept."""
        text = f"<!-- {MARK} -->\n\n# Points\n\n"
        text += f"{self.points} of {self.all_points} points are kept"
        if self.choice is None:
            return f"{text}.\n"
        return (
            f"{text}: the most that fit `{budget}`.\n\n{self.choice.table()}\n\n"
            "One-step error and cost are those of the flight, all points 1. The stack "
            "counts as RAM.\n"
        )


def budget_of(arguments: argparse.Namespace) -> Budget | None:
    """Returns the budget of a command line, checked with the options beside it.

    Raises:
        SettingError: They do not go together, or cannot be read.
    """
    if arguments.budget is None:
        if arguments.chip is not None:
            rule = "is the chip of a budget, such as --budget flash=64kB"
            raise SettingError("--chip", f"{rule}; got none")
        if arguments.points is not None:
            check_number("--points", arguments.points, least=1, whole=True)
        return None
    if arguments.points is not None:
        raise SettingError("--points", "is chosen by --budget; leave one of them out")
    return Budget.parse(arguments.budget)


def kept_points(
    console: Console,
    controller: GPMPC,
    experiment: Experiment,
    budget: Budget | None,
    arguments: argparse.Namespace,
) -> KeptPoints:
    """Returns the controller with as many points as are asked for, or fit.

    Raises:
        SettingError: There are fewer, or nothing fits.
    """
    model = controller.prediction.model
    points = arguments.points
    choice = None
    if budget is not None:
        with console.status("measuring") as status:
            choice = choose_points(
                controller,
                partial(_fly, experiment, model),
                budget,
                chip=arguments.chip,
                precision=arguments.precision,
                on_failure=experiment.on_failure,
                progress=status.update,
            )
        points = choice.points
        console.out(choice.table(), highlight=False)
    if points is None:
        return KeptPoints(controller)
    reduced = with_points(model, points)
    return KeptPoints(
        controller.with_model(reduced),
        points=len(posterior_of(reduced)),
        all_points=len(posterior_of(model)),
        choice=choice,
    )


def _fly(experiment: Experiment, model: DynamicsModel, controller: Any) -> Rollout:
    """Flies the run again with another controller, beside the model of all points.

    Raises:
        Diverged: The system left the finite numbers.
    """

    def controller_of(model: DynamicsModel) -> Any:
        return controller

    flown = run_trial(replace(experiment, model=model, controller=controller_of))
    if flown.diverged is not None:
        raise flown.diverged
    return flown.rollout
