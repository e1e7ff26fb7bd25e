"""A recording holds what happened, others read it, and a failed one says so."""

import contextlib
import gc
import json
import multiprocessing
import os
import re
import resource
import signal
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from gpmpc.exceptions import RecordingError, SettingError, ShapeError
from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.recording import RecordedSystem, _recorder, read_run, replay
from gpmpc.status import Status
from tests.cli.command import called
from tests.recording import runs


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    return path, runs.record_run(path, steps=30)


def decoded(path, topic):
    with path.open("rb") as file:
        messages = make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages(topics=[topic])
        return [(message, proto) for _, _, message, proto in messages]


def test_every_number_comes_back_as_it_was(recorded):
    path, steps = recorded
    run = read_run(path)
    assert run.finished
    for name, group in {
        "states": "state",
        "references": "reference",
        "measured": "measured",
        "inputs": "input",
    }.items():
        np.testing.assert_array_equal(
            getattr(run, name), [getattr(step, group) for step in steps]
        )
    np.testing.assert_array_equal(run.innovations, [step.innovation for step in steps])
    np.testing.assert_array_equal(
        run.belief_covariances, [step.belief_covariance for step in steps]
    )
    np.testing.assert_array_equal(
        run.plan_means, [step.decision.means for step in steps]
    )
    np.testing.assert_array_equal(
        run.plan_covariances, [step.decision.covariances for step in steps]
    )
    np.testing.assert_array_equal(
        run.plan_inputs, [step.decision.inputs for step in steps]
    )
    np.testing.assert_allclose(
        run.plan_stds**2,
        np.diagonal(run.plan_covariances, axis1=2, axis2=3),
        rtol=1e-14,
    )
    assert run.times.tolist() == [step.time for step in steps]
    assert run.steps.tolist() == list(range(30))
    assert run.iterations.tolist() == [step.decision.iterations for step in steps]
    assert run.gp_sizes.tolist() == [step.gp_size for step in steps]
    assert run.gp_versions.tolist() == [step.gp_version for step in steps]
    np.testing.assert_allclose(
        run.timings, np.tile([0.001, 0.002, 0.003, 0.006], (30, 1))
    )


def test_the_quality_of_every_solution_is_recorded(recorded):
    path, steps = recorded
    run = read_run(path)
    for k, step in enumerate(steps):
        solution = step.decision.solution
        residuals = solution.residuals()
        np.testing.assert_allclose(run.residuals[k], residuals, atol=1e-15)
        assert run.active_set_sizes[k] == np.count_nonzero(solution.active_set)


@pytest.mark.parametrize("rows", [0, 1, 8])
def test_the_whole_active_set_is_recorded(tmp_path, rows):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    step = runs.make_step(0, rng)
    G = rng.standard_normal((rows, 6))
    wide = np.full(rows, 100.0)
    program = QuadraticProgram(
        np.eye(6), np.full(6, 9.0), G, -wide, wide, -np.ones(6), np.ones(6)
    )
    solution = DualActiveSet().solve(program)
    assert np.count_nonzero(solution.active_set) == 6  # the whole box
    with runs.recorder(path) as recorder:
        recorder.record(
            replace(
                step,
                decision=replace(step.decision, problem=program, solution=solution),
            )
        )
    run = read_run(path)
    assert run.active_set_sizes.tolist() == [6]
    np.testing.assert_allclose(run.residuals[0], solution.residuals(), atol=1e-15)
    np.testing.assert_array_equal(run.problems[0].multipliers, solution.multipliers)
    np.testing.assert_array_equal(run.problems[0].x, solution.x)


def test_a_program_without_solution_is_recorded(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    step = runs.make_step(0, rng)
    program = step.decision.problem
    with runs.recorder(path) as recorder:
        recorder.record(replace(step, decision=replace(step.decision, solution=None)))
    run = read_run(path)
    recorded = run.problems[0]
    for name in ("P", "q", "G"):
        np.testing.assert_array_equal(getattr(recorded, name), getattr(program, name))
    np.testing.assert_array_equal(recorded.lower, program.lower)
    np.testing.assert_array_equal(recorded.upper, program.upper)
    assert (len(recorded.x), len(recorded.multipliers), run.active_set_sizes[0]) == (
        0,
        0,
        0,
    )
    assert np.isnan(run.residuals).all()
    np.testing.assert_allclose(
        replay(run, 0).x, step.decision.solution.x, rtol=0, atol=1e-9
    )


def test_a_replayed_step_gives_the_same_answer(recorded):
    path, steps = recorded
    run = read_run(path)
    for k, step in enumerate(steps):
        again = replay(run, k)
        assert again.status.solved
        np.testing.assert_allclose(again.x, step.decision.solution.x, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(run.problems[k].x, step.decision.solution.x)


def test_soft_rows_are_replayed_soft(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "soft.mcap"
    prices = np.where(np.arange(8) % 2, 0.05, np.inf)
    step = runs.make_step(0, rng, prices=prices)
    with runs.recorder(path) as recorder:
        recorder.record(step)
    run = read_run(path)
    solution = step.decision.solution
    np.testing.assert_allclose(replay(run, 0).x, solution.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.residuals[0], solution.residuals(), atol=1e-15)
    hard = solution._replace(caps=np.full_like(solution.caps, np.inf))
    assert max(solution.residuals()) < 1e-6 < max(hard.residuals())


def test_a_run_without_problems_has_none_to_replay_and_to_judge(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    steps = [runs.make_step(0, rng), runs.make_step(1, rng, qp=False)]
    with runs.recorder(path, record_problems=False) as recorder:
        for step in steps:
            recorder.record(step)
    run = read_run(path)
    assert np.isnan(run.residuals).all()
    assert run.active_set_sizes.tolist() == [
        np.count_nonzero(steps[0].decision.solution.active_set),
        0,
    ]
    with pytest.raises(RecordingError, match="holds no quadratic program of step 0"):
        replay(run, 0)


def test_the_file_says_first_where_it_comes_from(recorded):
    path, _ = recorded
    run = read_run(path)
    about = run.metadata["run"]
    for key in (
        "seed",
        "command",
        "host",
        "python",
        "versions.numpy",
        "created",
        "machine.system",
    ):
        assert about[key]
    assert run.metadata["units"]["state.vx"] == "m/s"
    assert run.metadata["units"]["stages.input.U1"] == "N"
    assert run.metadata["frames"]["positions"] == "world"
    assert run.metadata["end"] == {"steps": "30", "outcome": "complete"}
    assert json.loads(run.config) == {"seed": 7}
    with path.open("rb") as file:
        reader = make_reader(file)
        first_chunk = min(
            index.chunk_start_offset for index in reader.get_summary().chunk_indexes
        )
        early = [
            index
            for index in reader.get_summary().metadata_indexes
            if index.offset < first_chunk
        ]
        assert [index.name for index in early] == ["run", "units", "frames", "pose"]
        assert all(
            index.offset < first_chunk
            for index in reader.get_summary().attachment_indexes
        )


def test_chunks_are_small_compressed_and_indexed(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    step = runs.make_step(0, rng, variables=100)  # 90 kB
    with runs.recorder(path, chunk_size=256 * 1024) as recorder:
        for k in range(10):
            recorder.record(replace(step, k=k, time=0.1 * k))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        chunks = reader.get_summary().chunk_indexes
        assert len(chunks) == 4
        assert {chunk.compression for chunk in chunks} == {"zstd"}
        assert max(chunk.uncompressed_size for chunk in chunks) < 2 * 256 * 1024
        assert reader.get_summary().statistics.message_count == len(
            list(reader.iter_messages())
        )


def test_any_reader_finds_a_field_by_the_plants_names(recorded):
    path, steps = recorded
    for (message, proto), step in zip(decoded(path, "/step"), steps, strict=True):
        assert message.log_time == round(step.time * 1e9)
        assert proto.k == step.k
        assert proto.DESCRIPTOR.full_name == "gpmpc.Step"
        assert proto.state.vx == step.state[1]
        assert step.input[0] == proto.input.U1
        assert proto.input_upper.U1 == 10.0
        assert list(proto.belief_covariance) == step.belief_covariance.ravel().tolist()
    for (_, proto), step in zip(decoded(path, "/plan"), steps, strict=True):
        assert proto.stages[2].mean.z == step.decision.means[2, 4]
        assert proto.stages[2].time == pytest.approx(step.time + 0.2)
    for (_, proto), step in zip(decoded(path, "/qp"), steps, strict=True):
        assert list(proto.P) == step.decision.problem.P.ravel().tolist()


def test_the_tube_is_the_two_sigma_ellipsoid(recorded):
    path, steps = recorded
    updates = decoded(path, "/plan/tube")
    assert len(updates) == len(steps)
    for (_, update), step in zip(updates, steps, strict=True):
        for i, sphere in enumerate(update.entities[0].spheres):
            q = sphere.pose.orientation
            v = np.array([q.x, q.y, q.z])
            cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
            R = np.eye(3) + 2 * q.w * cross + 2 * cross @ cross
            radii = np.array([sphere.size.x, sphere.size.y, sphere.size.z]) / 2
            covariance = step.decision.covariances[i][np.ix_([0, 2, 4], [0, 2, 4])]
            np.testing.assert_allclose(
                R @ np.diag((radii / 2) ** 2) @ R.T, covariance, atol=1e-12
            )
            assert sphere.pose.position.z == step.decision.means[i, 4]


def test_pictures_are_drawn_no_more_than_thirty_times_a_second(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    step = runs.make_step(0, rng)
    with runs.recorder(path, time_step=0.001) as recorder:
        for k in range(1000):
            recorder.record(replace(step, k=k, time=k * 0.001))
    assert read_run(path).channels["/step"][0] == 1000
    assert 29 <= read_run(path).channels["/pose"][0] <= 31


def test_failures_are_logged_with_advice(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    with runs.recorder(path) as recorder:
        recorder.record(runs.make_step(0, rng))
        recorder.record(runs.make_step(1, rng, status=Status.INFEASIBLE, failed=True))
    [(_, entry)] = decoded(path, "/log")
    assert entry.message.startswith(
        "step 1: INFEASIBLE: no point satisfies the constraints"
    )
    assert entry.message.endswith("the policy for failures chose the input")
    run = read_run(path)
    assert run.statuses == (Status.SOLVED, Status.INFEASIBLE)
    assert run.failed.tolist() == [False, True]


def test_a_run_that_ends_in_an_error_is_recorded_up_to_there(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)

    def run_into_trouble():
        with runs.recorder(path) as recorder:
            recorder.record(runs.make_step(0, rng))
            raise ZeroDivisionError("too bad")

    with pytest.raises(ZeroDivisionError):
        run_into_trouble()
    run = read_run(path)
    assert len(run.times) == 1
    assert run.metadata["end"]["outcome"] == "ZeroDivisionError: too bad"
    # the file is whole, and the flight was not
    assert run.finished
    assert run.ended_by == "ZeroDivisionError: too bad"
    told = called("log", "info", path.name, cwd=tmp_path, COLUMNS="160")
    assert "the flight ended early: ZeroDivisionError: too bad" in told.stdout


def test_a_recorded_step_is_a_copy(tmp_path):
    path = tmp_path / "run.mcap"
    step = runs.make_step(0, np.random.default_rng(0))
    expected = step.state.copy()
    with runs.recorder(path) as recorder:
        recorder.record(step)
        step.state[:] = 7
    np.testing.assert_array_equal(read_run(path).states[0], expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"state": np.zeros(5)}, r"step 0: state must be \(6,\); got \(5,\)"),
        (
            {"belief_covariance": np.zeros(6)},
            r"belief_covariance must be \(6, 6\); got \(6,\)",
        ),
    ],
)
def test_a_step_of_the_wrong_shape_is_refused(tmp_path, change, message):
    with runs.recorder(tmp_path / "run.mcap") as recorder:
        step = runs.make_step(0, np.random.default_rng(0))
        with pytest.raises(ShapeError, match=message):
            recorder.record(replace(step, **change))
        recorder.record(step)
    assert len(read_run(tmp_path / "run.mcap").times) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": np.nan}, r"step.time: must be a number, 0 or more \[s\]; got nan"),
        ({"time": -0.1}, "step.time: must be a number, 0 or more"),
        ({"time": 5e9}, "step.time: must be below 4294967296"),
        ({"k": 3}, "step.k: must be above 3: one recorder takes one flight; got 3"),
    ],
)
def test_a_step_that_cannot_follow_is_refused_at_once(tmp_path, change, message):
    path = tmp_path / "run.mcap"
    steps = [runs.make_step(k, np.random.default_rng(k)) for k in (3, 4)]
    with runs.recorder(path) as recorder:
        recorder.record(steps[0])
        with pytest.raises(SettingError, match=message):
            recorder.record(replace(steps[1], **change))
        recorder.record(steps[1])
    assert read_run(path).steps.tolist() == [3, 4]


def test_a_recorder_that_fails_to_open_leaves_the_file_alone(tmp_path, monkeypatch):
    def full(name, context):
        raise RuntimeError("no port is left")

    monkeypatch.setattr(_recorder, "_start_server", full)
    with pytest.raises(RuntimeError, match="no port is left") as caught:
        runs.recorder(tmp_path / "run.mcap", live=True)
    assert caught.value.__traceback__ is not None  # which still holds the recorder
    runs.recorder(tmp_path / "run.mcap").close()


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"units": {"w": "m"}}, SettingError, "units: must be of x, vx"),
        ({"time_step": 0}, SettingError, "time_step: must be a number above 0"),
        (
            {"input_bounds": [1, 2, 3]},
            ShapeError,
            r"input bounds must be \(2, 3\); got \(3,\)",
        ),
    ],
)
def test_misuse_is_refused_before_a_file_is_made(tmp_path, settings, error, message):
    with pytest.raises(error, match=message):
        runs.recorder(tmp_path / "run.mcap", **settings)
    assert not list(tmp_path.iterdir())


def test_a_name_that_cannot_be_a_field_is_refused():
    with pytest.raises(
        SettingError,
        match="letters, digits and _, a letter first; got 'vertical speed'",
    ):
        RecordedSystem(["vertical speed"], ["u"], time_step=1.0)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_named(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(RecordingError, match="cannot be written: Permission denied"):
        runs.recorder(tmp_path / "run.mcap")


def test_a_path_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "taken").write_text("a file, not a folder")
    with pytest.raises(RecordingError, match=r"taken/run\.mcap: cannot be written: "):
        runs.recorder(tmp_path / "taken" / "run.mcap")
    with pytest.raises(RecordingError, match="cannot be written: Is a directory"):
        runs.recorder(tmp_path)


def test_two_recorders_do_not_share_a_file(tmp_path):
    message = "another process is recording to this file"
    with (
        runs.recorder(tmp_path / "run.mcap"),
        pytest.raises(RecordingError, match=message),
    ):
        runs.recorder(tmp_path / "run.mcap")


@contextlib.contextmanager
def disk_of(room):
    """No file grows past that many bytes."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


@pytest.mark.parametrize("room", [20_000, 200_000])
def test_a_full_disk_leaves_no_file_that_looks_finished(tmp_path, room):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    steps = [runs.make_step(k, rng, qp=k > 0) for k in range(20)]

    def record_too_much():
        with runs.recorder(path) as recorder, disk_of(room):
            for k, step in enumerate(20 * steps):
                recorder.record(replace(step, k=k))

    with pytest.raises(RecordingError) as caught:
        record_too_much()
    assert (
        str(caught.value)
        == f"{path}: the recording stopped and is unfinished: File too large"
    )
    assert path.stat().st_size <= room
    run = read_run(path)
    assert not run.finished
    assert run.config
    assert (len(run.times) > 0) == (room > 50_000)


def test_a_disk_full_at_the_index_leaves_no_footer(tmp_path):
    whole = tmp_path / "whole.mcap"
    runs.record_run(whole, steps=20)
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    recorder = runs.recorder(path)
    room = whole.stat().st_size - 300  # the last chunk fits, the index does not
    with disk_of(room):
        for k in range(20):
            recorder.record(runs.make_step(k, rng))
        for _ in range(2):
            with pytest.raises(RecordingError, match="unfinished: File too large"):
                recorder.close()
    run = read_run(path)
    assert not run.finished
    assert len(run.times) == 20


def test_a_disk_full_from_the_start_is_reported_at_once(tmp_path):
    path = tmp_path / "run.mcap"
    with (
        pytest.raises(RecordingError, match="unfinished: File too large"),
        disk_of(100),
    ):
        runs.recorder(path)
    with pytest.raises(RecordingError, match="is not the recording of a run"):
        read_run(path)


def test_a_step_that_no_chunk_can_take_is_refused(tmp_path):
    step = runs.make_step(0, np.random.default_rng(0))
    program = step.decision.problem
    rows = 200_000
    large = QuadraticProgram(
        program.P, program.q, np.ones((rows, 6)), np.zeros(rows), np.ones(rows)
    )
    decision = replace(step.decision, problem=large, solution=None)
    with runs.recorder(tmp_path / "run.mcap") as recorder:
        with pytest.raises(RecordingError, match="is too large; at most 8388608"):
            recorder.record(replace(step, decision=decision))
        recorder.record(step)
    assert len(read_run(tmp_path / "run.mcap").times) == 1


def test_the_largest_allowed_step_is_written_and_no_larger(tmp_path, monkeypatch):
    step = runs.make_step(0, np.random.default_rng(0))
    with runs.recorder(tmp_path / "run.mcap") as recorder:
        monkeypatch.setattr(_recorder, "LARGEST", 0)
        with pytest.raises(RecordingError) as caught:
            recorder.record(step)
        size = int(re.search(r"a step of (\d+) bytes", str(caught.value))[1])
        monkeypatch.setattr(_recorder, "LARGEST", 4 * size - 1)
        with pytest.raises(RecordingError, match="is too large"):
            recorder.record(step)
        monkeypatch.setattr(_recorder, "LARGEST", 4 * size)
        recorder.record(step)
    assert len(read_run(tmp_path / "run.mcap").times) == 1


def test_after_an_error_every_further_step_says_so(tmp_path):
    recorder = runs.recorder(tmp_path / "run.mcap")
    step = runs.make_step(0, np.random.default_rng(0), variables=200)
    with (
        disk_of(10_000),
        pytest.raises(RecordingError, match="unfinished: File too large"),
    ):
        recorder.record(step)
    with pytest.raises(RecordingError, match="unfinished: File too large"):
        recorder.record(step)
    assert not read_run(tmp_path / "run.mcap").finished


def test_a_dropped_recorder_leaves_an_unfinished_file(tmp_path):
    recorder = runs.recorder(tmp_path / "run.mcap")
    rng = np.random.default_rng(0)
    for k in range(200):
        recorder.record(runs.make_step(k, rng))
    del recorder
    gc.collect()
    run = read_run(tmp_path / "run.mcap")
    assert not run.finished
    assert len(run.times) > 100


def test_a_step_whose_controller_was_not_called_has_no_plan(tmp_path):
    rng = np.random.default_rng(0)
    step = runs.make_step(0, rng)
    with runs.recorder(tmp_path / "run.mcap") as recorder:
        recorder.record(step)
        recorder.record(
            replace(
                step, k=1, decision=None, status=Status.INVALID_MEASUREMENT, failed=True
            )
        )
    run = read_run(tmp_path / "run.mcap")
    assert run.statuses == (Status.SOLVED, Status.INVALID_MEASUREMENT)
    assert np.isnan(run.plan_means[1]).all()
    assert run.timings[1].tolist() == [0, 0, 0, 0]
    assert list(run.problems) == [0]


def test_a_closed_recorder_takes_no_more(tmp_path):
    recorder = runs.recorder(tmp_path / "run.mcap")
    recorder.close()
    recorder.close()
    with pytest.raises(RecordingError, match="the recording is closed"):
        recorder.record(runs.make_step(0, np.random.default_rng(0)))


def _record_many(folder, name):
    for i in range(3):
        runs.record_run(folder / "tree" / str(i) / f"{name}.mcap", steps=20)


def test_two_processes_recording_into_one_tree_lose_nothing(tmp_path):
    context = multiprocessing.get_context("fork")
    processes = [
        context.Process(target=_record_many, args=(tmp_path, name))
        for name in ("a", "b")
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    files = sorted(tmp_path.rglob("*.mcap"))
    assert len(files) == 6
    assert all(
        read_run(file).finished and len(read_run(file).times) == 20 for file in files
    )


def record_four(recorder):
    rng = np.random.default_rng(0)
    with recorder:
        for k in range(4):
            recorder.record(runs.make_step(k, rng))


def test_an_interrupted_chunk_is_written_once(tmp_path):
    path = tmp_path / "run.mcap"
    recorder = runs.recorder(path, chunk_size=10**6)
    encode = recorder._encoder.encode

    def interrupted(copy):
        if copy.step.k == 2:
            signal.raise_signal(signal.SIGINT)
        return encode(copy)

    recorder._encoder.encode = interrupted
    with pytest.raises(KeyboardInterrupt):
        record_four(recorder)
    run = read_run(path)
    assert run.steps.tolist() == [0, 1, 2, 3]
    assert run.finished


def test_a_step_that_cannot_be_encoded_fails_once(tmp_path):
    path = tmp_path / "run.mcap"
    recorder = runs.recorder(path, chunk_size=10**6)
    encode = recorder._encoder.encode

    def failing(copy):
        if copy.step.k == 2:
            raise ArithmeticError("of no use")
        return encode(copy)

    recorder._encoder.encode = failing
    with pytest.raises(ArithmeticError):
        record_four(recorder)
    run = read_run(path)
    assert run.steps.tolist() == [0, 1, 3]
    assert run.metadata["end"]["outcome"] == "ArithmeticError: of no use"
