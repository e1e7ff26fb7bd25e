"""Problem: a run was killed while it was being recorded, and an MCAP reader takes a file without footer for empty.

Records follow each other with their lengths, so the file is read from its start as a stream up to the last record that
is whole; a chunk counts if its checksum is right. ``recover`` writes them to a new file with index and footer. (MCAP's
own stream reader hands out a record that is cut off as if it were shorter; what is read here is whole or not there.)
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from gpmpc.exceptions import RecordingError
from gpmpc.recording.writer import CHUNK_SIZE


class _Whole:
    """A stream whose ``read`` gives all the bytes asked for, or none."""

    def __init__(self, file: BinaryIO):
        self._file = file

    def read(self, length: int) -> bytes:
        data = self._file.read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def whole_records(path: str | Path) -> Iterator[McapRecord]:
    """Schemas, channels, messages, metadata and attachments up to the first broken record; a footer if all are whole.

    Args:
        path: An MCAP file, finished or not.

    Raises:
        RecordingError: There is no such file, or it is no MCAP file.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            magic = file.read(len(MCAP0_MAGIC))
            if magic != MCAP0_MAGIC:
                reason = "is empty: its recording was killed before it began" if not magic else "is not an MCAP file"
                raise RecordingError(f"{path}: {reason}")
            file.seek(0)
            yield from _data_records(file)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def _data_records(file: BinaryIO) -> Iterator[McapRecord]:
    records, summary = StreamReader(_Whole(file), emit_chunks=True).records, False
    while True:
        try:
            record = next(records)
            inside = breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
        except (McapError, CRCValidationError, zstandard.ZstdError, ValueError, StopIteration):
            return
        if isinstance(record, DataEnd):
            summary = True  # from here on schemas and channels are repeated
        elif isinstance(record, Footer):
            try:
                next(records)  # the magic bytes at the end
            except StopIteration:
                yield record
            except (McapError, struct.error):
                pass
            return
        elif not summary:
            for item in inside:
                if isinstance(item, Schema | Channel | Message | Metadata | Attachment):
                    yield item


@dataclass(frozen=True)
class Recovery:
    """What was found.

    Attributes:
        messages: Number of messages.
        seconds: Time between the first and the last of them [s].
        finished: The file had been closed; nothing was missing.
    """

    messages: int
    seconds: float
    finished: bool


def recover(path: str | Path, output: str | Path) -> Recovery:
    """Writes everything whole in a file to a new one with index and footer.

    Args:
        path: A file that a crash left without footer.
        output: The new file; it appears when it is complete.

    Raises:
        RecordingError: There is nothing to recover, or the output cannot be written.
    """
    path, output = Path(path), Path(output)
    if output.exists() and path.exists() and output.samefile(path):
        raise RecordingError(f"{output}: a file cannot be recovered into itself; name another output")
    records = whole_records(path)
    first = next(records, None)  # before anything is written
    if first is None:
        raise RecordingError(f"{path}: holds no whole record")
    partial = output.with_name(f".{output.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            found = _copy(first, records, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, output)
    except OSError as error:
        raise RecordingError(f"{output}: cannot be written: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
    return found


def _copy(first: McapRecord, records: Iterator[McapRecord], file: BinaryIO) -> Recovery:
    writer = Writer(file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD)
    writer.start(profile="", library="gpmpc")
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    times, count, finished = [], 0, False
    record: McapRecord | None = first
    while record is not None:
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            schema = schemas[record.schema_id]
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schema, record.metadata
            )
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            times = [min(times[0], record.log_time), max(times[1], record.log_time)] if times else [record.log_time] * 2
            count += 1
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        finished = finished or isinstance(record, Footer)
        record = next(records, None)
    if not finished:
        writer.add_metadata("recovered", {"messages": str(count)})
    writer.finish()
    return Recovery(count, (times[1] - times[0]) / 1e9 if times else 0.0, finished)
