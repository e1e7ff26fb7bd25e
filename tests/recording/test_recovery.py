"""A killed run keeps what had been written whole, in a file that any reader opens."""

import os
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader

from gpmpc.exceptions import RecordingError
from gpmpc.recording import read_run, recover
from tests.recording import runs

ENDLESS = Path(__file__).with_name("endless.py")
# opcodes of MCAP
MESSAGE = 0x05
CHUNK = 0x06
ATTACHMENT = 0x09
METADATA = 0x0C
DATA_END = 0x0F
MAGIC = 8  # [bytes]


def walk(data):
    """Yields opcodes and contents of the records in order, read as the format says."""
    start = 0
    while len(data) - start >= 9:
        opcode, length = struct.unpack_from("<BQ", data, start)
        if len(data) - start - 9 < length or opcode == DATA_END:
            return
        yield opcode, data[start + 9 : start + 9 + length]
        start += 9 + length


def whole_messages(data):
    """Number of the messages in all whole chunks, counted without MCAP's library."""
    count = 0
    for opcode, content in walk(data[MAGIC:]):
        if opcode == CHUNK:
            size, _, name = struct.unpack_from("<QII", content, 16)
            inside = zstandard.decompress(content[32 + name + 8 :], size)
            count += sum(kind == MESSAGE for kind, _ in walk(inside))
    return count


def messages_of(run):
    return sum(count for count, _ in run.channels.values())


def check_recovered(path, output):
    expected = whole_messages(path.read_bytes())
    recovery = recover(path, output)
    assert messages_of(recovery) == expected
    with output.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert len(list(reader.iter_messages())) == expected
        assert reader.get_summary().statistics.message_count == expected
        assert all(
            index.message_index_offsets for index in reader.get_summary().chunk_indexes
        )
        [config] = reader.iter_attachments()
        assert config.name == "config.yaml"
        assert config.data == b"seed: 7\n"
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert metadata["run"]["seed"] == "7"
    assert metadata["units"]["time"] == "s"
    run = read_run(output)
    assert not run.finished  # the file is; its run came to no end
    np.testing.assert_array_equal(run.times, read_run(path).times)
    return run


@pytest.fixture(scope="module")
def start():
    """Starts a process that records to a path; returns its number.

    It returns once the process has said the words that are waited for.
    """
    zygote = subprocess.Popen(
        [sys.executable, str(ENDLESS)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )

    def start(*words):
        print(*words, file=zygote.stdin, flush=True)
        return int(zygote.stdout.readline())

    start.output = zygote.stdout
    yield start
    zygote.stdin.close()
    zygote.wait()
    zygote.stdout.close()


def test_runs_killed_at_random_moments_are_recovered(start, tmp_path):
    rng = np.random.default_rng()
    steps = []
    for i in range(20):
        path = tmp_path / f"{i}.mcap"
        process = start(path)
        size = rng.choice(
            [1, rng.uniform(1, 300_000)]
        )  # soon after the start, or in the middle of some chunk
        deadline = time.monotonic() + 60
        while not path.exists() or path.stat().st_size < size:
            assert time.monotonic() < deadline, "nothing is recorded"
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.02))
        os.kill(process, signal.SIGKILL)
        run = read_run(path)
        assert not run.finished
        steps.append(
            len(check_recovered(path, path.with_suffix(".recovered.mcap")).times)
        )
        assert run.steps.tolist() == list(range(steps[-1]))
    assert max(steps) > 50


def test_a_killed_run_loses_at_most_its_last_chunk(start, tmp_path):
    path = tmp_path / "run.mcap"
    count = 400
    process = start(path, count)
    assert start.output.readline() == "recorded\n"
    os.kill(process, signal.SIGKILL)
    run = read_run(path)
    assert not run.finished
    size = 8 * (5 * 6 + 3 + 36 + 30 + 66 + 11 * 36)  # of a step's numbers [bytes]
    assert count - len(run.steps) <= 256 * 1024 // size + 1
    assert run.steps.tolist() == list(range(len(run.steps)))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    runs.record_run(path, steps=20, config="seed: 7\n")
    return path


def test_a_file_cut_anywhere_gives_back_its_whole_chunks(finished, tmp_path):
    data = finished.read_bytes()
    with finished.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
        first = chunks[0].chunk_start_offset
        end = chunks[-1].chunk_start_offset + chunks[-1].chunk_length
    rng = np.random.default_rng(0)
    cuts = [
        first,
        first + 1,
        first + 9,
        end - 1,
        end,
        len(data) - 1,
        *rng.integers(first, len(data), 10),
    ]
    for cut in cuts:
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        assert not read_run(path).finished
        check_recovered(path, tmp_path / "recovered.mcap")


def test_a_file_cut_within_its_configuration_has_none(finished, tmp_path):
    data = finished.read_bytes()
    path = tmp_path / "cut.mcap"
    output = tmp_path / "recovered.mcap"
    path.write_bytes(data[: data.index(b"seed: 7\n") + 4])
    recover(path, output)
    with output.open("rb") as file:
        assert not list(make_reader(file).iter_attachments())


def test_a_damaged_chunk_ends_what_is_recovered(finished, tmp_path):
    data = bytearray(finished.read_bytes())
    with finished.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    data[chunks[-1].chunk_start_offset + 100] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    output = tmp_path / "recovered.mcap"
    path.write_bytes(data)
    assert (
        0
        < messages_of(recover(path, output))
        < messages_of(recover(finished, tmp_path / "copy.mcap"))
    )
    assert not read_run(path).finished


def test_a_finished_file_is_copied_with_nothing_lost(finished, tmp_path):
    output = tmp_path / "copy.mcap"
    recovery = recover(finished, output)
    assert recovery.finished
    assert np.ptp(recovery.times) == pytest.approx(1.9)
    before = read_run(finished)
    after = read_run(output)
    np.testing.assert_array_equal(before.plan_means, after.plan_means)
    assert after.finished
    assert before.metadata == after.metadata
    assert before.channels == after.channels


def test_what_cannot_be_recovered_is_named(finished, tmp_path):
    (tmp_path / "notes.mcap").write_text("these are notes, no recording")
    (tmp_path / "empty.mcap").touch()
    output = tmp_path / "out.mcap"
    with pytest.raises(
        RecordingError, match=r"missing\.mcap: cannot be read: No such file"
    ):
        recover(tmp_path / "missing.mcap", output)
    with pytest.raises(RecordingError, match=r"notes\.mcap: is not an MCAP file"):
        recover(tmp_path / "notes.mcap", output)
    with pytest.raises(RecordingError, match=r"empty\.mcap: is empty"):
        recover(tmp_path / "empty.mcap", output)
    with pytest.raises(RecordingError, match="cannot be recovered into itself"):
        recover(finished, finished)
    with pytest.raises(RecordingError, match="cannot be written"):
        recover(finished, tmp_path / "nowhere" / "out.mcap")
    assert not output.exists()


def test_a_file_of_others_is_no_run(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    for use in (read_run, lambda path: recover(path, tmp_path / "recovered.mcap")):
        with pytest.raises(
            RecordingError, match=r"other\.mcap: is not the recording of a run"
        ):
            use(path)
    assert [left.name for left in tmp_path.iterdir()] == ["other.mcap"]
