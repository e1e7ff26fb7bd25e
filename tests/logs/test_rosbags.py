"""Bags of ROS 1 and ROS 2 open: folders, SQLite, packed ones, and older ones."""

import bz2
import sqlite3

import numpy as np
import pytest

from gpmpc.exceptions import DataError
from gpmpc.logs import inspect_log, read_log

pytest.importorskip("rosbags")
from rosbags import rosbag1, rosbag2
from rosbags.typesys import (
    Stores,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)

ROWS = 120
BEGIN = 1_700_000_000  # [s]
ARM = "float64 angle\nfloat32[2] rate\nstring note\nbool[] flags\nuint8 mode\n"
ARM_IDL = """module my_msgs {
  module msg {
    typedef float float__2[2];
    struct Arm {
      double angle;
      float__2 rate;
      string note;
      sequence<boolean> flags;
      uint8 mode;
    };
  };
};
"""
MAPPING = {
    "rate": 50,
    "rest": "use",
    "held": "use",
    "states": {
        "angle": {"topic": "/arm", "columns": ["angle"], "unit": "rad"},
        "rate": {"topic": "/arm", "columns": ["rate[0]"], "unit": "rad/s"},
        "force": {"topic": "/force", "columns": ["vector.x"], "unit": "N"},
    },
    "inputs": {"torque": {"topic": "/torque", "columns": ["data"]}},
}
ANGLES = np.sin(0.05 * np.arange(ROWS))


def write_messages(writer, store, serialize, add):
    """Writes an arm at 50 Hz, a force with a stamp, and a torque, to an open writer."""
    types = store.types
    arm = types["my_msgs/msg/Arm"]
    connections = {
        "/arm": add("/arm", "my_msgs/msg/Arm"),
        "/force": add("/force", "geometry_msgs/msg/Vector3Stamped"),
        "/torque": add("/torque", "std_msgs/msg/Float64"),
        "/text": add("/text", "std_msgs/msg/String"),
    }
    header = types["std_msgs/msg/Header"]
    counter = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    for k in range(ROWS):
        nanoseconds = k * 20_000_000
        stamp = types["builtin_interfaces/msg/Time"](
            sec=BEGIN + nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        )
        rates = np.array([0.1 * k, 0], dtype=np.float32)
        flags = np.array([True] * (k % 3))
        vector = types["geometry_msgs/msg/Vector3"](x=2 * ANGLES[k], y=0.0, z=0.0)
        messages = {
            "/arm": arm(ANGLES[k], rates, "note"[: k % 4], flags, 7),
            "/force": types["geometry_msgs/msg/Vector3Stamped"](
                header(stamp=stamp, frame_id="base", **counter), vector
            ),
            "/torque": types["std_msgs/msg/Float64"](float(k // 10)),
            "/text": types["std_msgs/msg/String"]("a text"),
        }
        for topic, message in messages.items():
            connection = connections[topic]
            data = serialize(message, connection.msgtype)
            writer.write(connection, BEGIN * 10**9 + nanoseconds, data)


def ros2(path, plugin="SQLITE3", idl=False, compression=None):
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = (
        get_types_from_idl(ARM_IDL)
        if idl
        else get_types_from_msg(ARM, "my_msgs/msg/Arm")
    )
    store.register(types)
    plugin = rosbag2.StoragePlugin[plugin]
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    if compression:
        mode = rosbag2.CompressionMode[compression]
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:

        def add(topic, kind):
            return writer.add_connection(topic, kind, typestore=store)

        write_messages(writer, store, store.serialize_cdr, add)
    return path


def ros1(path, compression=None):
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(ARM, "my_msgs/msg/Arm"))
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:

        def add(topic, kind):
            return writer.add_connection(topic, kind, typestore=store)

        write_messages(writer, store, store.serialize_ros1, add)
    return path


def file_alone(path):
    folder = ros2(path)
    (file,) = folder.glob("*.db3")
    (folder / "metadata.yaml").unlink()
    return file


def two_files_of_mcap(path):
    folder = ros2(path, "MCAP")
    (file,) = folder.glob("*.mcap")
    file.rename(folder / "part_1.mcap")
    other = ros2(path.with_name("other"), "MCAP")
    (second,) = other.glob("*.mcap")
    second.rename(folder / "part_0.mcap")  # the same messages once more
    return folder


BAGS = {
    "a folder of SQLite": ros2,
    "a folder of MCAP": lambda path: ros2(path, "MCAP"),
    "a packed folder": lambda path: ros2(path, compression="FILE"),
    "SQLite alone": file_alone,
    "a folder of two files": two_files_of_mcap,
    "ROS 1": lambda path: ros1(path.with_suffix(".bag")),
    "ROS 1 in bzip2": lambda path: ros1(path.with_suffix(".bag"), "BZ2"),
    "ROS 1 in LZ4": lambda path: ros1(path.with_suffix(".bag"), "LZ4"),
}


@pytest.mark.parametrize("kind", BAGS)
def test_every_kind_of_bag_is_read(tmp_path, kind):
    path = BAGS[kind](tmp_path / "bag")
    log = read_log(path, MAPPING)
    (run,) = log.runs
    assert run.name in ("bag", "bag_0")
    assert len(run) == ROWS
    np.testing.assert_allclose(run.states[:, 0], ANGLES, atol=1e-12)
    np.testing.assert_allclose(run.states[:, 1], 0.1 * np.arange(ROWS), rtol=1e-6)
    np.testing.assert_allclose(run.states[:, 2], 2 * ANGLES, atol=1e-12)
    np.testing.assert_allclose(run.inputs[:, 0], np.arange(ROWS) // 10)
    kinds = {finding.kind for finding in log.findings}
    assert "not asked for" in kinds
    inspection = inspect_log(path)
    assert "/arm.angle" in inspection.channels.index
    assert inspection.streams.set_index("stream").loc["/arm", "rate [Hz]"] == (
        pytest.approx(50)
    )


def without_definitions(path):
    folder = ros2(path)
    (file,) = folder.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM message_definitions")
    return folder


def test_a_bag_without_definitions_has_those_of_ros_itself(tmp_path):
    folder = without_definitions(tmp_path / "bag")
    states = {"force": MAPPING["states"]["force"]}
    log = read_log(folder, {**MAPPING, "states": states})
    np.testing.assert_allclose(log.runs[0].states[:, 0], 2 * ANGLES, atol=1e-12)
    with pytest.raises(DataError, match="my_msgs/msg/Arm is no type of ROS itself"):
        read_log(folder, MAPPING)


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_definitions_in_idl_are_read(tmp_path, plugin):
    folder = ros2(tmp_path / "bag", plugin)
    text = "=" * 80 + "\nIDL: my_msgs/msg/Arm\n" + ARM_IDL
    if plugin == "SQLITE3":
        (file,) = folder.glob("*.db3")
        with sqlite3.connect(file) as database:
            database.execute(
                "UPDATE message_definitions SET encoding = 'ros2idl', "
                "encoded_message_definition = ? WHERE topic_type LIKE 'my%'",
                (text,),
            )
    else:
        from mcap.reader import make_reader
        from mcap.writer import Writer

        (file,) = folder.glob("*.mcap")
        with file.open("rb") as stream:
            messages = list(make_reader(stream).iter_messages())
        with file.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            ids = {}
            for schema, channel, message in messages:
                if channel.id not in ids:
                    is_own = schema.name.startswith("my")
                    kind = "ros2idl" if is_own else schema.encoding
                    data = text.encode() if is_own else schema.data
                    number = writer.register_schema(schema.name, kind, data)
                    ids[channel.id] = writer.register_channel(
                        channel.topic, "cdr", number
                    )
                writer.add_message(
                    ids[channel.id],
                    message.log_time,
                    message.data,
                    message.publish_time,
                )
            writer.finish()
    log = read_log(folder, MAPPING)
    np.testing.assert_allclose(log.runs[0].states[:, 0], ANGLES, atol=1e-12)


def test_what_is_no_bag_is_refused_in_one_line(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(DataError, match="empty: is a folder without a bag"):
        read_log(empty, MAPPING)
    (tmp_path / "a.bag").write_bytes(b"no bag")
    (tmp_path / "a.db3").write_bytes(b"no database")
    for name in ("a.bag", "a.db3"):
        with pytest.raises(DataError, match=f"{name}: ") as refusal:
            read_log(tmp_path / name, MAPPING)
        assert "\n" not in str(refusal.value)
    folder = ros2(tmp_path / "messages", compression="MESSAGE")
    with pytest.raises(DataError, match="each message is compressed by itself"):
        read_log(folder, MAPPING)
    whole = ros1(tmp_path / "whole.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="cut.bag: .*index looks damaged"):
        read_log(tmp_path / "cut.bag", MAPPING)


def test_a_chunk_of_ros_1_may_not_unfold_to_all_memory(tmp_path, monkeypatch):
    zeros = bz2.compress(bytes(100_000_000))
    pack = rosbag1.writer.Writer.set_compression

    def set_bomb(writer, kind):
        pack(writer, kind)
        writer.compressor = lambda content: zeros

    monkeypatch.setattr(rosbag1.writer.Writer, "set_compression", set_bomb)
    path = ros1(tmp_path / "bomb.bag", "BZ2")
    with pytest.raises(DataError, match="its chunks would take more than"):
        read_log(path, MAPPING)
