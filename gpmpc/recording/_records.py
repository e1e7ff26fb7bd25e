"""Reads the records of an MCAP file that was cut off, damaged, or made by somebody else.

MCAP's library parses each record from its own bytes alone, up to the first that does not fit into the file, a chunk
whose checksum is wrong, or a message of no channel. Metadata and attachments that are damaged are left
out. A footer is yielded only if nothing is missing and every checksum of the file (of chunks, attachments, data and
index) is right. Nothing is unfolded before it is known to be small.
"""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Footer,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.writer import MCAP0_MAGIC

from gpmpc._bounds import LARGEST, room
from gpmpc.exceptions import RecordingError

CONFIG, RECOVERED = (
    "config.yaml",
    "recovered",
)  # an attachment; metadata of a file that holds what was left of another
_HEAD = struct.Struct("<BQ")  # kind and length
_PARSED = Schema, Channel, Message, Chunk, Attachment, Metadata
_KINDS: dict[Opcode, Any] = {Opcode[one.__name__.upper()]: one for one in _PARSED}
_BROKEN = (
    McapError,
    struct.error,
    UnicodeDecodeError,
    OverflowError,
    zstandard.ZstdError,
    RuntimeError,
)


def whole_records(path: Path) -> Iterator[McapRecord]:
    """Yields schemas, channels, messages, metadata, attachments up to the first broken record; a footer if none is."""
    try:
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: is not a file")
        with path.open("rb") as file:
            magic = file.read(len(MCAP0_MAGIC))
            if magic != MCAP0_MAGIC:
                reason = (
                    "is empty: its recording was killed before it began"
                    if not magic
                    else "is not an MCAP file"
                )
                raise RecordingError(f"{path}: {reason}")
            channels = set()
            for record in _sound_records(file, path):
                if isinstance(record, Channel):
                    channels.add(record.id)
                elif isinstance(record, Message) and record.channel_id not in channels:
                    return
                yield record
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be read: {error.strerror or error}"
        ) from error


def _sound_records(file: BinaryIO, path: Path) -> Iterator[McapRecord]:
    """Yields the records behind the magic bytes, as far as lengths and checksums are right."""
    left, size, checksum, whole, in_data = (
        room(path),
        path.stat().st_size,
        zlib.crc32(MCAP0_MAGIC),
        True,
        True,
    )
    while True:
        kind = 0
        try:
            head, content = _frame(file, size)
            kind, before, checksum = (
                head[0],
                checksum,
                zlib.crc32(content, zlib.crc32(head, checksum)),
            )
            if kind == Opcode.FOOTER:
                index = zlib.crc32(
                    content[:16], zlib.crc32(head, before)
                )  # the last field is the checksum
                if (
                    whole
                    and not in_data
                    and _agrees(content[16:20], index)
                    and file.read(9) == MCAP0_MAGIC
                ):
                    yield Footer(*struct.unpack("<QQI", content))
                return
            if kind == Opcode.DATA_END:
                whole, in_data, checksum = (
                    whole and _agrees(content[:4], before),
                    False,
                    0,
                )
            elif in_data and kind in _KINDS:
                record = _parsed(kind, content)
                if not isinstance(record, Chunk):
                    yield record
                    continue
                inside = BytesIO(_unfolded(record))
                left -= record.uncompressed_size
                if left < 0:
                    raise RecordingError(
                        f"{path}: its chunks unfold to more than {room(path) / 1e6:.0f} MB"
                    )
                while inside.tell() < record.uncompressed_size:
                    head, content = _frame(inside, record.uncompressed_size)
                    if head[0] in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                        yield _parsed(head[0], content)
        except RecordingError:
            raise  # it is a RuntimeError, as broken records raise
        except _BROKEN:
            if kind not in (Opcode.ATTACHMENT, Opcode.METADATA):
                return
            whole = False


def _frame(stream: BinaryIO | BytesIO, end: int) -> tuple[bytes, bytes]:
    """Reads the head and the content of a record that ends at ``end`` at the latest."""
    head = stream.read(_HEAD.size)
    kind, length = _HEAD.unpack(head)
    if not kind or length > min(LARGEST, end - stream.tell()):
        raise EndOfFile
    return head, stream.read(length)


class _Content(ReadDataStream):
    """The bytes of one record; what is not there cannot be read."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


def _parsed(kind: int, content: bytes) -> McapRecord:
    """Parses a record, of an attachment only if its checksum is right."""
    stream = _Content(BytesIO(content))
    if kind == Opcode.ATTACHMENT and not _agrees(
        content[-4:], zlib.crc32(content[:-4])
    ):
        raise EndOfFile
    return (
        Message.read(stream, len(content))
        if kind == Opcode.MESSAGE
        else _KINDS[Opcode(kind)].read(stream)
    )


def _unfolded(chunk: Chunk) -> bytes:
    """Decompresses a chunk, if it is as long as it says and its checksum is right."""
    size, data = chunk.uncompressed_size, chunk.data
    if size > LARGEST or chunk.compression not in ("zstd", "lz4", ""):
        raise EndOfFile
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(data) not in (
            -1,
            size,
        ):  # -1: the frame does not say
            raise EndOfFile
        data = zstandard.decompress(data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    if len(data) != size or not _agrees(
        struct.pack("<I", chunk.uncompressed_crc), zlib.crc32(data)
    ):
        raise EndOfFile
    return data


def _agrees(stored: bytes, computed: int) -> bool:
    return struct.unpack("<I", stored)[0] in (0, computed)  # 0: there is no checksum
