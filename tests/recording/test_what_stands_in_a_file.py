"""A recording holds times, colours, descriptions and limits, and so does a copy."""

from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from gpmpc.exceptions import RecordingError, SettingError, ShapeError
from gpmpc.recording import (
    McapRecorder,
    RecordedSystem,
    _decoding,
    _recorder,
    _records,
    _schema,
    _sink,
    layout,
    read_run,
    recover,
)
from gpmpc.recording._content import read_content
from gpmpc.status import Status
from gpmpc.systems import rotational, translational
from tests.recording import runs


def records(path):
    """Everything in a file, as any reader finds it."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = [
            (c.topic, m.log_time, m.publish_time, m.sequence, m.data)
            for _, c, m in reader.iter_messages()
        ]
        channels = {
            c.topic: c.message_encoding for c in reader.get_summary().channels.values()
        }
        attachments = [
            (a.name, a.media_type, a.log_time, a.create_time, a.data)
            for a in reader.iter_attachments()
        ]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        return messages, channels, attachments, metadata, reader.get_header().profile


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    rng = np.random.default_rng(1)
    with runs.recorder(path) as recorder:
        recorder.record(runs.make_step(0, rng))
        recorder.record(runs.make_step(7, rng, status=Status.INFEASIBLE, failed=True))
    return path


def test_a_topic_more_is_read_from_every_file(path, monkeypatch):
    monkeypatch.setitem(_schema.TOPICS, "/new", "Step")
    assert read_content(path).messages["/new"] == []


def test_every_message_has_the_time_of_its_step(path):
    with path.open("rb") as file:
        found = list(
            make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        )
    assert {message.log_time for _, _, message, _ in found} == {0, 7 * 10**8}
    stamped = 0
    for _, _, message, proto in found:
        for held in (proto, *getattr(proto, "entities", ())):
            if "timestamp" in held.DESCRIPTOR.fields_by_name:
                assert (
                    held.timestamp.seconds * 10**9 + held.timestamp.nanos
                    == message.log_time
                )
                assert 0 <= held.timestamp.nanos < 10**9
                stamped += 1
    assert stamped == 13  # two of each of six topics of the scene, and a failure
    steps = [
        proto
        for _, channel, _, proto in found
        if channel.topic in ("/step", "/plan", "/qp")
    ]
    assert [proto.time for proto in steps] == pytest.approx([0.0] * 3 + [0.7] * 3)


def test_the_plan_has_the_states_colour_and_a_clear_tube(path):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        updates = [
            proto for *_, proto in reader.iter_decoded_messages(topics=["/plan/tube"])
        ]
    for [entity] in (update.entities for update in updates):
        assert (entity.id, entity.frame_id, len(entity.spheres)) == ("plan", "world", 6)
        [line] = entity.lines
        assert (line.thickness, line.scale_invariant) == (2.0, True)
        assert line.type == line.LINE_STRIP
        assert line.pose.orientation.w == 1
        for color, alpha in (
            (line.color, 0.9),
            *((sphere.color, 0.18) for sphere in entity.spheres),
        ):
            assert (color.r, color.g, color.b, color.a) == pytest.approx(
                (0, 0.45, 0.7, alpha), abs=1e-6
            )


def test_a_copy_holds_every_message_attachment_and_description(path, tmp_path):
    recover(path, tmp_path / "copy.mcap")
    assert records(tmp_path / "copy.mcap") == records(path)


def test_a_file_describes_itself(path):
    _, channels, [attachment], metadata, profile = records(path)
    assert attachment == ("config.yaml", "application/yaml", 0, 0, b'{\n  "seed": 7\n}')
    assert metadata["frames"] == {
        "positions": "world",
        "z axis": "down",
        "display": "z axis up",
    }
    assert metadata["pose"] == runs.POSE
    assert metadata["run"]["state_names"].split() == [*runs.STATES]
    assert metadata["run"]["input_names"].split() == [*runs.INPUTS]
    assert metadata["end"] == {"steps": "2", "outcome": "complete"}
    units = metadata["units"]
    assert {
        units[key] for key in ("time", "stages.time", "timing.model", "timing.total")
    } == {"s"}
    assert (units["stages.std.z"], units["input_upper.ux"], units["innovation.vy"]) == (
        "m",
        "1",
        "m/s",
    )
    assert {*channels.values()} == {"protobuf"}
    assert profile == "gpmpc"


def test_what_is_not_said_is_unknown_unbounded_or_empty(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    of_system = {"units": {}, "input_bounds": None, "pose": {}, "z_down": False}
    with runs.recorder(path, config="", metadata=None, **of_system) as recorder:
        for k in range(3):
            recorder.record(runs.make_step(k, rng))
        recorder.record(
            replace(
                runs.make_step(3, rng),
                decision=None,
                status=None,
                failed=True,
                gp_size=0,
            )
        )
    run = read_run(path)
    assert run.gp_sizes.tolist() == [100, 101, 102, 0]
    assert run.statuses == (*[Status.SOLVED] * 3, Status.INVALID_MEASUREMENT)
    assert run.input_bounds.tolist() == [[-np.inf] * 3, [np.inf] * 3]
    assert run.metadata["units"]["state.x"] == "?"
    assert run.metadata["frames"]["z axis"] == "up"
    assert (run.config, run.pose) == ("", {})
    assert "/pose" not in run.channels
    assert run.novelties[3] != run.novelties[3]  # NaN: nothing was planned


def test_steps_are_written_when_enough_wait_or_time_passed(tmp_path, monkeypatch):
    steps = [runs.make_step(k, np.random.default_rng(k), qp=False) for k in range(3)]
    clock = iter(np.arange(100.0))  # [s], one a look
    monkeypatch.setattr(_recorder.time, "perf_counter", lambda: 0.0)
    with runs.recorder(tmp_path / "waiting.mcap", chunk_size=10**9) as recorder:
        for step in steps:
            recorder.record(step)
        assert len(read_run(recorder.path).times) == 0
    assert len(read_run(recorder.path).times) == 3
    size = 8 * (
        5 * 6 + 3 + 36 - 6 + 6 * 6 + 5 * 3 + 6 * 36
    )  # of a step's numbers [bytes]
    for chunk_size, written in ((size - 1, [1, 2, 3]), (size, [0, 2, 2])):
        with runs.recorder(tmp_path / "sized.mcap", chunk_size=chunk_size) as recorder:
            found = []
            for step in steps:
                recorder.record(step)
                found.append(len(read_run(recorder.path).times))
            assert found == written
    monkeypatch.setattr(_recorder.time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(_recorder, "_LONGEST_WAIT", 1.5)
    with runs.recorder(tmp_path / "timed.mcap", chunk_size=10**9) as recorder:
        found = []
        for step in steps:
            recorder.record(step)
            found.append(len(read_run(recorder.path).times))
        assert found == [0, 2, 2]


def test_begin_and_end_of_a_file_are_flushed_to_the_disk(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    sizes = []
    monkeypatch.setattr(_sink.os, "fsync", lambda _: sizes.append(path.stat().st_size))
    with runs.recorder(path, chunk_size=1) as recorder:
        assert sizes == [path.stat().st_size]
        recorder.record(runs.make_step(0, np.random.default_rng(0), qp=False))
        assert len(sizes) == 1
    assert sizes[1:] == [path.stat().st_size]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"chunk_size": 0}, "chunk_size: must be a whole number, 1 or more"),
    ],
)
def test_numbers_out_of_range_are_refused(settings, message, tmp_path):
    with pytest.raises(SettingError, match=message):
        runs.recorder(tmp_path / "run.mcap", **settings)


def test_names_are_limited_different_and_known():
    def described(states=("x",), inputs=("u",), **more):
        return RecordedSystem(states, inputs, 0.1, **more)

    described([f"x{i}" for i in range(1000)])
    for states, message in (
        ([f"x{i}" for i in range(1001)], "must be 1 to 1000 names; got 1001"),
        ([], "must be 1 to 1000 names; got 0"),
        (["x", "y", "x"], "a name must be unique; got x, y, x"),
        (["x", 3], "letters, digits and _, a letter first; got 3"),
        (["_x"], "a letter first; got '_x'"),
    ):
        with pytest.raises(SettingError, match=message):
            described(states)
    for more, message in (
        ({"units": {"x": "m", "u": "N", "v": "m"}}, "units: must be of x, u; got v"),
        ({"pose": {"w": "x"}}, "pose: must be of x, y, z, roll, pitch, yaw; got w"),
        ({"pose": {"x": "u"}}, "pose: must be of x; got u"),
    ):
        with pytest.raises(SettingError, match=message):
            described(**more)
    with pytest.raises(
        ShapeError, match=r"input bounds must be \(2, 1\); got \(1, 2\)"
    ):
        described(input_bounds=[[0, 1]])
    assert described().z_down


@pytest.mark.parametrize("system", [translational(), rotational()])
def test_a_system_is_described_by_its_own_names_bounds_and_pose(system):
    own = RecordedSystem.of(system)
    other = RecordedSystem.of(system, [[-9.0] * 3, [9.0] * 3])
    assert (own.state_names, own.input_names) == (
        tuple(system.state_names),
        tuple(system.input_names),
    )
    assert (own.time_step, own.units, own.pose) == (
        system.time_step,
        system.units,
        system.pose,
    )
    assert own.z_down == system.z_down
    np.testing.assert_array_equal(
        own.input_bounds, [system.input_lower, system.input_upper]
    )
    assert other.input_bounds == [[-9.0] * 3, [9.0] * 3]


def test_a_layout_of_one_state_has_no_tab_for_what_is_not_there(tmp_path):
    path = tmp_path / "run.mcap"
    step = runs.make_step(0, np.random.default_rng(0))
    system = RecordedSystem(("x",), ("u",), 0.1)
    part = replace(
        step,
        reference=np.zeros(1),
        state=np.zeros(1),
        measured=np.zeros(1),
        input=np.zeros(1),
        decision=None,
        innovation=np.zeros(1),
        belief_covariance=np.eye(1),
        status=Status.SOLVED,
    )
    with McapRecorder(path, system) as recorder:
        recorder.record(part)
    text = layout(read_run(path))
    assert '"title": "States"' in text
    for title in ("Position", "Attitude", "Rates"):
        assert f'"title": "{title}"' not in text


def test_what_a_file_may_unfold_to_is_counted_to_the_byte(path, monkeypatch):
    assert _records.memory_limit(path) == 64 * 2**20 + 300 * path.stat().st_size
    with path.open("rb") as file:
        reader = make_reader(file)
        messages = len([*reader.iter_messages()])
        summary = reader.get_summary()
    room = sum(chunk.uncompressed_size for chunk in summary.chunk_indexes)
    monkeypatch.setattr(_records, "memory_limit", lambda _: room)
    assert len([*_records.whole_records(path)]) > messages
    monkeypatch.setattr(_records, "memory_limit", lambda _: room - 1)
    with pytest.raises(
        RecordingError, match=r"run\.mcap: its chunks unfold to more than 0 MB"
    ):
        list(_records.whole_records(path))
    rows, (H, n, m) = 2, (5, 6, 3)
    needed = 8 * rows * (H + 1) * (n + n * n + m)  # of means, covariances and inputs
    monkeypatch.undo()
    monkeypatch.setattr(_decoding, "memory_limit", lambda _: needed)
    assert read_run(path).plan_means.shape == (rows, H + 1, n)
    monkeypatch.setattr(_decoding, "memory_limit", lambda _: needed - 1)
    with pytest.raises(
        RecordingError,
        match="a plan of 5 stages would make arrays of 0 MB with the others",
    ):
        read_run(path)


def test_a_file_with_names_alone_is_a_run_without_steps(tmp_path):
    path = tmp_path / "bare.mcap"
    for about, message in (
        ({"state_names": "x y", "input_names": "u"}, None),
        ({"state_names": "x y"}, "is not the recording of a run"),
        (
            {"state_names": "x x", "input_names": "u"},
            "its metadata are damaged; state_names: a name must be unique",
        ),
    ):
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            writer.add_metadata("run", about)
            writer.finish()
        if message is None:
            run = read_run(path)
            assert (run.state_names, run.input_names, run.finished) == (
                ("x", "y"),
                ("u",),
                True,
            )
            assert (run.states.shape, run.plan_means.shape, run.residuals.shape) == (
                (0, 2),
                (0, 1, 2),
                (0, 3),
            )
        else:
            with pytest.raises(RecordingError, match=message):
                read_run(path)
