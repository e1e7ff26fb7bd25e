"""Makes a layout for Foxglove that fits a recording: it names message paths, so it needs the recording's own names.

Its format is the one that Foxglove and its open fork Lichtblick (github.com/lichtblick-suite/lichtblick) export and
import: a configuration by panel id and a tree of splits; fields that one of them does not know are ignored. Easily got
wrong: a panel's title is ``foxglovePanelTitle``; a legend at the top takes its size, 240 pixels, off the curves; an
index in the path of a plot counts from the front (Lichtblick draws nothing else).
"""

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpmpc.recording._messages import ATTITUDE, PLAN, POSITION, STEP, TIMING
from gpmpc.recording._reader import Run
from gpmpc.recording._scene import DISPLAY, VEHICLE, WORLD

_STATE, _MEASURED, _REFERENCE, _BOUND = (
    "#0072b2",
    "#e69f00",
    "#000000",
    "#d55e00",
)  # Okabe and Ito (2008)
_PALETTE = (_STATE, _BOUND, "#009e73", "#cc79a7", _MEASURED, "#56b4e9")
_Panels = dict[str, dict[str, Any]]


def layout(run: Run) -> str:
    """Returns the layout for a recording, as JSON.

    Plots in tabs (positions, attitude, other states, inputs with their bounds, uncertainty, solver) beside the vehicle
    in space, where the states tell where it is or how it is turned, and the log of failures.
    """
    axes = (("Position", POSITION), ("Attitude", ATTITUDE))
    groups = {
        title: [run.state_names[run.pose[axis]] for axis in those if axis in run.pose]
        for title, those in axes
    }
    tracked = [*groups["Position"], *groups["Attitude"]]
    groups["Rates" if tracked else "States"] = [
        name for name in run.state_names if name not in tracked
    ]
    groups = {title: names for title, names in groups.items() if names}

    tabs = _tabs(run, groups)
    panels = {id: config for tab in tabs.values() for id, config in tab.items()}
    plots = [
        {"title": title, "layout": _column(list(tab))} for title, tab in tabs.items()
    ]
    panels["Tab!plots"] = {"activeTabIdx": 0, "tabs": plots}
    panels["RosOut!log"] = {
        "searchTerms": [],
        "minLogLevel": 1,
        "topicToRender": "/log",
    }
    left = "RosOut!log"
    share = 25
    if "/pose" in run.channels:
        panels["3D!scene"] = _scene("Position" in groups, "Attitude" in groups)
        left = _split("column", "3D!scene", left, 78)
        share = 50
    whole = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
    }
    return (
        json.dumps(
            whole | {"layout": _split("row", left, "Tab!plots", share)}, indent=1
        )
        + "\n"
    )


def _tabs(run: Run, groups: Mapping[str, Sequence[str]]) -> dict[str, _Panels]:
    """Makes the panels with plots, from top to bottom, by the title of their tab."""
    units = run.metadata.get("units", {})

    def unit(*fields: str) -> str:
        found = {units.get(field, "?") for field in fields}
        return f" [{found.pop()}]" if len(found) == 1 and not found & {"1", "?"} else ""

    def several(title: str, labels: Mapping[str, str]) -> dict[str, Any]:
        colours = itertools.cycle(_PALETTE)
        return _plot(
            title, [_line(path, label, next(colours)) for path, label in labels.items()]
        )

    tabs: dict[str, _Panels] = {
        title: {} for title in (*groups, "Inputs", "Uncertainty", "Solver")
    }
    for title, names in groups.items():
        for name in names:
            lines = [
                _line(f"{STEP}.measured.{name}", "measured", _MEASURED),
                _line(f"{STEP}.state.{name}", "state", _STATE),
                _line(
                    f"{STEP}.reference.{name}",
                    "reference",
                    _REFERENCE,
                    lineStyle="dashed",
                ),
            ]
            tabs[title][f"Plot!state-{name}"] = _plot(
                name + unit(f"state.{name}"), lines
            )
    for name, bounds in zip(run.input_names, run.input_bounds.T, strict=True):
        lines = [
            _line(f"{STEP}.input.{name}", "applied", _STATE, lineInterpolation="step")
        ]
        for side in ("lower", "upper") if np.isfinite(bounds).any() else ():
            lines.append(
                _line(
                    f"{STEP}.input_{side}.{name}",
                    f"{side} bound",
                    _BOUND,
                    lineStyle="dashed",
                )
            )
        tabs["Inputs"][f"Plot!input-{name}"] = _plot(
            name + unit(f"input.{name}"), lines
        )
    for title, names in list(groups.items())[:2]:
        for id, path, what in (
            (
                "expected",
                f"{PLAN}.stages[1].std",
                "standard deviation expected one step ahead",
            ),
            ("innovation", f"{STEP}.innovation", "measured minus expected"),
        ):
            heading = f"{title}: {what}{unit(*(f'state.{name}' for name in names))}"
            tabs["Uncertainty"][f"Plot!{id}-{title.lower()}"] = several(
                heading, {f"{path}.{n}": n for n in names}
            )
    counts = {
        "iterations": "iterations",
        "active_set_size": "active constraints",
        "gp_size": "GP points",
    }
    path = {"enabled": True, "timestampMethod": "receiveTime"}
    status = [
        {"value": f"{STEP}.{field}", "label": field} | path
        for field in ("status", "failed", "judgement")
    ]
    tabs["Solver"] = {
        "Plot!timing": several(
            "decision [s]", {f"{STEP}.timing.{name}": name for name in TIMING}
        ),
        "Plot!iterations": several(
            "solver and model",
            {f"{STEP}.{field}": label for field, label in counts.items()},
        ),
        "StateTransitions!status": {
            "foxglovePanelTitle": "how the solves ended, and how the flight goes",
            "isSynced": True,
            "paths": status,
        },
    }
    return tabs


def _line(path: str, label: str, colour: str, **more: Any) -> dict[str, Any]:
    line = {
        "value": path,
        "label": label,
        "color": colour,
        "enabled": True,
        "showLine": True,
    }
    return line | {"timestampMethod": "receiveTime"} | more


def _plot(title: str, lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    shown = dict.fromkeys(("showXAxisLabels", "showYAxisLabels", "showLegend"), True)
    # At the top the legend takes its height off the curves; ``sidebarDimension`` is its width [px].
    plot = {"foxglovePanelTitle": title, "paths": list(lines)} | shown
    return plot | {
        "legendDisplay": "left",
        "sidebarDimension": 150,
        "isSynced": True,
        "xAxisVal": "timestamp",
    }


def _scene(moves: bool, turns: bool) -> dict[str, Any]:
    """Makes the 3D panel: around a vehicle that moves, or on the spot around one that only turns."""
    size = 40 if moves else 4  # [m]
    grid = {
        "layerId": "foxglove.Grid",
        "instanceId": "grid",
        "label": "Grid",
        "visible": True,
        "frameLocked": True,
    }
    grid |= {
        "frameId": DISPLAY,
        "size": size,
        "divisions": size,
        "color": "#24824280",
        "order": 1,
    }
    camera = {
        "distance": 25 if moves else 3,
        "perspective": True,
        "phi": 60,
        "thetaOffset": 45,
    }  # [m], [deg]
    axis = {"visible": True, "type": "axis"}
    return {
        "foxglovePanelTitle": "plan and 2-sigma tube" if moves else "attitude",
        "followMode": "follow-position" if moves else "follow-none",
        "followTf": VEHICLE if moves else DISPLAY,
        "fixedFrame": DISPLAY,
        "cameraState": camera,
        "scene": {"transforms": {"showLabel": False}},
        "transforms": {
            f"frame:{name}": {"visible": False} for name in (WORLD, VEHICLE)
        },  # /pose shows where it is
        "layers": {"grid": grid},
        "topics": {
            "/pose": axis | {"axisScale": 1.0},
            "/reference": axis | {"axisScale": 0.6},
            "/plan/path": axis
            | {"axisScale": 0.25, "visible": turns},  # where it goes, the tube shows
            "/plan/tube": {"visible": moves},
        },
    }


def _split(
    direction: str, first: Any, second: Any, percentage: float
) -> dict[str, Any]:
    return {
        "direction": direction,
        "first": first,
        "second": second,
        "splitPercentage": percentage,
    }


def _column(ids: Sequence[str]) -> Any:
    """Puts panels one below the other, of equal height."""
    if len(ids) == 1:
        return ids[0]
    return _split("column", ids[0], _column(ids[1:]), round(100 / len(ids), 2))
