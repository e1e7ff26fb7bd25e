"""Damage in a bag or a recording is refused or stands in the findings of its log."""

import numpy as np
import pytest
from mcap.writer import CompressionType

from gpmpc.exceptions import DataError, GpmpcError
from gpmpc.logs import read_log
from gpmpc.recording import bag_flaws
from tests.logs.test_reading import BAG
from tests.recording import damage, runs
from tests.recording.test_lost_pieces import chunk_spans, spoiled, without_checksums

RECORDING = {
    "time": "time",
    "states": {"x": {"columns": ["measured.x"]}, "vx": {"columns": ["measured.vx"]}},
    "inputs": {"ux": {"columns": ["input.ux"]}},
}


def write_bag(path, compression=CompressionType.ZSTD, enable_crcs=True):
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, 1000, compression, enable_crcs)
        pose = writer.register_msgdef("my/Pose", "float64 angle\nfloat64[2] rate")
        torque = writer.register_msgdef("my/Torque", "float32 torque")
        for k in range(60):
            stamp = 10_000_000_000 + 20_000_000 * k
            angle = {"angle": np.sin(0.02 * k), "rate": [np.cos(0.02 * k), 0.0]}
            writer.write_message("/pose", pose, angle, stamp, stamp)
            effort = {"torque": float(k % 7)}
            writer.write_message("/torque", torque, effort, stamp, stamp)
        writer.finish()


def numbers(log):
    (run,) = log
    return [run.time, run.states, run.inputs]


def same(log, other):
    pairs = zip(numbers(log), numbers(other), strict=True)
    return all(np.array_equal(one, another) for one, another in pairs)


def attempt(path, mapping, **options):
    """The log of a file; none where it is refused."""
    try:
        return read_log(path, mapping, **options)
    except GpmpcError:
        return None


@pytest.mark.parametrize("compression", CompressionType)
def test_a_flipped_bit_of_a_bag_is_refused_or_changes_no_number(tmp_path, compression):
    path = tmp_path / "bag.mcap"
    write_bag(path, compression)
    data = path.read_bytes()
    expected = read_log(path, BAG)
    rng = np.random.default_rng(0)
    refused = 0
    for place in rng.integers(len(damage.MAGIC), len(data), 46):
        changed = bytearray(data)
        changed[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        log = attempt(path, BAG)
        refused += log is None
        assert log is None or same(log, expected), place
        partial = attempt(path, BAG, partial=True)
        if partial is not None and not same(partial, expected):
            assert len(partial.findings) > len(expected.findings), place
    assert refused > 10  # others hit the index, which no message is read from


@pytest.mark.parametrize("compression", CompressionType)
def test_a_chunk_of_a_bag_that_is_gone_is_noticed(tmp_path, compression):
    path = tmp_path / "bag.mcap"
    write_bag(path, compression)
    data = bytearray(path.read_bytes())
    data[chunk_spans(data)[2][1]] ^= 0x80  # another kind of record, which is skipped
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"bag\.mcap.*chunks"):
        read_log(path, BAG)


def test_a_bag_without_checksums_is_a_finding(tmp_path):
    path = tmp_path / "bag.mcap"
    write_bag(path, enable_crcs=False)
    log = read_log(path, BAG)
    [finding] = [f for f in log.findings if f.kind == "no checksums"]
    assert finding.run == "bag"
    assert "may be altered unnoticed" in finding.text
    write_bag(path)
    assert not bag_flaws(path)
    assert "no checksums" not in [f.kind for f in read_log(path, BAG).findings]


def test_a_recording_without_checksums_is_a_finding(tmp_path):
    path = tmp_path / "run.mcap"
    runs.record_run(path, steps=20)
    expected = read_log(path, RECORDING)
    path.write_bytes(without_checksums(path.read_bytes()))
    log = read_log(path, RECORDING)
    assert "no checksums" in [finding.kind for finding in log.findings]
    assert same(log, expected)


def test_losses_of_a_damaged_recording_are_findings(tmp_path):
    path = tmp_path / "run.mcap"
    runs.record_run(path, steps=20)
    data = path.read_bytes()
    path.write_bytes(spoiled(data, chunk_spans(data)[3][1] + 200))
    message = "partial=true takes what is whole .*5 of 20 steps are lost: after step 14"
    with pytest.raises(DataError, match=message):
        read_log(path, RECORDING)
    log = read_log(path, RECORDING, partial=True)
    counts = {finding.kind: finding.count for finding in log.findings}
    assert (counts["lost chunks"], counts["lost steps"]) == (1, 5)
    assert len(numbers(log)[0]) == 15
