"""Writes strange logs: of a pendulum whose clock, order, encodings or sizes are odd.

A bag is plain data, a ``Topic`` a topic, so that a test changes what it is about:
``topics["/arm"] = topics["/arm"]._replace(stamps=...)``.
"""

import gzip
import json
import struct
import zipfile
from io import BytesIO
from typing import NamedTuple

import numpy as np
import pandas
import pyarrow
import pyarrow.parquet
import scipy.io
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import Writer

STEP = 0.02  # [s] between two messages
BEGIN = 1.7e9  # [s] of the log's clock
TABLE_MAPPING = {
    "time": {"column": "t"},
    "states": {
        "angle": {"columns": ["angle"], "unit": "rad"},
        "rate": {"columns": ["rate"], "unit": "rad/s"},
    },
    "inputs": {"torque": {"columns": ["torque"], "unit": "N m"}},
}
BAG_MAPPING = {
    "rate": 50,
    "max_gap": 0.1,
    "states": {
        "angle": {"topic": "/arm", "columns": ["angle"], "unit": "rad"},
        "rate": {"topic": "/arm", "columns": ["rate"], "unit": "rad/s"},
    },
    "inputs": {"torque": {"topic": "/motor", "columns": ["torque"]}},
}
HEADER = """std_msgs/Header header
{fields}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


class Topic(NamedTuple):
    """The messages of a topic; K of them."""

    columns: dict[str, np.ndarray]  # numbers (K,) by name
    log_times: np.ndarray  # (K,) [s]
    stamps: np.ndarray | None = None  # (K,) [s] in their headers; None: no header
    encoding: str = "ros2"  # or "json", "protobuf"; any other word is of no kind


def pendulum(rows=400, seed=0):
    """A pendulum under torques that change every fifth row; with its time t."""
    rng = np.random.default_rng(seed)
    torques = np.repeat(rng.uniform(-3, 3, rows // 5 + 1), 5)
    angle = 0.3
    rate = 0.0
    table = []
    for k in range(rows):
        table.append((STEP * k, angle, rate, torques[k]))
        rate += STEP * (torques[k] - 0.3 * rate - 5 * np.sin(angle))
        angle += STEP * rate
    return pandas.DataFrame(table, columns=["t", "angle", "rate", "torque"])


def pendulum_topics(rows=400, header=True, encoding="ros2"):
    """The same as two topics, whose stamps are a millisecond before the log's time."""
    table = pendulum(rows)
    log_times = BEGIN + table["t"].to_numpy()
    stamps = log_times - 0.001 if header else None
    arm = {name: table[name].to_numpy() for name in ("angle", "rate")}
    motor = {"torque": table["torque"].to_numpy()}
    return {
        "/arm": Topic(arm, log_times, stamps, encoding),
        "/motor": Topic(motor, log_times, stamps, encoding),
    }


def write_bag(path, topics, profile="", order=None, chunk_size=2**15):
    """Writes the messages of all topics in the order of the log, or in another.

    Args:
        path: Of the file.
        topics: By name.
        profile: What the file's head says.
        order: Takes the number of messages, returns the order that they stand in.
        chunk_size: [bytes].
    """
    messages = []
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size)
        writer.start(profile=profile)
        for name, topic in topics.items():
            encoder = _ENCODERS.get(topic.encoding, _other)(list(topic.columns), topic)
            schema = writer.register_schema(
                encoder.name, encoder.definition, encoder.schema
            )
            channel = writer.register_channel(name, encoder.message, schema)
            for k, log_time in enumerate(topic.log_times):
                values = [float(column[k]) for column in topic.columns.values()]
                stamp = None if topic.stamps is None else topic.stamps[k]
                data = encoder.encode(stamp, values)
                messages.append((_nanoseconds(log_time), channel, k, data))
        messages.sort(key=lambda message: message[0])
        for i in range(len(messages)) if order is None else order(len(messages)):
            log_time, channel, k, data = messages[i]
            writer.add_message(channel, log_time, data, log_time, k)
        writer.finish()
    return path


class Encoder(NamedTuple):
    """How the messages of a channel are written."""

    name: str  # of the type
    message: str  # the encoding of the messages
    definition: str  # the encoding of their definition
    schema: bytes
    encode: object  # takes the stamp and the numbers of a message


def _nanoseconds(seconds):
    return round(float(seconds) * 1e9)


def _ros2(names, topic):
    fields = "\n".join(f"float64 {name}" for name in names)
    text = fields if topic.stamps is None else HEADER.format(fields=fields)

    def encode(stamp, values):
        header = b""
        if stamp is not None:  # with an empty text, and three bytes to align
            header = struct.pack("<iIIBxxx", *divmod(_nanoseconds(stamp), 10**9), 1, 0)
        return b"\0\1\0\0" + header + struct.pack(f"<{len(values)}d", *values)

    return Encoder("my/Row", "cdr", "ros2msg", text.encode(), encode)


def _json(names, topic):
    def encode(stamp, values):
        content = dict(zip(names, values, strict=True))
        if stamp is not None:
            sec, nanosec = divmod(_nanoseconds(stamp), 10**9)
            content["header"] = {"stamp": {"sec": sec, "nanosec": nanosec}}
        return json.dumps(content).encode()

    return Encoder("my.Row", "json", "jsonschema", b'{"type": "object"}', encode)


def _protobuf(names, topic):
    file = descriptor_pb2.FileDescriptorProto(
        name="arm.proto", package="my", syntax="proto3"
    )
    message = file.message_type.add(name="Stamp")
    for number, name in enumerate(("seconds", "nanos"), start=1):
        message.field.add(name=name, number=number, type=3, label=1)
    message = file.message_type.add(name="Row")
    for number, name in enumerate(names, start=1):
        message.field.add(name=name, number=number, type=1, label=1)
    message.field.add(
        name="timestamp", number=99, type=11, label=1, type_name=".my.Stamp"
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("my.Row"))

    def encode(stamp, values):
        message = kind(**dict(zip(names, values, strict=True)))
        if stamp is not None:
            seconds, nanos = divmod(_nanoseconds(stamp), 10**9)
            message.timestamp.seconds = seconds
            message.timestamp.nanos = nanos
        return message.SerializeToString()

    schema = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    return Encoder("my.Row", "protobuf", "protobuf", schema, encode)


def _other(names, topic):
    return Encoder("my.Row", topic.encoding, "", b"", lambda stamp, values: b"\1\2\3")


_ENCODERS = {"ros2": _ros2, "json": _json, "protobuf": _protobuf}


def npz_bomb(path, rows=5_000_000):
    """Zeros: a file of 0.2 MB that unfolds to 160 MB, and to more in a table."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("t", "angle", "rate", "torque"):
            with archive.open(f"{name}.npy", "w") as member:
                _write_head(member, f"{rows},")
                for _ in range(rows // 100_000):
                    member.write(bytes(800_000))
    return path


def npz_with_a_head_that_lies(path):
    """An array of eight bytes whose head says that it has 2**60."""
    with zipfile.ZipFile(path, "w") as archive, archive.open("t.npy", "w") as member:
        _write_head(member, f"{2**57},")
        member.write(bytes(8))
    return path


def npz_of_many_columns(path, columns=10_000_000):
    """One row of very many columns."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        head = BytesIO()
        _write_head(head, f"1, {columns}")
        archive.writestr("t.npy", head.getvalue() + bytes(8 * columns))
    return path


def _write_head(file, shape):
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape}), }}"
    head = head.ljust(117) + "\n"
    file.write(b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head.encode())


def parquet_bomb(path, rows=10_000_000):
    """Constant columns: their pages hold a number and how often it comes."""
    names = ("t", "angle", "rate", "torque")
    part = pyarrow.table({name: np.zeros(1_000_000) for name in names})
    with pyarrow.parquet.ParquetWriter(path, part.schema, compression="zstd") as writer:
        for _ in range(rows // 1_000_000):
            writer.write_table(part, row_group_size=10**6)
    return path


def parquet_of_one_long_text(path, rows=1_000_000):
    """A text of a megabyte that stands in every row, once in the file."""
    texts = pyarrow.DictionaryArray.from_arrays(
        np.zeros(rows, dtype=np.int32), pyarrow.array(["x" * 2**20])
    )
    columns = {"t": np.arange(rows) / 100, "note": texts}
    pyarrow.parquet.write_table(pyarrow.table(columns), path)
    return path


def csv_bomb(path, row=b"0,0,0,0\n", size=1_300_000_000, head=None):
    """The same row over and over: 1.3 MB that unfold to 1.3 GB."""
    part = 20_000_000
    block = gzip.compress(row * (part // len(row)))
    head = gzip.compress(b"t,angle,rate,torque\n" if head is None else head)
    path.write_bytes(head + block * max(size // part, 1))
    return path


def csv_of_one_line(path):
    """A single line without an end."""
    return csv_bomb(path, row=b"0,", size=300_000_000, head=b"")


MAGIC = b"\x89MCAP0\r\n"
END = b"".join(  # data, and the file, without checksums
    [
        struct.pack("<BQI", 15, 4, 0),
        struct.pack("<BQQQI", 2, 20, 0, 0, 0),
        MAGIC,
    ]
)


def mcap_record(kind, body):
    return struct.pack("<BQ", kind, len(body)) + body


def prefixed(text):
    return struct.pack("<I", len(text)) + text


def mcap_begin(definition="float64 angle", encoding=b"cdr"):
    """The records of a bag's head, and those of its one channel, /arm."""
    header = mcap_record(1, prefixed(b"") + prefixed(b""))
    schema = struct.pack("<H", 1) + prefixed(b"my/Arm") + prefixed(b"ros2msg")
    channel = struct.pack("<HH", 0, 1) + prefixed(b"/arm") + prefixed(encoding)
    schema = mcap_record(3, schema + prefixed(definition.encode()))
    return header, schema + mcap_record(4, channel + prefixed(b""))


def bag_of_one_chunk(path, data=b"", size=300_000_000, definition="float64 angle"):
    """A bag of one chunk that holds the same message over and over."""
    message = mcap_record(5, struct.pack("<HIQQ", 0, 0, 0, 0) + data)
    header, head = mcap_begin(definition)
    block = message * max(2**20 // len(message), 1)
    blocks = max(size // len(block), 1)
    size = len(head) + blocks * len(block)
    packer = zstandard.ZstdCompressor(level=3).compressobj(size=size)
    packed = packer.compress(head)
    packed += b"".join(packer.compress(block) for _ in range(blocks)) + packer.flush()
    return bag_of_chunk(path, header, packed, size)


def bag_of_chunk(path, header, packed, size, compression=b"zstd"):
    """A bag of one chunk of given bytes, which says that they unfold to ``size``."""
    chunk = struct.pack("<QQQI", 0, 0, size, 0) + prefixed(compression)
    chunk = mcap_record(6, chunk + struct.pack("<Q", len(packed)) + packed)
    path.write_bytes(MAGIC + header + chunk + END)
    return path


def ulog(path, topics, formats=b"", extra=b"", sync_every=None):
    """A ULog of topics of floats, as dictionaries of columns with their ``t`` [s]."""
    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    data += ulog_message(b"B", bytes(40))
    for name, columns in topics.items():
        fields = "".join(f"float {column};" for column in columns if column != "t")
        data += ulog_message(b"F", f"{name}:uint64_t timestamp;{fields}".encode())
    data += formats
    for number, name in enumerate(topics):
        subscription = struct.pack("<BH", 0, number) + name.encode()
        data += ulog_message(b"A", subscription)
    rows = []
    for number, columns in enumerate(topics.values()):
        names = [column for column in columns if column != "t"]
        for k, t in enumerate(columns["t"]):
            values = [columns[column][k] for column in names]
            row = struct.pack(f"<HQ{len(names)}f", number, round(1e6 * t), *values)
            rows.append((t, row))
    for k, (_, row) in enumerate(sorted(rows)):
        if sync_every and k % sync_every == 0:
            data += ulog_message(b"S", b"\x2f\x73\x13\x20\x25\x0c\xbb\x12")
        data += ulog_message(b"D", row)
    path.write_bytes(data + extra)
    return path


def ulog_message(kind, body):
    return struct.pack("<Hc", len(body), kind) + body


def nested_ulog(path, depth=5, width=1000):
    """A topic of lists of lists: a thousand to the fifth fields in 200 bytes."""
    formats = ulog_message(b"F", b"t0:uint64_t timestamp;float angle;")
    for level in range(1, depth):
        text = f"t{level}:uint64_t timestamp;t{level - 1}[{width}] x;"
        formats += ulog_message(b"F", text.encode())
    subscription = struct.pack("<BH", 0, 7) + f"t{depth - 1}".encode()
    formats += ulog_message(b"A", subscription)
    formats += ulog_message(b"D", struct.pack("<HQ", 7, 1))
    return ulog(path, {}, formats=formats)


def mat_bomb(path):
    """Zeros: a MATLAB file of 0.1 MB that unfolds to 80 MB."""
    scipy.io.savemat(path, {"angle": np.zeros((10_000_000, 1))}, do_compression=True)
    return path


def mat_of_nested_cells(path, depth=100_000):
    """A MATLAB file whose cells lie within each other, deeper than any stack."""
    flags = struct.pack("<IIII", 6, 8, 1, 0)
    dimensions = struct.pack("<IIii", 5, 8, 1, 1)
    head = flags + dimensions + struct.pack("<II", 1, 0)  # and an empty name
    cells = [
        struct.pack("<II", 14, i * (len(head) + 8) + len(head)) + head
        for i in range(depth)
    ]
    start = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"
    path.write_bytes(start + b"".join(reversed(cells)))
    return path
