"""Bags are read by what their channels say, and what is not read is counted."""

import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as PlainWriter
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from pyulog import ULog

sys.path.append(str(Path(__file__).resolve().parents[2]))
from gpmpc.exceptions import DataError
from gpmpc.logs import inspect_log, read_log
from tests.logs import strange
from tests.logs.strange import BAG_MAPPING, STEP, TABLE_MAPPING
from tests.logs.tables import read_file
from tests.recording import runs

ROWS = 400
DEFINITION = """
# a comment
float64 LIMIT=1.5
std_msgs/Header header
bool active
int8 small
Pair pair          # of the same package
uint16[3] counts
string<=10 name "unnamed"
float32[] samples
float64[<=4] few
Pair[2] pairs
Empty nothing
uint8[100] image
string[] words
my/Pair[] more
int64 last -3
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: my/Pair
float32 x
float64 y
================================================================================
MSG: my/Empty
"""


def findings(log):
    return {finding.kind: (finding.count, finding.text) for finding in log.findings}


@pytest.mark.parametrize("profile", ["", "ros2", "ros1", "nobody"])
@pytest.mark.parametrize("encoding", ["ros2", "json", "protobuf"])
def test_messages_are_known_by_their_channels_not_the_profile(
    tmp_path, encoding, profile
):
    topics = strange.pendulum_topics(ROWS, encoding=encoding)
    path = strange.write_bag(tmp_path / "arm.mcap", topics, profile)
    (run,) = read_log(path, BAG_MAPPING)
    assert len(run) == ROWS
    np.testing.assert_allclose(
        run.states, strange.pendulum(ROWS)[["angle", "rate"]], atol=1e-5
    )


def test_one_bag_may_hold_all_encodings(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    topics["/motor"] = topics["/motor"]._replace(encoding="json")
    topics["/other"] = topics["/arm"]._replace(encoding="protobuf")
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    streams = read_file(path).tables
    assert set(streams) == {"/arm", "/motor", "/other"}
    np.testing.assert_array_equal(streams["/arm"]["angle"], streams["/other"]["angle"])


def test_ros_2_numbers_are_those_of_the_reference_decoder(tmp_path):
    rng = np.random.default_rng(0)
    with (tmp_path / "all.mcap").open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("my/msg/All", DEFINITION)
        for k in range(20):
            pair = {"x": k + 0.5, "y": -k}
            message = {
                "header": {"stamp": {"sec": k, "nanosec": 7}, "frame_id": "x" * k},
                "active": bool(k % 2),
                "small": -k,
                "pair": pair,
                "counts": [k, k + 1, k + 2],
                "name": "n" * (k % 5),
                "samples": rng.normal(size=k % 4).tolist(),
                "few": rng.normal(size=k % 3).tolist(),
                "pairs": [pair, pair],
                "nothing": {},
                "image": bytes(100),
                "words": ["w" * i for i in range(k % 4)],
                "more": [pair] * (k % 3),
                "last": -(k**9),
            }
            writer.write_message("/all", schema, message, k, k)
        writer.finish()
    table = read_file(tmp_path / "all.mcap").tables["/all"]
    with (tmp_path / "all.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        expected = [m.decoded_message for m in reader.iter_decoded_messages()]
    for k, message in enumerate(expected):
        row = table.iloc[k]
        assert row["header.stamp.sec"] == message.header.stamp.sec
        assert row["active"] == message.active
        assert row["small"] == message.small
        assert (row["pair.x"], row["pair.y"]) == (message.pair.x, message.pair.y)
        assert [row[f"counts[{i}]"] for i in range(3)] == message.counts
        samples = [row[f"samples[{i}]"] for i in range(len(message.samples))]
        assert samples == message.samples
        assert row["last"] == message.last
    assert not [name for name in table if "image" in name or "more" in name]
    assert np.isnan(table["samples[2]"].iloc[0])


def test_both_byte_orders_are_read(tmp_path):
    little = b"\0\1\0\0" + struct.pack("<hxxxxxxd", -2, 0.5)
    big = b"\0\0\0\0" + struct.pack(">hxxxxxxd", -2, 0.5)
    for name, data in (("little.mcap", little), ("big.mcap", big)):
        path = strange.bag_of_one_chunk(
            tmp_path / name, data, size=1000, definition="int16 a\nfloat64 b"
        )
        table = read_file(path).tables["/arm"]
        assert set(table["a"]) == {-2.0}
        assert set(table["b"]) == {0.5}


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"\0\7\0\0" + bytes(16), r"0x0007 \(XCDR2"),
        (b"\0\3\0\0" + bytes(16), r"0x0003 .*only plain CDR is read"),
        (b"\0\1\0\0" + bytes(7), "within its fields"),
        (b"\0", "fewer than its head"),
    ],
)
def test_a_message_that_is_asked_for_and_cannot_be_read_is_named(
    tmp_path, data, expected
):
    path = strange.bag_of_one_chunk(tmp_path / "arm.mcap", data, size=1000)
    mapping = {"rate": 50, "states": {"a": {"topic": "/arm", "columns": ["angle"]}}}
    with pytest.raises(DataError, match=f"message 1 of /arm .*{expected}"):
        read_log(path, mapping)


@pytest.mark.parametrize(
    ("definition", "expected"),
    [
        ("my/Unknown x", "definition of my/Unknown is missing"),
        ("wstring text", "wstring, which is not read"),
        ("float64[0] x", "list 'x' of length 0"),
        ("Arm x", "a message of type my/Arm holds itself"),
        ("float64 angle;", None),
        ("?", r"has a line '\?'"),
    ],
)
def test_a_definition_that_cannot_be_read_is_named(tmp_path, definition, expected):
    data = b"\0\1\0\0" + bytes(8)
    path = strange.bag_of_one_chunk(
        tmp_path / "arm.mcap", data, size=1000, definition=definition
    )
    if expected is None:
        assert list(read_file(path).tables["/arm"])[1:] == ["angle"]
        return
    with pytest.raises(DataError, match=expected):
        read_file(path, ["/arm"])


def test_what_nobody_asked_for_refuses_no_bag_and_is_counted(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    topics["/camera"] = topics["/arm"]._replace(encoding="cbor")
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    log = read_log(path, BAG_MAPPING)
    assert len(log) == ROWS
    text = f"{ROWS} messages of 1 other topics: left out"
    assert findings(log) == {"not asked for": (ROWS, text)}
    file = read_file(path)  # all topics: those that can be read
    assert set(file.tables) == {"/arm", "/motor"}
    assert findings(file)["not read"][0] == ROWS
    assert "encoded as cbor" in findings(file)["not read"][1]
    topics["/arm"] = topics["/camera"]
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    with pytest.raises(DataError, match="topic /arm: it is encoded as cbor"):
        read_log(path, BAG_MAPPING)


def test_malformed_messages_are_left_out_and_counted(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    path = strange.write_bag(tmp_path / "arm.mcap", topics, chunk_size=10**6)
    with path.open("rb") as file:
        messages = [*make_reader(file).iter_messages()]
    header, head = strange.mcap_begin(messages[0][0].data.decode())
    records = head
    for k, (_, channel, message) in enumerate(messages):
        if channel.topic == "/arm":
            start = struct.pack("<HIQQ", 0, k, message.log_time, message.log_time)
            data = message.data[: 9 if k == 100 else None]
            records += strange.mcap_record(5, start + data)
    strange.bag_of_chunk(path, header, records, len(records), compression=b"")
    mapping = {**BAG_MAPPING, "rest": "use", "inputs": {}}
    with pytest.raises(DataError, match=r"message 51 of /arm .* partial=true leaves"):
        read_log(path, mapping)
    log = read_log(path, mapping, partial=True)
    text = "1 messages of /arm cannot be read: left out"
    unchecked = "no checksums: 1 chunks may be altered unnoticed"
    assert findings(log) == {
        "malformed message": (1, text),
        "no checksums": (1, unchecked),
    }
    assert len(log) == ROWS


def test_what_is_lost_of_a_damaged_bag_is_said_with_its_times(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    path = strange.write_bag(tmp_path / "arm.mcap", topics, chunk_size=4000)
    whole = path.read_bytes()
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    chunk = chunks[5]
    spoilt = bytearray(whole)
    spoilt[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 64
    path.write_bytes(spoilt)
    with pytest.raises(DataError, match="cannot be read to its end .a chunk with"):
        read_log(path, BAG_MAPPING)
    log = read_log(path, BAG_MAPPING, partial=True)
    _, text = findings(log)["damaged"]
    begin = chunk.message_start_time / 1e9
    end = chunk.message_end_time / 1e9
    assert f"the messages from {begin} to {end} s is damaged" in text
    lost = round((end - begin) / STEP)
    assert abs(len(log) - (ROWS - lost)) <= 3
    path.write_bytes(whole[: len(whole) * 2 // 3])
    log = read_log(path, BAG_MAPPING, partial=True)
    assert "are cut off or no record: lost" in findings(log)["damaged"][1]


def test_checksums_of_foreign_bags_are_checked(tmp_path):
    topics = strange.pendulum_topics(50)
    path = strange.write_bag(tmp_path / "arm.mcap", topics, chunk_size=10**6)
    with path.open("rb") as file:
        (chunk,) = make_reader(file).get_summary().chunk_indexes
    expected = read_file(path).tables["/arm"]
    whole = path.read_bytes()
    begin = chunk.chunk_start_offset + 60
    for position in range(begin, begin + chunk.compressed_size - 20, 7):
        spoilt = bytearray(whole)
        spoilt[position] ^= 1 << position % 8
        path.write_bytes(spoilt)
        try:
            table = read_file(path).tables["/arm"]
        except DataError:
            continue
        assert table.equals(expected)


def test_topics_that_are_missing_silent_or_not_named_are_named(tmp_path):
    topics = strange.pendulum_topics(ROWS)
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    with pytest.raises(DataError, match="topic '/leg' is missing; it has /arm, /motor"):
        read_file(path, ["/leg"])
    with pytest.raises(DataError, match="the mapping names none for a signal"):
        read_log(path, TABLE_MAPPING)
    empty = topics["/motor"]._replace(columns={}, log_times=np.empty(0))
    path = strange.write_bag(tmp_path / "arm.mcap", topics | {"/motor": empty})
    with pytest.raises(DataError, match="topic '/motor' has no message"):
        read_log(path, BAG_MAPPING)


def test_a_field_called_timestamp_is_a_field(tmp_path):
    topics = strange.pendulum_topics(ROWS, header=False)
    arm = topics["/arm"]
    micros = {"timestamp": np.round(1e6 * (5 + STEP * np.arange(ROWS)))}
    topics["/arm"] = arm._replace(columns=micros | arm.columns)
    path = strange.write_bag(tmp_path / "arm.mcap", topics)
    assert len(read_log(path, BAG_MAPPING)) == ROWS
    own = {"rest": "use", "time": {"column": "timestamp", "unit": "us"}}
    states = BAG_MAPPING["states"]
    (run,) = read_log(path, {**own, "states": states})
    np.testing.assert_allclose(run.time, 5 + STEP * np.arange(ROWS))


def ulog_topics(rows=ROWS):
    table = strange.pendulum(rows)
    table["t"] += 1.0
    columns = {name: table[name].to_numpy() for name in table}
    return {"arm": columns, "other": {"t": columns["t"], "x": columns["rate"]}}


ULOG_MAPPING = {
    role: {name: {**signal, "topic": "arm"} for name, signal in signals.items()}
    for role, signals in TABLE_MAPPING.items()
    if role != "time"
}


def test_a_ulog_is_what_pyulog_reads(tmp_path):
    path = strange.ulog(tmp_path / "a.ulg", ulog_topics(), sync_every=50)
    expected = {data.name: data.data for data in ULog(str(path)).data_list}
    file = read_file(path)
    assert set(file.tables) == set(expected) == {"arm", "other"}
    assert not file.findings
    for name, columns in expected.items():
        for column in set(columns) - {"timestamp"}:
            np.testing.assert_array_equal(file.tables[name][column], columns[column])
    log = read_log(path, ULOG_MAPPING)
    assert len(log) == ROWS
    assert findings(log) == {
        "not asked for": (ROWS, f"{ROWS} messages of 1 other topics: left out")
    }


def test_a_ulog_is_read_behind_damage_and_the_loss_is_counted(tmp_path, capfd):
    path = strange.ulog(tmp_path / "a.ulg", ulog_topics(), sync_every=50)
    content = bytearray(path.read_bytes())
    middle = content.index(b"\x2f\x73\x13\x20", len(content) // 2) + 8 + 27
    content[middle : middle + 400] = bytes(400)
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"damaged \(\d+ of \d+ bytes .* partial=true"):
        read_log(path, ULOG_MAPPING)
    log = read_log(path, ULOG_MAPPING, partial=True)
    lost, text = findings(log)["damaged"]
    assert text == f"{lost} bytes: lost"
    assert 400 <= lost < 1600
    assert ROWS - 30 < len(log) < ROWS
    assert capfd.readouterr().out == ""


def test_a_ulog_that_ends_within_a_message_is_whole(tmp_path):
    path = strange.ulog(tmp_path / "a.ulg", ulog_topics())
    path.write_bytes(path.read_bytes()[:-5])
    log = read_log(path, ULOG_MAPPING)
    assert findings(log)["cut off"][1].startswith("the file ends within a message")
    assert len(log) == ROWS


def test_sections_that_were_appended_to_a_ulog_are_read(tmp_path):
    path = strange.ulog(tmp_path / "a.ulg", ulog_topics())
    first = path.read_bytes()[:-5]
    late = strange.ulog_message(b"D", struct.pack("<HQfff", 0, 10**8, 1, 2, 3))
    flags = bytes(8) + b"\1" + bytes(7) + struct.pack("<QQQ", len(first), 0, 0)
    start = first.index(b"B")
    path.write_bytes(first[: start + 1] + flags + first[start + 41 :] + late)
    table = read_file(path, ["arm"], partial=True).tables["arm"]
    assert (len(table), table["timestamp"].iloc[-1]) == (ROWS + 1, 100.0)


def test_a_rewritten_recording_is_still_a_recording(tmp_path):
    runs.record_run(tmp_path / "run.mcap")
    expected = read_file(tmp_path / "run.mcap").tables[""]
    content = (tmp_path / "run.mcap").read_bytes()
    foreign = content.replace(b"\5\0\0\0gpmpc", b"\5\0\0\0other", 1)
    (tmp_path / "other.mcap").write_bytes(foreign)
    file = read_file(tmp_path / "other.mcap", [""], partial=True)
    assert file.tables[""].equals(expected)
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) * 3 // 4])
    with pytest.raises(DataError, match="gpmpc log recover rescues it"):
        read_file(tmp_path / "cut.mcap", [""])
    file = read_file(tmp_path / "cut.mcap", [""], partial=True)
    assert "it was not finished" in findings(file)["unfinished"][1]
    assert 0 < len(file.tables[""]) <= len(expected)


def joint_states(encoding, field="name"):
    """Returns how drivers publish joints: texts, in a field, and positions."""
    if encoding == "json":

        def encode(names, positions):
            message = {field: names, "position": positions}
            return json.dumps(message).encode()

        return strange.Encoder("my/Joints", "json", "jsonschema", b"{}", encode)

    def encode(names, positions):
        data = struct.pack("<I", len(names))
        for name in names:
            data += b"\0" * (-len(data) % 4)
            data += struct.pack("<I", len(name) + 1) + name.encode() + b"\0"
        data += b"\0" * (-len(data) % 4) + struct.pack("<I", len(positions))
        data += b"\0" * (-len(data) % 8) + struct.pack(
            f"<{len(positions)}d", *positions
        )
        return b"\0\1\0\0" + data

    definition = f"string[] {field}\nfloat64[] position".encode()
    return strange.Encoder("my/Joints", "cdr", "ros2msg", definition, encode)


JOINTS = {
    "rate": 50,
    "states": {"q": {"topic": "/joints", "columns": ["position[0]"]}},
}


def write_joints(path, encoder, lists):
    """Writes a bag whose messages have texts of two lists by turns, at 100 Hz."""
    with path.open("wb") as file:
        writer = PlainWriter(file)
        writer.start()
        schema = writer.register_schema(
            encoder.name, encoder.definition, encoder.schema
        )
        channel = writer.register_channel("/joints", encoder.message, schema)
        for k in range(200):
            names = lists[k % 2]
            positions = [np.sin(0.1 * k + joint) for joint in range(len(names))]
            data = encoder.encode(names, positions)
            time = 10**9 + 10**7 * k
            writer.add_message(channel, time, data, time, k)
        writer.finish()


@pytest.mark.parametrize("encoding", ["cdr", "json"])
@pytest.mark.parametrize("others", [["finger"], ["elbow", "shoulder"]])
def test_joints_of_two_drivers_are_not_one_column(tmp_path, encoding, others):
    joints = ["shoulder", "elbow"]
    write_joints(tmp_path / "arm.mcap", joint_states(encoding), [joints, others])
    with pytest.raises(DataError, match="carry 2 different lists of names"):
        read_log(tmp_path / "arm.mcap", JOINTS)
    warnings = inspect_log(tmp_path / "arm.mcap").warnings
    assert any("carry 2 different lists of names" in text for text in warnings)


@pytest.mark.parametrize("encoding", ["cdr", "json"])
@pytest.mark.parametrize(
    ("field", "others"),
    [
        ("name", ["shoulder", "elbow"]),
        ("name", []),  # as a driver begins
        ("status", ["hot", "cold"]),
    ],
)
def test_joints_of_one_driver_are(tmp_path, encoding, field, others):
    encoder = joint_states(encoding, field)
    write_joints(tmp_path / "arm.mcap", encoder, [["shoulder", "elbow"], others])
    log = read_log(tmp_path / "arm.mcap", JOINTS)
    assert len(log) == 100
    assert not any(
        "names" in text for text in inspect_log(tmp_path / "arm.mcap").warnings
    )
