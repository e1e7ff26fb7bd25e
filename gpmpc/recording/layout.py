"""Makes a layout for Foxglove that fits a recording.

A layout names message paths, so it is made from the names of the states and inputs that a recording holds. Its format
is the one that Foxglove and its open fork Lichtblick (github.com/lichtblick-suite/lichtblick) export and import: a
configuration by panel id (``Plot!...``, ``3D!...``; the type before the exclamation mark) and a tree of splits. Fields
that one of them does not know are ignored: lines are dashed in Foxglove alone. Three things are easily got wrong: a
panel's title is ``foxglovePanelTitle``; a legend at the top takes its size, 240 pixels, off the curves; and an index in
the path of a plot has to count from the front (from the end, Lichtblick draws nothing).
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpmpc.recording._messages import PLAN, STEP, TIMING
from gpmpc.recording._scene import ATTITUDE, DISPLAY, POSITION, VEHICLE
from gpmpc.recording.reader import Run

GREY, BLUE, ORANGE, RED = "#7f7f7f", "#1f77b4", "#ff7f0e", "#d62728"
COLOURS = (BLUE, "#2ca02c", ORANGE, "#9467bd", "#8c564b", "#17becf")
Panels = dict[str, dict[str, Any]]


def layout(run: Run) -> str:
    """The layout for a recording, as JSON.

    Plots in tabs (positions, attitude, other states, inputs with their bounds, uncertainty, solver) beside the vehicle
    in space, where the states tell where it is or how it is turned, and the log of failures.
    """
    groups, tabs = _groups(run.state_names), _tabs(run)
    panels = {id: config for tab in tabs.values() for id, config in tab.items()}
    panels["Tab!plots"] = {
        "activeTabIdx": 0,
        "tabs": [{"title": title, "layout": _column(list(tab))} for title, tab in tabs.items()],
    }
    panels["RosOut!log"] = {"searchTerms": [], "minLogLevel": 1, "topicToRender": "/log"}
    left, share = "RosOut!log", 25
    if "/pose" in run.channels:
        panels["3D!scene"] = _scene(
            run.metadata.get("frames", {}).get("positions", "world"), "Position" in groups, "Attitude" in groups
        )
        left, share = _split("column", "3D!scene", left, 78), 50
    whole = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", left, "Tab!plots", share),
    }
    return json.dumps(whole, indent=1) + "\n"


def _groups(states: Sequence[str]) -> dict[str, list[str]]:
    """The states by what they are."""
    groups = {"Position": [n for n in POSITION if n in states], "Attitude": [n for n in ATTITUDE if n in states]}
    tracked = [*groups["Position"], *groups["Attitude"]]
    groups["Rates" if tracked else "States"] = [name for name in states if name not in tracked]
    return {title: names for title, names in groups.items() if names}


def _tabs(run: Run) -> dict[str, Panels]:
    """The panels with plots, from top to bottom, by the title of their tab."""
    units, groups = run.metadata.get("units", {}), _groups(run.state_names)
    tabs = {title: {f"Plot!state-{n}": _tracking(n, units) for n in names} for title, names in groups.items()}
    bounded = zip(run.input_names, np.isfinite(run.input_bounds).T, strict=True)
    tabs["Inputs"] = {f"Plot!input-{name}": _input(name, units, bool(finite.any())) for name, finite in bounded}
    tabs["Uncertainty"] = {}
    for title, names in list(groups.items())[:2]:
        unit = _unit(units, *(f"state.{name}" for name in names))
        for id, path, what in (
            ("expected", f"{PLAN}.stages[1].std", "standard deviation expected one step ahead"),
            ("innovation", f"{STEP}.innovation", "measured minus expected"),
        ):
            lines = [_line(f"{path}.{n}", n, COLOURS[i % len(COLOURS)]) for i, n in enumerate(names)]
            tabs["Uncertainty"][f"Plot!{id}-{title.lower()}"] = _plot(f"{title}: {what}{unit}", lines)
    tabs["Solver"] = {"Plot!timing": _timing(), "Plot!iterations": _iterations(), "StateTransitions!status": _status()}
    return tabs


def _unit(units: Mapping[str, str], *fields: str) -> str:
    """Of the fields, in brackets; nothing where they have none, or several."""
    found = {units.get(field, "?") for field in fields}
    return f" [{found.pop()}]" if len(found) == 1 and not found & {"1", "?"} else ""


def _line(path: str, label: str, colour: str, **more: Any) -> dict[str, Any]:
    """A series of a plot."""
    line = {"value": path, "label": label, "color": colour, "enabled": True, "showLine": True}
    return line | {"timestampMethod": "receiveTime"} | more


def _plot(title: str, lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "paths": list(lines),
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "left",  # at the top it takes its height off the curves
        "sidebarDimension": 190,  # width of the legend [px]
        "showPlotValuesInLegend": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
    }


def _tracking(name: str, units: Mapping[str, str]) -> dict[str, Any]:
    lines = [
        _line(f"{STEP}.measured.{name}", "measured", ORANGE),
        _line(f"{STEP}.state.{name}", "state", BLUE),
        _line(f"{STEP}.reference.{name}", "reference", GREY, lineStyle="dashed"),
    ]
    return _plot(name + _unit(units, f"state.{name}"), lines)


def _input(name: str, units: Mapping[str, str], has_bounds: bool) -> dict[str, Any]:
    lines = [_line(f"{STEP}.input.{name}", "applied", BLUE, lineInterpolation="step")]
    for side in ("lower", "upper") if has_bounds else ():
        lines.append(_line(f"{STEP}.input_{side}.{name}", f"{side} bound", RED, lineStyle="dashed"))
    return _plot(name + _unit(units, f"input.{name}"), lines)


def _timing() -> dict[str, Any]:
    lines = [_line(f"{STEP}.timing.{name}", name, colour) for name, colour in zip(TIMING, COLOURS, strict=False)]
    return _plot("decision [s]", lines)


def _iterations() -> dict[str, Any]:
    names = {"iterations": "iterations", "active_set_size": "active constraints", "gp_size": "GP points"}
    lines = zip(names.items(), COLOURS, strict=False)
    return _plot("solver and model", [_line(f"{STEP}.{field}", label, colour) for (field, label), colour in lines])


def _status() -> dict[str, Any]:
    paths = [
        {"value": f"{STEP}.{field}", "label": field, "enabled": True, "timestampMethod": "receiveTime"}
        for field in ("status", "failed")
    ]
    return {"foxglovePanelTitle": "how the solves ended", "isSynced": True, "paths": paths}


def _scene(frame: str, moves: bool, turns: bool) -> dict[str, Any]:
    """The 3D panel: around a vehicle that moves, or on the spot around one that only turns."""
    grid = {
        "layerId": "foxglove.Grid",
        "instanceId": "grid",
        "label": "Grid",
        "visible": True,
        "frameLocked": True,
        "frameId": DISPLAY,
        "size": 40 if moves else 4,  # [m]
        "divisions": 40 if moves else 4,
        "lineWidth": 1,
        "color": "#24824280",
        "position": [0, 0, 0],
        "rotation": [0, 0, 0],
        "order": 1,
    }
    camera = {
        "perspective": True,
        "distance": 25 if moves else 3,  # [m]
        "phi": 60,
        "thetaOffset": 45,
        "targetOffset": [0, 0, 0],
        "target": [0, 0, 0],
        "targetOrientation": [0, 0, 0, 1],
        "fovy": 45,
        "near": 0.05,
        "far": 1000,
    }
    hidden = {f"frame:{name}": {"visible": False} for name in (frame, VEHICLE)}  # /pose shows where it is
    return {
        "foxglovePanelTitle": "plan and 2-sigma tube" if moves else "attitude",
        "followMode": "follow-position" if moves else "follow-none",
        "followTf": VEHICLE if moves else DISPLAY,
        "fixedFrame": DISPLAY,
        "cameraState": camera,
        "scene": {"transforms": {"showLabel": False}},
        "transforms": hidden,
        "layers": {"grid": grid},
        "topics": {
            "/pose": {"visible": True, "type": "axis", "axisScale": 1.0},
            "/reference": {"visible": True, "type": "axis", "axisScale": 0.6},
            "/plan/path": {"visible": turns, "type": "axis", "axisScale": 0.25},  # where it goes, the tube shows
            "/plan/tube": {"visible": moves},
        },
    }


def _split(direction: str, first: Any, second: Any, percentage: float) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}


def _column(ids: Sequence[str]) -> Any:
    """Panels one below the other, of equal height."""
    if len(ids) == 1:
        return ids[0]
    return _split("column", ids[0], _column(ids[1:]), round(100 / len(ids), 2))
