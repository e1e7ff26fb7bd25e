"""Damages a recording as a disk, a copy, an editor or an enemy may.

Every function gives one copy of a file's bytes. ``DAMAGES`` leave checksums as they
were; ``EDITS`` put them right, so that a reader may believe the content, which is
another.
"""

import io
import struct
import zlib

import lz4.frame
import numpy as np
import zstandard
from mcap.writer import Writer

from gpmpc.recording import _schema
from tests.recording import runs

MAGIC = b"\x89MCAP0\r\n"
# opcodes of MCAP
FOOTER = 2
SCHEMA = 3
CHANNEL = 4
MESSAGE = 5
CHUNK = 6
ATTACHMENT = 9
METADATA = 12
DATA_END = 15
HUGE = (
    2**16,
    2**20,
    2**24,
    2**28,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**33,
    2**40,
    2**62,
    2**63 - 1,
    2**63,
    2**64 - 1,
)


def records(data):
    """Opcodes and contents of the records, one after the other."""
    start = 0
    while len(data) - start >= 9:
        opcode, length = struct.unpack_from("<BQ", data, start)
        if len(data) - start - 9 < length:
            return
        yield opcode, bytes(data[start + 9 : start + 9 + length])
        start += 9 + length


def joined(entries):
    return b"".join(
        struct.pack("<BQ", opcode, len(content)) + content
        for opcode, content in entries
    )


def sealed(entries):
    """Returns a file of a data section's records with right checksums and no index."""
    data = MAGIC + joined(entries)
    end = joined([(DATA_END, struct.pack("<I", zlib.crc32(data)))])
    footer = struct.pack("<BQQQ", FOOTER, 20, 0, 0)
    return data + end + footer + struct.pack("<I", zlib.crc32(footer)) + MAGIC


def section(data):
    """The records of a file's data section."""
    entries = list(records(data[len(MAGIC) :]))
    return entries[: [opcode for opcode, _ in entries].index(DATA_END)]


def text(value):
    value = value if isinstance(value, bytes) else value.encode()
    return struct.pack("<I", len(value)) + value


def metadata(name, pairs):
    content = b"".join(text(key) + text(value) for key, value in pairs.items())
    return METADATA, text(name) + struct.pack("<I", len(content)) + content


def attachment(name, content, crc=None):
    body = (
        struct.pack("<QQ", 0, 0)
        + text(name)
        + text("application/yaml")
        + struct.pack("<Q", len(content))
        + content
    )
    return ATTACHMENT, body + struct.pack(
        "<I", zlib.crc32(body) if crc is None else crc
    )


def chunk(content, compression="zstd", size=None, crc=None, compressed=None):
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(
        compression, bytes
    )
    compressed = packed(content) if compressed is None else compressed
    size = len(content) if size is None else size
    crc = zlib.crc32(content) if crc is None else crc
    return CHUNK, struct.pack("<QQQI", 0, 0, size, crc) + text(
        compression
    ) + struct.pack("<Q", len(compressed)) + compressed


def inside(content):
    """The records in a chunk."""
    size, _, name = struct.unpack_from("<QII", content, 16)
    return list(records(zstandard.decompress(content[32 + name + 8 :], size)))


def _pick(rng, items):
    return items[int(rng.integers(len(items)))]


def _flip(data, places, rng):
    changed = bytearray(data)
    for place in places:
        changed[place] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _spans(data):
    """Opcode, start and end of every record with its head."""
    start = len(MAGIC)
    for opcode, content in records(data[start:]):
        yield opcode, start, start + 9 + len(content)
        start += 9 + len(content)


def flip_anywhere(data, rng):
    return _flip(data, rng.integers(0, len(data), rng.integers(1, 4)), rng)


def flip_text(data, rng):
    """In the configuration or in metadata."""
    _, start, end = _pick(
        rng, [span for span in _spans(data) if span[0] in (ATTACHMENT, METADATA)]
    )
    return _flip(data, rng.integers(start + 9, end, rng.integers(1, 3)), rng)


def flip_head(data, rng):
    """In the kind or the length of a record."""
    _, start, _ = _pick(rng, list(_spans(data)))
    return _flip(data, [start + int(rng.integers(9))], rng)


def flip_end(data, rng):
    """In the index, the footer or the magic bytes."""
    [start] = [start for opcode, start, _ in _spans(data) if opcode == DATA_END]
    return _flip(data, rng.integers(start, len(data), rng.integers(1, 4)), rng)


def cut(data, rng):
    return data[: int(rng.integers(len(data)))]


def cut_and_flip(data, rng):
    data = data[: int(rng.integers(len(MAGIC) + 20, len(data)))]
    return _flip(data, rng.integers(0, len(data), rng.integers(1, 4)), rng)


def overwrite(data, rng):
    start = int(rng.integers(len(data)))
    length = min(int(rng.choice([1, 4, 8, 64, 512, 4096])), len(data) - start)
    elsewhere = int(rng.integers(len(data) - length + 1))
    block = _pick(
        rng,
        [
            bytes(length),
            rng.bytes(length),
            b"\xff" * length,
            data[elsewhere : elsewhere + length],
        ],
    )
    return data[:start] + block + data[start + length :]


def insert_or_delete(data, rng):
    start = int(rng.integers(len(data)))
    length = int(rng.integers(1, 200))
    return data[:start] + (
        rng.bytes(length) + data[start:] if rng.integers(2) else data[start + length :]
    )


def append(data, rng):
    return data + _pick(rng, [b"\0", rng.bytes(30), data, MAGIC])


def shuffle(entries, rng):
    """Records removed, repeated or exchanged."""
    entries = list(entries)
    i, j = (int(place) for place in rng.integers(0, len(entries), 2))
    kind = rng.integers(4)
    if kind == 0:
        del entries[i]
    elif kind == 1:
        entries.insert(j, entries[i])
    elif kind == 2:
        entries[i], entries[j] = entries[j], entries[i]
    else:
        entries[i:j] = []
    return entries


def shuffle_file(data, rng):
    return MAGIC + joined(shuffle(records(data[len(MAGIC) :]), rng)) + MAGIC


def shuffle_sealed(data, rng):
    return sealed(shuffle(section(data), rng))


def huge(data, rng):
    """A number of a record's content, or its length, becomes a huge one."""
    _, start, end = _pick(rng, list(_spans(data)))
    width, code = (8, "<Q") if rng.integers(2) else (4, "<I")
    place = (
        start + 1
        if rng.integers(4) == 0
        else int(rng.integers(start + 1, max(start + 2, min(end, start + 80))))
    )
    number = struct.pack(code, _pick(rng, HUGE) % 2 ** (8 * width))
    return data[:place] + number + data[place + width :]


def in_chunk(data, rng, change):
    """A chunk's records changed by ``change``, its checksum right."""
    entries = section(data)
    i = _pick(rng, [i for i, (opcode, _) in enumerate(entries) if opcode == CHUNK])
    content = change(inside(entries[i][1]))
    entries[i] = chunk(
        content if isinstance(content, bytes) else joined(content),
        _pick(rng, ["zstd", "lz4", ""]),
    )
    return sealed(entries)


def shuffle_in_chunk(data, rng):
    return in_chunk(data, rng, lambda entries: shuffle(entries, rng))


def flip_in_chunk(data, rng):
    def change(entries):
        content = joined(entries)
        return _flip(content, rng.integers(0, len(content), rng.integers(1, 4)), rng)

    return in_chunk(data, rng, change)


def cut_in_chunk(data, rng):
    """The chunk, a message or a schema shorter than it says, or empty."""

    def change(entries):
        if rng.integers(3) == 0:
            content = joined(entries)
            return content[: int(rng.integers(len(content)))]
        i = int(rng.integers(len(entries)))
        opcode, content = entries[i]
        entries[i] = (
            opcode,
            content[: int(rng.integers(len(content)))]
            if rng.integers(2)
            else content[:22],
        )
        return entries

    return in_chunk(data, rng, change)


def renumber(data, rng):
    """Ids and time stamps of schemas, channels and messages."""

    def change(entries):
        i = int(rng.integers(len(entries)))
        opcode, content = entries[i]
        place = int(rng.choice([0, 2, 6]))
        number = struct.pack("<H", int(rng.choice([0, 1, 2, 9, 65535])))
        entries[i] = opcode, content[:place] + number + content[place + 2 :]
        return entries

    return in_chunk(data, rng, change)


def edit_message(data, rng):
    """Fields of a message that no longer belong together."""
    classes = _schema.message_classes(
        _schema.descriptor(runs.STATES, runs.INPUTS, arrays_as_bytes=True)
    )

    def change(entries):
        messages = [
            i
            for i, (opcode, content) in enumerate(entries)
            if opcode == MESSAGE and content[0] in (1, 2, 3)
        ]
        i = _pick(rng, messages)
        head = entries[i][1][:22]
        content = entries[i][1][22:]
        message = classes[("Step", "Plan", "QuadraticProgram")[head[0] - 1]].FromString(
            content
        )
        field = _pick(rng, list(message.DESCRIPTOR.fields))
        kind = rng.integers(3)
        if kind == 0 or field.message_type is not None:
            message.ClearField(field.name)
        elif field.type == field.TYPE_BYTES:
            old = getattr(message, field.name)
            setattr(
                message,
                field.name,
                _pick(rng, [old[:-8], old[:-3], old + bytes(8), bytes(8 * 10**5)]),
            )
        elif field.type == field.TYPE_DOUBLE:
            setattr(message, field.name, _pick(rng, [np.nan, np.inf, -1e300]))
        elif field.type != field.TYPE_BOOL:
            largest = 31 if field.type == field.TYPE_ENUM else 63
            setattr(
                message,
                field.name,
                int(
                    _pick(
                        rng,
                        [-1, -6, 99, 10**6, 2**31 - 1, 2**largest - 1, -(2**largest)],
                    )
                ),
            )
        entries[i] = MESSAGE, head + message.SerializeToString()
        return entries

    return in_chunk(data, rng, change)


def edit_metadata(data, rng):
    about = {"state_names": " ".join(runs.STATES), "input_names": " ".join(runs.INPUTS)}
    names = [
        "",
        "x",
        "x x",
        "x 1z",
        "x ü",
        "\0",
        " ".join(f"s{i}" for i in range(int(rng.choice([5, 7, 30000])))),
    ]
    names += [
        "x " * 20000,
        "class def import for None with",
        b"\xff\xfe",
        "__class__ x",
        "time k step a b c",
    ]
    about[_pick(rng, list(about))] = _pick(rng, names)
    if rng.integers(4) == 0:
        del about[_pick(rng, list(about))]
    changed = [
        metadata("run", about),
        metadata("run", {}),
        metadata("frames", {}),
        metadata("units", {"state.x": "\x1b["}),
    ]
    changed += [
        metadata("recovered", {}),
        metadata("", {"": ""}),
        metadata("end", {"steps": "-1"}),
    ]
    changed += [
        (METADATA, b""),
        (METADATA, text("run")),
        (METADATA, text("run") + struct.pack("<I", 2**32 - 1)),
    ]
    entries = section(data)
    i = _pick(rng, [i for i, (opcode, _) in enumerate(entries) if opcode == METADATA])
    entries[i] = changed[0] if rng.integers(2) else _pick(rng, changed)
    return sealed(entries)


def edit_config(data, rng):
    content = _pick(
        rng, [b"", b"\xff\xfe\x80", b"seed: 8\n", bytes(10**6), rng.bytes(1000)]
    )
    entries = section(data)
    [i] = [i for i, (opcode, _) in enumerate(entries) if opcode == ATTACHMENT]
    changed = [
        attachment("config.yaml", content),
        attachment("config.yaml", content, crc=0),
    ]
    changed += [attachment("config.yaml", content, crc=5), attachment("other", content)]
    changed += [
        (ATTACHMENT, b""),
        (ATTACHMENT, bytes(30)),
        (ATTACHMENT, entries[i][1][:-7]),
    ]
    entries[i] = _pick(rng, changed)
    return sealed(entries)


_zeros: dict = {}


def zeros(size, compression):
    """Zeros compressed without ever being in memory, and their checksum."""
    if (size, compression) not in _zeros:
        make = (
            zstandard.ZstdCompressor().compressobj(size=size)
            if compression == "zstd"
            else lz4.frame.LZ4FrameCompressor()
        )
        block = bytes(2**22)
        crc = 0
        parts = [make.begin()] if compression == "lz4" else []
        for start in range(0, size, len(block)):
            piece = block[: size - start]
            parts.append(make.compress(piece))
            crc = zlib.crc32(piece, crc)
        _zeros[size, compression] = b"".join([*parts, make.flush()]), crc
    return _zeros[size, compression]


def bomb(data, rng, largest=2**31):
    """Chunks of very little that unfold to very much, or say so."""
    entries = section(data)
    kind = rng.integers(5)
    compression = _pick(rng, ["zstd", "lz4"])
    if kind == 0:  # honest about its size
        size = int(rng.choice([2**26, largest]))
        packed, crc = zeros(size, compression)
        bombs = [chunk(b"", compression, size, crc, packed)]
    elif kind == 1:  # not honest
        packed, crc = zeros(largest, compression)
        bombs = [
            chunk(
                b"",
                compression,
                int(rng.choice([0, 1, 10**5, 10**7])),
                _pick(rng, [0, crc]),
                packed,
            )
        ]
    elif kind == 2:  # says that it unfolds, and does not
        bombs = [chunk(b"tiny", compression, _pick(rng, HUGE), _pick(rng, [None, 0]))]
    elif kind == 3:  # one record of an unknown kind, many times
        content = struct.pack("<BQ", 99, 2**24) + bytes(2**24)
        bombs = [chunk(content, compression)] * int(rng.choice([1, 60]))
    else:  # a message of zeros on a channel of the run
        content = struct.pack(
            "<BQHIQQ", MESSAGE, 22 + 2**24, int(rng.integers(1, 4)), 0, 0, 0
        ) + bytes(2**24)
        bombs = [chunk(content, compression)] * int(rng.choice([1, 60]))
    place = int(rng.integers(1, len(entries) + 1))
    return sealed(entries[:place] + bombs + entries[place:])


def well_formed_bomb(data, rng):
    """Makes plans and quadratic programs of zeros: well placed, and far too many."""
    classes = _schema.message_classes(_schema.descriptor(runs.STATES, runs.INPUTS))
    n = len(runs.STATES)
    entries = section(data)
    kind = rng.integers(3)
    many = int(rng.choice([3, 40]))
    if kind == 0:
        stages = int(rng.choice([3000, 30000]))
        plan = classes["Plan"](
            k=int(rng.integers(20)), covariances=[0.0] * (stages * n * n)
        )
        for _ in range(stages):
            plan.stages.add()
        message = 2, plan.SerializeToString()
    elif kind == 1:
        size = int(rng.choice([300, 1000]))
        program = {
            "P": size * size,
            "q": size,
            "lower": size,
            "upper": size,
            "softness": 2 * size,
        }
        fields = {name: [0.0] * length for name, length in program.items()}
        message = (
            3,
            classes["QuadraticProgram"](
                k=1, variables=size, **fields
            ).SerializeToString(),
        )
    else:
        step = classes["Step"](k=1, belief_covariance=[0.0] * (n * n))
        message = (1, step.SerializeToString())
        many = many * 1000
    content = struct.pack("<HIQQ", message[0], 0, 0, 0) + message[1]
    chunks = [
        chunk(joined([(MESSAGE, content)] * max(1, min(many, 2**23 // len(content)))))
        for _ in range(min(many, 40))
    ]
    return sealed(entries + chunks)


def foreign(data, rng):
    """Files of others."""
    output = io.BytesIO()
    writer = Writer(output)
    writer.start()
    topic = _pick(rng, ["/step", "/camera", "/plan"])
    channel = writer.register_channel(
        topic, "json", writer.register_schema("s", "jsonschema", b"{}")
    )
    if rng.integers(2):
        writer.add_metadata("run", {"state_names": "x y", "input_names": "u"})
    for i in range(5):
        writer.add_message(channel, i, b'{"x": 1}', i)
    writer.finish()
    others = [
        b"",
        MAGIC,
        MAGIC * 2,
        b"\x89PNG\r\n\x1a\n" + rng.bytes(300),
        b"k,x\n1,2\n",
        bytes(10**6),
        MAGIC + bytes(10**6),
    ]
    return _pick(
        rng, [*others, output.getvalue(), output.getvalue(), output.getvalue()]
    )


DAMAGES = (
    flip_anywhere,
    flip_text,
    flip_head,
    flip_end,
    cut,
    cut_and_flip,
    overwrite,
    insert_or_delete,
    append,
    shuffle_file,
    huge,
)
EDITS = (
    shuffle_sealed,
    shuffle_in_chunk,
    flip_in_chunk,
    cut_in_chunk,
    renumber,
    edit_message,
    edit_metadata,
    edit_config,
    bomb,
    well_formed_bomb,
    foreign,
)
