"""Reads the records of an MCAP file that was cut off, damaged, or made by somebody else.

Records are read from the file's start up to the first that does not fit into the file, a chunk whose checksum is
wrong, or a reference to what was not declared. Metadata and attachments that are damaged are left out. A footer is
yielded only if nothing is missing and every checksum of the file (of chunks, attachments, data and index) is right.
(MCAP's own stream reader believes every length, reads a record that is cut off as a shorter one, unfolds whatever a
chunk holds, and skips the checksums of attachments and index.)

Nothing is unfolded before it is known to be small: a record or chunk has at most ``LARGEST`` bytes, and all of them
together take at most ``room``.
"""

import stat
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from gpmpc.exceptions import RecordingError

CONFIG, RECOVERED = "config.yaml", "recovered"  # an attachment; metadata of a file that holds what was left of another
LARGEST = 32 * 2**20  # [bytes]
_ROOM, _RATIO = 64 * 2**20, 300  # [bytes], and bytes a byte of the file; runs are compressed 2 to 10 times
_OBJECT = 2000  # [bytes] that a message takes besides its content
_HEAD = struct.Struct("<BQ")  # kind and length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CLASSES: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
_BROKEN = (McapError, struct.error, UnicodeDecodeError, OverflowError, zstandard.ZstdError)


def room(path: Path) -> int:
    """Bounds the memory that a file's content may take [bytes]; a recording of this size holds far less."""
    return _ROOM + _RATIO * path.stat().st_size


def whole_records(path: Path) -> Iterator[McapRecord]:
    """Yields schemas, channels, messages, metadata, attachments up to the first broken record; a footer if none is.

    Raises:
        RecordingError: There is no such file, it is no MCAP file, or its chunks unfold to more than there is ``room``.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise RecordingError(f"{path}: is not a file")
        with path.open("rb") as file:
            magic = file.read(len(MCAP0_MAGIC))
            if magic != MCAP0_MAGIC:
                reason = "is empty: its recording was killed before it began" if not magic else "is not an MCAP file"
                raise RecordingError(f"{path}: {reason}")
            declared: dict[tuple[type, int], McapRecord | None] = {(Schema, 0): None}
            for record in _sound(file, path):
                if isinstance(record, Message) and (Channel, record.channel_id) not in declared:
                    return
                if isinstance(record, Channel) and (Schema, record.schema_id) not in declared:
                    return
                is_new = isinstance(record, Schema | Channel)
                if is_new and declared.setdefault((type(record), record.id), record) != record:
                    return
                yield record
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error


def _sound(file: BinaryIO, path: Path) -> Iterator[McapRecord]:
    """Yields the records behind the magic bytes, as far as lengths and checksums are right."""
    left, size, checksum = room(path), path.stat().st_size, zlib.crc32(MCAP0_MAGIC)
    counts: Counter[int] = Counter()
    whole, in_data = True, True
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        kind, length = _HEAD.unpack(head)
        if not kind or length > min(LARGEST, size - file.tell()):
            return
        content = file.read(length)
        before, checksum = checksum, zlib.crc32(content, zlib.crc32(head, checksum))
        try:
            if kind == Opcode.DATA_END:
                whole = whole and _agree(struct.unpack_from("<I", content)[0], before)
                in_data, checksum = False, 0
            elif kind == Opcode.FOOTER:
                footer = Footer.read(_stream(content))
                index = zlib.crc32(content[:16], zlib.crc32(head, before))  # its last field is the checksum
                ends = file.read(len(MCAP0_MAGIC) + 1) == MCAP0_MAGIC
                if whole and ends and not in_data and _agree(footer.summary_crc, index):
                    yield footer
                return
            elif kind == Opcode.STATISTICS:
                said = Statistics.read(_stream(content))
                whole = whole and [
                    said.message_count,
                    said.attachment_count,
                    said.metadata_count,
                    said.chunk_count,
                ] == [counts[k] for k in (Opcode.MESSAGE, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.CHUNK)]
            elif not in_data:
                continue  # schemas and channels are repeated
            elif kind == Opcode.CHUNK:
                counts[kind] += 1
                for inner, part in _split(_unfold(Chunk.read(_stream(content)))):
                    counts[inner] += 1
                    left -= _OBJECT + len(part)
                    if left < 0:
                        raise RecordingError(f"{path}: its chunks unfold to more than {room(path) / 1e6:.0f} MB")
                    if (record := _parse(inner, part)) is not None:
                        yield record
            elif (record := _parse(kind, content)) is not None:
                counts[kind] += 1
                yield record
        except _BROKEN:
            if kind not in (Opcode.ATTACHMENT, Opcode.METADATA):
                return
            whole = False


def _agree(stored: int, computed: int) -> bool:
    return stored in (0, computed)  # 0: there is no checksum


class _Whole(BytesIO):
    """A stream whose ``read`` gives all of the length, or raises."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if len(data) < (size or 0):
            raise EndOfFile
        return data


def _stream(content: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(_Whole(content))


def _parse(kind: int, content: bytes | memoryview) -> McapRecord | None:
    """Parses a record; None of another kind than is yielded."""
    if kind == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
        return Message(channel, log_time, bytes(content[_MESSAGE.size :]), publish_time, sequence)
    if kind not in _CLASSES:
        return None
    if kind == Opcode.ATTACHMENT and not _agree(struct.unpack("<I", content[-4:])[0], zlib.crc32(content[:-4])):
        raise EndOfFile
    return _CLASSES[kind].read(_stream(content))


def _split(content: bytes) -> Iterator[tuple[int, memoryview]]:
    """Yields kinds and contents of the records in a chunk."""
    view, start = memoryview(content), 0
    while start < len(view):
        kind, length = _HEAD.unpack_from(view, start)
        start += _HEAD.size
        if not kind or length > len(view) - start:
            raise EndOfFile
        yield kind, view[start : start + length]
        start += length


def _unfold(chunk: Chunk) -> bytes:
    """Decompresses a chunk, if it is as long as it says and its checksum is right."""
    size, data = chunk.uncompressed_size, chunk.data
    if size > LARGEST or chunk.compression not in ("zstd", "lz4", ""):
        raise EndOfFile
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(data) not in (-1, size):  # -1: the frame does not say
            raise EndOfFile
        data = zstandard.decompress(data, max_output_size=size)
    elif chunk.compression == "lz4":
        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
        except RuntimeError as error:
            raise EndOfFile from error
    if len(data) != size or not _agree(chunk.uncompressed_crc, zlib.crc32(data)):
        raise EndOfFile
    return data
