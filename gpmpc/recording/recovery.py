"""Problem: a run was killed while it was being recorded, and an MCAP reader takes a file without footer for empty.

``recover`` writes what is whole (see ``records``) to a new file with index and footer. That file says that it was
recovered, so that nobody takes its run for a complete one, and it is read once before it gets its name.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.records import Attachment, Channel, Footer, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from gpmpc.exceptions import RecordingError
from gpmpc.files import whole_file
from gpmpc.recording.reader import RECOVERED, read_run
from gpmpc.recording.records import whole_records
from gpmpc.recording.writer import CHUNK_SIZE


@dataclass(frozen=True)
class Recovery:
    """What was found.

    Attributes:
        messages: Number of messages.
        seconds: Time between the first and the last of them [s].
        finished: The run had been recorded to its end; nothing was missing.
    """

    messages: int
    seconds: float
    finished: bool


def recover(path: str | Path, output: str | Path) -> Recovery:
    """Writes everything whole in a recording to a new one with index and footer.

    Args:
        path: A file that a crash left without footer.
        output: The new file; it appears when it is complete.

    Raises:
        RecordingError: There is no run to recover, or the output cannot be written.
    """
    path, output = Path(path), Path(output)
    try:
        if output.exists() and path.exists() and output.samefile(path):
            raise RecordingError(f"{output}: a file cannot be recovered into itself; name another output")
        with whole_file(output) as file:
            messages, seconds = _copy(path, file)
            file.flush()
            try:
                run = read_run(file.name)
            except RecordingError as error:
                raise RecordingError(str(error).replace(file.name, str(path), 1)) from error
    except OSError as error:
        raise RecordingError(f"{output}: cannot be written: {error.strerror or error}") from error
    return Recovery(messages, seconds, run.finished)


def _copy(path: Path, file: BinaryIO) -> tuple[int, float]:
    """Number of the messages, and the time between the first and the last of them [s]."""
    writer = Writer(file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile="", library="gpmpc")
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    times, count, finished = [], 0, False
    for record in whole_records(path):
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
    if not finished:
        writer.add_metadata(RECOVERED, {"messages": str(count)})
    writer.finish()
    return count, (times[1] - times[0]) / 1e9 if times else 0.0
