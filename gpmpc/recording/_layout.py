"""Makes a layout for Foxglove that fits a recording: it names the recording's fields.

Its format is the one that Foxglove and its open fork Lichtblick
(github.com/lichtblick-suite/lichtblick) export and import: a configuration by panel id
and a tree of splits; fields that one of them does not know are ignored. Easily got
wrong: a panel's title is ``foxglovePanelTitle``; a legend at the top takes its size,
240 pixels, off the curves; an index in the path of a plot counts from the front
(Lichtblick draws nothing else).
"""

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.recording._run import TIMINGS, Run
from gpmpc.recording._scene import DISPLAY, VEHICLE, WORLD
from gpmpc.recording._schema import PLAN, STEP
from gpmpc.recording._system import ATTITUDE, POSITION

# Okabe and Ito (2008)
_STATE = "#0072b2"
_MEASURED = "#e69f00"
_REFERENCE = "#000000"
_BOUND = "#d55e00"
_PALETTE = (_STATE, _BOUND, "#009e73", "#cc79a7", _MEASURED, "#56b4e9")
_LOG_PANEL = "RosOut!log"
_SCENE_PANEL = "3D!scene"
_PLOTS_PANEL = "Tab!plots"
_Panel = dict[str, Any]
_Panels = dict[str, _Panel]  # by id
_Groups = dict[str, list[str]]  # names of states by their title


@explains_arguments
def layout(run: Run) -> str:
    """Returns the layout for a recording, as JSON.

    Plots in tabs (positions, attitude, other states, inputs with their bounds,
    uncertainty, solver) beside the vehicle in space, where the states tell where it is
    or how it is turned, and the log of failures.
    """
    groups = _group_states(run)
    tabs = _tabs(run, groups)
    panels: _Panels = {}
    for tab in tabs.values():
        panels |= tab
    panels[_PLOTS_PANEL] = {
        "activeTabIdx": 0,
        "tabs": [
            {"title": title, "layout": _below_each_other(list(tab))}
            for title, tab in tabs.items()
        ],
    }
    panels[_LOG_PANEL] = {
        "searchTerms": [],
        "minLogLevel": 1,
        "topicToRender": "/log",
    }
    column: str | dict[str, Any] = _LOG_PANEL  # on the left
    column_width = 25  # [%]
    if "/pose" in run.channels:
        panels[_SCENE_PANEL] = _scene("Position" in groups, "Attitude" in groups)
        column = _split("column", _SCENE_PANEL, _LOG_PANEL, 78)
        column_width = 50
    content = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", column, _PLOTS_PANEL, column_width),
    }
    return json.dumps(content, indent=1) + "\n"


def _group_states(run: Run) -> _Groups:
    """Groups the states: position, attitude, and the others."""
    groups: _Groups = {}
    for title, axes in (("Position", POSITION), ("Attitude", ATTITUDE)):
        names = [run.state_names[run.pose[axis]] for axis in axes if axis in run.pose]
        if names:
            groups[title] = names
    in_space = {name for names in groups.values() for name in names}
    others = [name for name in run.state_names if name not in in_space]
    if others:
        groups["Rates" if in_space else "States"] = others
    return groups


def _tabs(run: Run, groups: _Groups) -> dict[str, _Panels]:
    """Makes the panels with plots, from top to bottom, by the title of their tab."""
    units = run.metadata.get("units", {})
    tabs = {
        title: {f"Plot!state-{name}": _state_plot(name, units) for name in names}
        for title, names in groups.items()
    }
    tabs["Inputs"] = {
        f"Plot!input-{name}": _input_plot(name, bounds, units)
        for name, bounds in zip(run.input_names, run.input_bounds.T, strict=True)
    }
    tabs["Uncertainty"] = {}
    for title, names in list(groups.items())[:2]:
        tabs["Uncertainty"] |= _uncertainty_plots(title, names, units)
    tabs["Solver"] = _solver_panels()
    return tabs


def _state_plot(name: str, units: Mapping[str, str]) -> _Panel:
    """Plots a state with its measurement and its reference."""
    reference = _line(f"{STEP}.reference.{name}", "reference", _REFERENCE)
    lines = [
        _line(f"{STEP}.measured.{name}", "measured", _MEASURED),
        _line(f"{STEP}.state.{name}", "state", _STATE),
        reference | {"lineStyle": "dashed"},
    ]
    return _plot(name + _unit([f"state.{name}"], units), lines)


def _input_plot(name: str, bounds: np.ndarray, units: Mapping[str, str]) -> _Panel:
    """Plots an input with its bounds (2,), if any is finite."""
    applied = _line(f"{STEP}.input.{name}", "applied", _STATE)
    lines = [applied | {"lineInterpolation": "step"}]
    if np.isfinite(bounds).any():
        for side in ("lower", "upper"):
            bound = _line(f"{STEP}.input_{side}.{name}", f"{side} bound", _BOUND)
            lines.append(bound | {"lineStyle": "dashed"})
    return _plot(name + _unit([f"input.{name}"], units), lines)


def _uncertainty_plots(
    title: str, names: Sequence[str], units: Mapping[str, str]
) -> _Panels:
    """Plots how sure the plan is of states, and how wrong it was."""
    unit = _unit([f"state.{name}" for name in names], units)
    std = f"{PLAN}.stages[1].std"
    expected = _coloured_plot(
        f"{title}: standard deviation expected one step ahead{unit}",
        {f"{std}.{name}": name for name in names},
    )
    innovation = _coloured_plot(
        f"{title}: measured minus expected{unit}",
        {f"{STEP}.innovation.{name}": name for name in names},
    )
    return {
        f"Plot!expected-{title.lower()}": expected,
        f"Plot!innovation-{title.lower()}": innovation,
    }


def _solver_panels() -> _Panels:
    """Shows how long decisions took, and how they ended."""
    counts = {
        f"{STEP}.iterations": "iterations",
        f"{STEP}.active_set_size": "active constraints",
        f"{STEP}.gp_size": "GP points",
    }
    states = [
        {
            "value": f"{STEP}.{field}",
            "label": field,
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for field in ("status", "failed", "judgement")
    ]
    return {
        "Plot!timing": _coloured_plot(
            "decision [s]", {f"{STEP}.timing.{name}": name for name in TIMINGS}
        ),
        "Plot!iterations": _coloured_plot("solver and model", counts),
        "StateTransitions!status": {
            "foxglovePanelTitle": "how the solves ended, and how the flight goes",
            "isSynced": True,
            "paths": states,
        },
    }


def _unit(fields: Sequence[str], units: Mapping[str, str]) -> str:
    """Returns the unit of fields for a title; empty where they have none in common."""
    common = {units.get(field, "?") for field in fields}
    if len(common) != 1 or common & {"1", "?"}:
        return ""
    return f" [{common.pop()}]"


def _coloured_plot(title: str, labels: Mapping[str, str]) -> _Panel:
    """Plots fields, each in another colour, with labels by their paths."""
    colours = itertools.cycle(_PALETTE)
    lines = [_line(path, label, next(colours)) for path, label in labels.items()]
    return _plot(title, lines)


def _line(path: str, label: str, colour: str) -> dict[str, Any]:
    return {
        "value": path,
        "label": label,
        "color": colour,
        "enabled": True,
        "showLine": True,
        "timestampMethod": "receiveTime",
    }


def _plot(title: str, lines: Sequence[dict[str, Any]]) -> _Panel:
    return {
        "foxglovePanelTitle": title,
        "paths": list(lines),
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        # At the top the legend takes its height off the curves.
        "legendDisplay": "left",
        "sidebarDimension": 150,  # its width [px]
        "isSynced": True,
        "xAxisVal": "timestamp",
    }


def _scene(moves: bool, turns: bool) -> _Panel:
    """Makes the 3D panel, around a vehicle that moves or beside one that turns."""
    size = 40 if moves else 4  # [m]
    grid = {
        "layerId": "foxglove.Grid",
        "instanceId": "grid",
        "label": "Grid",
        "visible": True,
        "frameLocked": True,
        "frameId": DISPLAY,
        "size": size,
        "divisions": size,
        "color": "#24824280",
        "order": 1,
    }
    camera = {
        "distance": 25 if moves else 3,  # [m]
        "perspective": True,
        "phi": 60,  # [deg]
        "thetaOffset": 45,
    }
    return {
        "foxglovePanelTitle": "plan and 2-sigma tube" if moves else "attitude",
        "followMode": "follow-position" if moves else "follow-none",
        "followTf": VEHICLE if moves else DISPLAY,
        "fixedFrame": DISPLAY,
        "cameraState": camera,
        "scene": {"transforms": {"showLabel": False}},
        # /pose shows where they are
        "transforms": {
            f"frame:{name}": {"visible": False} for name in (WORLD, VEHICLE)
        },
        "layers": {"grid": grid},
        "topics": {
            "/pose": _axes(scale=1.0),
            "/reference": _axes(scale=0.6),
            # of a vehicle that moves, the tube shows where it goes
            "/plan/path": _axes(scale=0.25) | {"visible": turns},
            "/plan/tube": {"visible": moves},
        },
    }


def _axes(scale: float) -> dict[str, Any]:
    return {"visible": True, "type": "axis", "axisScale": scale}


def _split(
    direction: str, first: Any, second: Any, percentage: float
) -> dict[str, Any]:
    return {
        "direction": direction,
        "first": first,
        "second": second,
        "splitPercentage": percentage,
    }


def _below_each_other(ids: Sequence[str]) -> Any:
    """Puts panels one below the other, of equal height."""
    if len(ids) == 1:
        return ids[0]
    below = _below_each_other(ids[1:])
    return _split("column", ids[0], below, round(100 / len(ids), 2))
