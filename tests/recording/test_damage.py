"""A damaged recording is refused in one line, read as unfinished, or read rightly."""

import contextlib
import json
import struct
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zstandard

from gpmpc.exceptions import RecordingError
from gpmpc.recording import read_run, recover
from tests.recording import damage, runs

STUDY = Path(__file__).with_name("study.py")
BARE = 50  # what a process that reads recordings takes at least [MB]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    return path, runs.record_run(path, steps=20, config=20 * "seed: 7\n")


def check_study(path, seed, count, processes=1):
    ends = [count * i // processes for i in range(processes + 1)]
    parts = [
        subprocess.Popen(
            [sys.executable, str(STUDY), str(path), *map(str, (seed, *span))],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for span in pairwise(ends)
    ]
    lines = []
    for part in parts:
        try:
            output, errors = part.communicate(timeout=600)
        finally:
            part.kill()  # where compiled code of a reader hangs
        assert part.returncode == 0, errors[-2000:]
        lines += [json.loads(line) for line in output.splitlines()]
    assert len(lines) == count
    edits = {kind.__name__ for kind in damage.EDITS}
    for line in lines:
        outcomes = line["outcomes"]
        believed = {"other"} if line["damage"] in edits else set()
        assert (
            set(outcomes.values()) <= {"error", "same", "unfinished", "done"} | believed
        ), line
        assert outcomes.get("recovered") != "error", (
            line
        )  # what recover writes can always be read
        assert line["megabytes"] + BARE < 300, line
        assert line["seconds"] < 5, line
    assert {line["damage"] for line in lines} == edits | {
        kind.__name__ for kind in damage.DAMAGES
    }
    assert {line["outcomes"]["read"] for line in lines} == {
        "error",
        "same",
        "unfinished",
        "other",
    }


def test_a_damaged_recording_is_never_believed_and_does_no_harm(recorded):
    check_study(recorded[0], 0, 2 * len(damage.DAMAGES) + len(damage.EDITS))


@pytest.mark.slow
def test_three_thousand_damaged_recordings_are_never_believed(recorded):
    check_study(recorded[0], 1, 3000, processes=2)


@pytest.mark.parametrize("seed", range(3))
def test_no_flipped_bit_of_the_metadata_passes_unseen(recorded, tmp_path, seed):
    data = recorded[0].read_bytes()
    rng = np.random.default_rng(seed)
    path = tmp_path / "flipped.mcap"
    for _ in range(100):
        path.write_bytes(damage.flip_text(data, rng))
        with contextlib.suppress(
            RecordingError
        ):  # the names of states and inputs are among them
            assert not read_run(path).finished


CHANGES = {
    "lost": lambda entries, i: entries[:i] + entries[i + 1 :],
    "repeated": lambda entries, i: [*entries[: i + 1], *entries[i:]],
    "of an unknown kind": lambda entries, i: [
        *entries[:i],
        (entries[i][0] | 0x80, entries[i][1]),
        *entries[i + 1 :],
    ],
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_file_with_a_lost_or_repeated_record_is_unfinished(
    recorded, tmp_path, change
):
    path = tmp_path / "changed.mcap"
    entries = list(damage.records(recorded[0].read_bytes()[len(damage.MAGIC) :]))
    read_again = 0
    for i, (kind, _) in enumerate(entries):
        if kind in (damage.CHUNK, damage.METADATA, damage.ATTACHMENT):
            path.write_bytes(
                damage.MAGIC + damage.joined(CHANGES[change](entries, i)) + damage.MAGIC
            )
            with contextlib.suppress(
                RecordingError
            ):  # the metadata about the run are among them
                assert not read_run(path).finished, (i, kind)
                read_again += 1
    assert read_again > 3
    path.write_bytes(damage.MAGIC + damage.joined(entries) + damage.MAGIC)
    assert read_run(path).finished


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_chunk_with_a_short_last_record_is_unfinished(
    recorded, tmp_path, compression
):
    path = tmp_path / "cut.mcap"
    entries = damage.section(recorded[0].read_bytes())
    i = max(i for i, (kind, _) in enumerate(entries) if kind == damage.CHUNK)
    content, last = (
        damage.joined(part)
        for part in (damage.inside(entries[i][1]), damage.inside(entries[i][1])[-1:])
    )
    for missing in (
        0,
        1,
        len(last) // 2,
        len(last) - 9,
        len(last) - 1,
    ):  # of the last record: head or kind alone
        entries[i] = damage.chunk(content[: len(content) - missing], compression)
        path.write_bytes(damage.sealed(entries))
        assert read_run(path).finished == (missing == 0), missing


def with_messages(data, change):
    """The file with other messages, in one chunk, its checksums right."""
    entries = damage.section(data)
    records = [
        record
        for kind, content in entries
        if kind == damage.CHUNK
        for record in damage.inside(content)
    ]
    messages = [content for kind, content in records if kind == damage.MESSAGE]
    records = [record for record in records if record[0] != damage.MESSAGE]
    records += [(damage.MESSAGE, content) for content in change(messages)]
    chunk = damage.chunk(damage.joined(records))
    return damage.sealed(
        [record for record in entries if record[0] not in (damage.CHUNK, 7)] + [chunk]
    )


def channel(message):
    return struct.unpack_from("<H", message)[0]


def test_a_plan_belongs_to_the_step_of_its_number(recorded, tmp_path):
    path = recorded[0]
    steps = recorded[1]
    changed = tmp_path / "changed.mcap"
    rng = np.random.default_rng(0)
    for lost in (0, 7, 19):

        def change(messages, lost=lost):
            plans = [message for message in messages if channel(message) == 2]
            left = [message for message in messages if message is not plans[lost]]
            return [left[i] for i in rng.permutation(len(left))]

        changed.write_bytes(with_messages(path.read_bytes(), change))
        run = read_run(changed)
        assert run.finished
        assert sorted(run.steps) == list(range(20))
        for row, k in enumerate(run.steps):
            plan = steps[k].decision
            np.testing.assert_array_equal(run.states[row], steps[k].state)
            np.testing.assert_array_equal(
                run.plan_means[row],
                plan.means if k != lost else np.full((6, 6), np.nan),
            )
            np.testing.assert_array_equal(
                run.plan_inputs[row],
                plan.inputs if k != lost else np.full((5, 3), np.nan),
            )


def test_a_plan_whose_step_is_lost_is_left_out(recorded, tmp_path):
    path = recorded[0]
    steps = recorded[1]
    changed = tmp_path / "changed.mcap"

    def change(messages):
        first = next(message for message in messages if channel(message) == 1)
        return [message for message in messages if message is not first]

    changed.write_bytes(with_messages(path.read_bytes(), change))
    run = read_run(changed)
    assert run.steps.tolist() == list(range(1, 20))
    np.testing.assert_array_equal(
        run.plan_means, [step.decision.means for step in steps[1:]]
    )


def test_numbers_that_come_again_keep_their_own_plans(tmp_path):
    path = tmp_path / "run.mcap"
    other = tmp_path / "other.mcap"
    steps = runs.record_run(path, steps=3) + runs.record_run(other, steps=2)
    flights = []

    def join(messages):
        flights.append(messages)
        return [message for flight in flights for message in flight]

    with_messages(path.read_bytes(), join)
    path.write_bytes(with_messages(other.read_bytes(), join))  # two flights in one file
    np.testing.assert_array_equal(
        read_run(path).plan_means, [step.decision.means for step in steps]
    )


def test_a_shorter_plan_ends_in_nothing(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    steps = [
        runs.make_step(k, rng, horizon=horizon) for k, horizon in enumerate((3, 5, 1))
    ]
    with runs.recorder(path) as recorder:
        for step in steps:
            recorder.record(step)
    run = read_run(path)
    assert run.plan_means.shape == (3, 6, 6)
    assert run.plan_inputs.shape == (3, 5, 3)
    for row, step in enumerate(steps):
        H = len(step.decision.inputs)
        np.testing.assert_array_equal(run.plan_means[row, : H + 1], step.decision.means)
        np.testing.assert_array_equal(run.plan_inputs[row, :H], step.decision.inputs)
        assert np.isnan(run.plan_means[row, H + 1 :]).all()
        assert np.isnan(run.plan_covariances[row, H + 1 :]).all()
        assert np.isnan(run.plan_inputs[row, H:]).all()


def test_a_damaged_configuration_costs_no_steps(recorded, tmp_path):
    path = tmp_path / "flipped.mcap"
    path.write_bytes(recorded[0].read_bytes().replace(b"seed: 7", b"seed: 8", 1))
    run = read_run(path)
    assert not run.finished
    assert run.config == ""
    assert len(run.times) == 20
    recover(path, tmp_path / "recovered.mcap")
    again = read_run(tmp_path / "recovered.mcap")
    assert (again.finished, again.config, len(again.times)) == (False, "", 20)


def test_a_recording_of_the_largest_steps_is_read(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    step = runs.make_step(0, rng, qp=False)
    # A plan of zeros has 7.4 MB, half of what is shared with the writer, and more as
    # messages.
    H = 21_000
    zeros = replace(
        step.decision,
        inputs=np.zeros((H, 3)),
        means=np.zeros((H + 1, 6)),
        covariances=np.zeros((H + 1, 6, 6)),
    )
    with runs.recorder(path) as recorder:
        recorder.record(replace(step, decision=zeros))
    run = read_run(path)
    assert run.finished
    assert run.plan_means.shape == (1, H + 1, 6)
    assert not run.plan_means.any()


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_file_that_another_tool_compressed_is_read(recorded, tmp_path, compression):
    path = tmp_path / "other.mcap"
    entries = damage.section(recorded[0].read_bytes())
    chunks = [
        (kind, damage.inside(content) if kind == damage.CHUNK else content)
        for kind, content in entries
    ]
    rewritten = [
        damage.chunk(damage.joined(content), compression)
        if kind == damage.CHUNK
        else (kind, content)
        for kind, content in chunks
    ]
    path.write_bytes(damage.sealed(rewritten))
    run = read_run(path)
    assert run.finished
    np.testing.assert_array_equal(run.states, read_run(recorded[0]).states)


def test_a_frame_that_does_not_say_its_size_is_read(recorded, tmp_path):
    path = tmp_path / "other.mcap"
    entries = damage.section(recorded[0].read_bytes())
    silent = zstandard.ZstdCompressor(write_content_size=False)
    for i, (kind, content) in enumerate(entries):
        if kind == damage.CHUNK:
            data = damage.joined(damage.inside(content))
            entries[i] = damage.chunk(data, compressed=silent.compress(data))
    path.write_bytes(damage.sealed(entries))
    assert read_run(path).finished


def test_metadata_may_stand_behind_the_messages(recorded, tmp_path):
    path = tmp_path / "other.mcap"
    entries = damage.section(recorded[0].read_bytes())
    behind = [
        record
        for record in entries
        if record[0] in (damage.METADATA, damage.ATTACHMENT)
    ]
    path.write_bytes(
        damage.sealed([record for record in entries if record not in behind] + behind)
    )
    run = read_run(path)
    expected = read_run(recorded[0])
    assert run.finished
    assert (run.metadata, run.config) == (expected.metadata, expected.config)
    np.testing.assert_array_equal(run.states, expected.states)


@pytest.mark.parametrize("size", [0, 2**20, 2**40, 2**63])
def test_a_chunk_that_says_another_size_ends_what_is_read(recorded, tmp_path, size):
    path = tmp_path / "changed.mcap"
    entries = damage.section(recorded[0].read_bytes())
    chunks = [i for i, (kind, _) in enumerate(entries) if kind == damage.CHUNK]
    content = entries[chunks[2]][1]
    entries[chunks[2]] = (
        damage.CHUNK,
        content[:16] + struct.pack("<Q", size) + content[24:],
    )
    path.write_bytes(damage.sealed(entries))
    run = read_run(path)
    assert not run.finished
    assert 0 < len(run.times) < len(recorded[1])
