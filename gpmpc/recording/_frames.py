"""Takes the bytes of an MCAP file apart: frames of records, their content, chunks.

MCAP's library parses each record from its own bytes alone. Nothing is unfolded before
it is known to be small.
"""

import struct
import zlib
from collections.abc import Container, Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from gpmpc._bounds import LARGEST

HEAD = struct.Struct("<BQ")  # kind and length of a record
BROKEN = (
    McapError,
    struct.error,
    UnicodeDecodeError,
    OverflowError,
    zstandard.ZstdError,
    RuntimeError,
)  # what parsing a damaged record raises
_CHUNK_HEAD = struct.Struct("<QQQI")  # times, unfolded size and its checksum
_CLASSES: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.MESSAGE: Message,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
}


class Frame(NamedTuple):
    """The bytes of a record and the place where they stand."""

    kind: int  # opcode
    start: int  # of its head in the file or chunk
    content: bytes

    @property
    def content_start(self) -> int:
        """The place of the content."""
        return self.start + HEAD.size

    @property
    def end(self) -> int:
        """The place of the next record."""
        return self.content_start + len(self.content)


def read_frame(stream: BinaryIO | BytesIO, start: int, end: int) -> Frame | None:
    """Reads the record at ``start``; None where it does not end before ``end``."""
    stream.seek(start)
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    kind, length = HEAD.unpack(head)
    if not kind or length > min(LARGEST, end - start - HEAD.size):
        return None
    content = stream.read(length)
    return Frame(kind, start, content) if len(content) == length else None


def parsed(kind: int, content: bytes) -> Any:
    """Parses a record, of an attachment only if its checksum is right.

    Raises one of ``BROKEN`` where the content is none of its kind.
    """
    stream = _Content(BytesIO(content))
    if kind == Opcode.ATTACHMENT:
        _check_attachment(content)
    if kind == Opcode.MESSAGE:
        return Message.read(stream, len(content))
    return _CLASSES[kind].read(stream)


def _check_attachment(content: bytes) -> None:
    if not agrees(stored_checksum(content[-4:]), zlib.crc32(content[:-4])):
        raise EndOfFile


def chunk_length(chunk: Chunk) -> int:
    """Returns the length of the content of a chunk's record [bytes]."""
    return _CHUNK_HEAD.size + 4 + len(chunk.compression) + 8 + len(chunk.data)


def unfolded(chunk: Chunk, largest: float = LARGEST) -> bytes:
    """Decompresses a chunk, if it is as long as it says and its checksum is right.

    Raises one of ``BROKEN`` otherwise, or where it would be larger than ``largest``
    [bytes].
    """
    size = chunk.uncompressed_size
    data = chunk.data
    if size > largest or chunk.compression not in ("zstd", "lz4", ""):
        raise EndOfFile
    if chunk.compression == "zstd":
        stated_size = zstandard.frame_content_size(data)
        if stated_size not in (-1, size):  # -1: the frame does not say
            raise EndOfFile
        data = zstandard.decompress(data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    if len(data) != size or not agrees(chunk.uncompressed_crc, zlib.crc32(data)):
        raise EndOfFile
    return data


def stored_checksum(content: bytes) -> int:
    """Reads the checksum that a record holds; 0 where there is none."""
    return int(struct.unpack("<I", content)[0])


def agrees(stored: int, computed: int) -> bool:
    """Tells whether a checksum is right, or there is none."""
    return stored in (0, computed)


def frames(data: bytes) -> Iterator[Frame]:
    """Yields the records in data one after the other, up to the first that is cut."""
    stream = BytesIO(data)
    position = 0
    while position < len(data):
        frame = read_frame(stream, position, len(data))
        if frame is None:
            return
        yield frame
        position = frame.end


def topics_of_chunk(data: bytes, known_channels: Container[int]) -> dict[int, str]:
    """Reads the topics by channel out of a chunk and what follows it.

    A chunk is unfolded only where an index of messages behind it is of a channel that
    is not known.
    """
    records = list(frames(data))
    indexed = {
        int.from_bytes(frame.content[:2], "little")
        for frame in records
        if frame.kind == Opcode.MESSAGE_INDEX
    }
    if all(number in known_channels for number in indexed):
        return {}
    topics = {}
    for frame in records:
        if frame.kind != Opcode.CHUNK:
            continue
        chunk: Chunk = parsed(frame.kind, frame.content)
        for inner in frames(unfolded(chunk)):
            if inner.kind == Opcode.CHANNEL:
                channel: Channel = parsed(inner.kind, inner.content)
                topics[channel.id] = channel.topic
    return topics


class _Content(ReadDataStream):
    """The bytes of one record; what is not there cannot be read."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data
