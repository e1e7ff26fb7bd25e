"""Reads the records of an MCAP file that was cut off, damaged, or made by somebody else.

Records are parsed by MCAP's library, up to the first that does not fit into the file, a chunk whose checksum is wrong,
or a reference to what was not declared. Metadata and attachments that are damaged are left out. A footer is yielded
only if nothing is missing and every checksum of the file (of chunks, attachments, data and index) is right. (The
library alone believes every length, unfolds whatever a chunk holds, and skips the checksums of attachments and index.)

Nothing is unfolded before it is known to be small: a record or chunk has at most ``LARGEST`` bytes, and all of them
together take at most ``room``.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from gpmpc.exceptions import RecordingError

CONFIG, RECOVERED = "config.yaml", "recovered"  # an attachment; metadata of a file that holds what was left of another
LARGEST = 32 * 2**20  # [bytes]
_ROOM, _RATIO = 64 * 2**20, 300  # [bytes], and bytes a byte of the file; runs are compressed 2 to 10 times
_OBJECT = 2000  # [bytes] that a message takes besides its content
_HEAD = struct.Struct("<BQ")  # kind and length
_IN_DATA = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA}
_BROKEN = (McapError, struct.error, UnicodeDecodeError, OverflowError, zstandard.ZstdError, RuntimeError)


def room(path: Path) -> int:
    """Bounds the memory that a file's content may take [bytes]; a recording of this size holds far less."""
    return _ROOM + _RATIO * path.stat().st_size


def whole_records(path: Path) -> Iterator[McapRecord]:
    """Yields schemas, channels, messages, metadata, attachments up to the first broken record; a footer if none is."""
    try:
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: is not a file")
        with path.open("rb") as file:
            magic = file.read(len(MCAP0_MAGIC))
            if magic != MCAP0_MAGIC:
                reason = "is empty: its recording was killed before it began" if not magic else "is not an MCAP file"
                raise RecordingError(f"{path}: {reason}")
            declared: dict[tuple[type, int], McapRecord | None] = {(Schema, 0): None}
            for record in _sound_records(file, path):
                if isinstance(record, Message) and (Channel, record.channel_id) not in declared:
                    return
                if isinstance(record, Channel) and (Schema, record.schema_id) not in declared:
                    return
                new = isinstance(record, Schema | Channel)
                if new and declared.setdefault((type(record), getattr(record, "id", 0)), record) != record:
                    return
                yield record
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error


def _sound_records(file: BinaryIO, path: Path) -> Iterator[McapRecord]:
    """Yields the records behind the magic bytes, as far as lengths and checksums are right."""
    left, size, checksum = room(path), path.stat().st_size, zlib.crc32(MCAP0_MAGIC)
    counts: Counter[type] = Counter()
    whole, in_data = True, True
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        kind, length = _HEAD.unpack(head)
        if not kind or length > min(LARGEST, size - file.tell()):
            return
        content = file.read(length)
        before, checksum = checksum, zlib.crc32(content, zlib.crc32(head, checksum))
        try:
            if kind == Opcode.DATA_END:
                whole = whole and _agrees(content[:4], before)
                in_data, checksum = False, 0
            elif kind == Opcode.FOOTER:
                ends = file.read(len(MCAP0_MAGIC) + 1) == MCAP0_MAGIC
                index = zlib.crc32(content[:16], zlib.crc32(head, before))  # the last field is the checksum
                if whole and ends and not in_data and _agrees(content[16:20], index):
                    yield Footer(*struct.unpack("<QQI", content))
                return
            elif kind == Opcode.STATISTICS or (in_data and kind in _IN_DATA):  # schemas and channels are repeated
                for record in _parsed(head + content):
                    counts[type(record)] += 1
                    if isinstance(record, Statistics):
                        said = record.message_count, record.attachment_count, record.metadata_count, record.chunk_count
                        whole = whole and said == tuple(counts[k] for k in (Message, Attachment, Metadata, Chunk))
                    elif isinstance(record, Chunk):
                        for inner in _parsed(_unfolded(record)):
                            counts[type(inner)] += 1
                            left -= _OBJECT + (len(inner.data) if isinstance(inner, Message | Schema) else 0)
                            if left < 0:
                                limit = f"{room(path) / 1e6:.0f} MB"
                                raise RecordingError(f"{path}: its chunks unfold to more than {limit}")
                            yield inner
                    elif isinstance(record, Attachment) and not _agrees(content[-4:], zlib.crc32(content[:-4])):
                        whole = False
                    else:
                        yield record
        except RecordingError:
            raise  # it is a RuntimeError, as broken records raise
        except _BROKEN:
            if kind not in (Opcode.ATTACHMENT, Opcode.METADATA):
                return
            whole = False


def _agrees(stored: bytes, computed: int) -> bool:
    return struct.unpack("<I", stored)[0] in (0, computed)  # 0: there is no checksum


class _Bounded(BytesIO):
    """A stream whose ``read`` gives all of the length, or raises ``EndOfFile``; ``asked`` is the last length."""

    asked = 0

    def read(self, size: int | None = -1, /) -> bytes:
        self.asked = size or 0
        if self.asked > len(self.getbuffer()) - self.tell():
            raise EndOfFile
        return super().read(size)


def _parsed(data: bytes) -> Iterator[McapRecord]:
    """Parses records that follow each other; those of an unknown kind are left out."""
    stream = _Bounded(data)
    try:
        yield from StreamReader(stream, skip_magic=True, emit_chunks=True).records
    except EndOfFile:
        if stream.tell() < len(data) or stream.asked != 1:  # a record begins with one byte, its kind
            raise


def _unfolded(chunk: Chunk) -> bytes:
    """Decompresses a chunk, if it is as long as it says and its checksum is right."""
    size, data = chunk.uncompressed_size, chunk.data
    if size > LARGEST or chunk.compression not in ("zstd", "lz4", ""):
        raise EndOfFile
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(data) not in (-1, size):  # -1: the frame does not say
            raise EndOfFile
        data = zstandard.decompress(data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    if len(data) != size or not _agrees(struct.pack("<I", chunk.uncompressed_crc), zlib.crc32(data)):
        raise EndOfFile
    return data
