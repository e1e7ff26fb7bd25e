"""A layout for Foxglove shows what the recording holds, whatever was flown."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from gpmpc.mpc import Decision, Timing
from gpmpc.recording import McapRecorder, RecordedSystem, Step, layout, read_run
from gpmpc.status import Status
from gpmpc.systems import coupled, pendulum, rotational, translational
from tests.recording import runs

SHIPPED = Path(__file__).resolve().parents[2] / "docs" / "foxglove-layout.json"
FLOWN = {
    "translational": translational(),
    "rotational": rotational(),
    "whole": coupled(),
    "pendulum": pendulum(),
}


def record(path, states, inputs, steps=3, **settings):
    n = len(states)
    m = len(inputs)
    H = 2
    rng = np.random.default_rng(0)
    with McapRecorder(
        path, RecordedSystem(states, inputs, time_step=0.1, **settings)
    ) as recorder:
        for k in range(steps):
            means = rng.standard_normal((H + 1, n))
            covariances = np.tile(np.eye(n), (H + 1, 1, 1))
            decision = Decision(
                input=np.zeros(m),
                inputs=np.zeros((H, m)),
                means=means,
                covariances=covariances,
                status=Status.SOLVED,
                iterations=1,
                timing=Timing(0.001, 0.002, 0.003),
            )
            x = means[0]
            recorder.record(
                Step(0.1 * k, k, x, x, x, np.zeros(m), decision, np.zeros(n), np.eye(n))
            )
    return path


@pytest.fixture(scope="module", params=FLOWN)
def shown(request, tmp_path_factory):
    """What was flown, its recording and its layout."""
    system = FLOWN[request.param]
    states = system.state_names
    inputs = system.input_names
    bounds = np.array([-np.ones(len(inputs)), np.ones(len(inputs))])
    path = record(
        tmp_path_factory.mktemp("run") / "run.mcap",
        states,
        inputs,
        input_bounds=bounds,
        pose=system.pose,
    )
    return request.param, path, json.loads(layout(read_run(path)))


def paths_of(config):
    return [
        line["value"]
        for panel in config["configById"].values()
        for line in panel.get("paths", ())
    ]


def at(message, path):
    """Returns the value at a path, with names and indices as in Lichtblick's paths."""
    for name, index in re.findall(r"\.(\w+)(?:\[(\d+)\])?", path):
        assert name in message.DESCRIPTOR.fields_by_name, path
        message = getattr(message, name)
        message = message[int(index)] if index else message
    return message


def test_every_path_is_a_field_of_the_recording(shown):
    _, path, config = shown
    with path.open("rb") as file:
        decoded = make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages()
        last = {channel.topic: message for _, channel, _, message in decoded}
    for value in paths_of(config):
        topic, fields = re.fullmatch(r"(/\w+)((?:\.\w+(?:\[\d+\])?)+)", value).groups()
        kind = str if value == "/step.judgement" else int | float
        assert isinstance(at(last[topic], fields), kind), value


def test_every_state_and_every_input_with_its_bounds_is_plotted(shown):
    flown, _, config = shown
    states = FLOWN[flown].state_names
    inputs = FLOWN[flown].input_names
    groups = [(group, states) for group in ("reference", "state", "measured")]
    groups += [(group, inputs) for group in ("input", "input_lower", "input_upper")]
    assert {
        f"/step.{group}.{name}" for group, names in groups for name in names
    } <= set(paths_of(config))


def test_every_panel_has_its_place_and_every_place_its_panel(shown):
    _, _, config = shown

    def leaves(node):
        if isinstance(node, str):
            return [node]
        return [*leaves(node["first"]), *leaves(node["second"])]

    placed = leaves(config["layout"])
    tabs = config["configById"]["Tab!plots"]["tabs"]
    placed += [leaf for tab in tabs for leaf in leaves(tab["layout"])]
    assert sorted(placed) == sorted(config["configById"])


def test_the_vehicle_is_seen_where_states_tell_about_it(shown):
    flown, path, config = shown
    scene = config["configById"].get("3D!scene")
    assert (scene is None) == (flown == "pendulum")
    if scene is not None:
        assert set(scene["topics"]) <= set(read_run(path).channels)
        assert scene["topics"]["/plan/tube"]["visible"] == (flown != "rotational")
        assert scene["topics"]["/plan/path"]["visible"] == (flown != "translational")
        assert scene["followTf"] == ("display" if flown == "rotational" else "vehicle")
        assert scene["followMode"] == (
            "follow-none" if flown == "rotational" else "follow-position"
        )
        assert scene["foxglovePanelTitle"] == (
            "attitude" if flown == "rotational" else "plan and 2-sigma tube"
        )
        grid = scene["layers"]["grid"]
        assert grid["size"] == grid["divisions"] == (4 if flown == "rotational" else 40)
        assert scene["cameraState"]["distance"] == (3 if flown == "rotational" else 25)
        assert (
            config["layout"]["splitPercentage"],
            config["layout"]["first"]["splitPercentage"],
        ) == (50, 78)
    else:
        assert config["layout"] == {
            "direction": "row",
            "first": "RosOut!log",
            "second": "Tab!plots",
            "splitPercentage": 25,
        }


def test_the_shipped_layout_is_of_the_translational_quadrotor(tmp_path):
    runs.record_run(tmp_path / "run.mcap", steps=2)
    assert SHIPPED.read_text() == layout(read_run(tmp_path / "run.mcap"))


def test_units_and_bounds_are_shown_where_there_are_any(tmp_path):
    path = record(
        tmp_path / "run.mcap",
        ("x", "vx"),
        ("F",),
        units={"x": "m", "vx": "m/s", "F": "1"},
    )
    panels = json.loads(layout(read_run(path)))["configById"]
    assert panels["Plot!state-vx"]["foxglovePanelTitle"] == "vx [m/s]"
    assert panels["Plot!input-F"]["foxglovePanelTitle"] == "F"
    assert len(panels["Plot!input-F"]["paths"]) == 1


def test_states_stand_below_each_other_in_tabs_by_what_they_are(shown):
    flown, _, config = shown
    tabs = {
        tab["title"]: tab["layout"] for tab in config["configById"]["Tab!plots"]["tabs"]
    }
    grouped = {
        "translational": ["Position", "Rates"],
        "rotational": ["Attitude", "Rates"],
        "whole": ["Position", "Attitude", "Rates"],
        "pendulum": ["States"],
    }[flown]
    assert [*tabs] == [*grouped, "Inputs", "Uncertainty", "Solver"]
    uncertain = [
        panel
        for panel in config["configById"]
        if re.match("Plot!(expected|innovation)-", panel)
    ]
    kinds = [
        f"Plot!{kind}-{title.lower()}"
        for title in grouped[:2]
        for kind in ("expected", "innovation")
    ]
    assert uncertain == kinds
    first = tabs["Solver"]["first"]
    lower = tabs["Solver"]["second"]
    shares = []
    for node in (tabs["Solver"], lower):
        assert node["direction"] == "column"
        shares.append(node["splitPercentage"])
    assert (first, shares, lower["first"]) == (
        "Plot!timing",
        [33.33, 50.0],
        "Plot!iterations",
    )
    dashed = {
        line["value"].split(".")[1]
        for panel in config["configById"].values()
        for line in panel.get("paths", ())
        if line.get("lineStyle") == "dashed"
    }
    assert dashed == {"reference", "input_lower", "input_upper"}
