"""Rescues what is whole in a recording that a crash left without an end."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from gpmpc._calls import explains_arguments
from gpmpc._files import whole_file
from gpmpc.exceptions import RecordingError
from gpmpc.recording._flaws import RECOVERED, Flaw
from gpmpc.recording._read_run import read_run
from gpmpc.recording._records import whole_records
from gpmpc.recording._run import Run
from gpmpc.recording._schema import CHANNELS_METADATA, RECOVERY_METADATA


@explains_arguments
def recover(path: str | Path, output: str | Path) -> Run:
    """Writes everything whole in a recording to a new file with index, and reads that.

    Args:
        path: A file that a crash left without an end, or that is damaged; an MCAP
            reader takes it for empty.
        output: The new file, which says that it was recovered and what is missing; it
            appears when it is complete and has been read.

    Raises:
        RecordingError: There is no run to recover, or the output cannot be written.
    """
    path = Path(path)
    output = Path(output)
    run = read_run(path)
    try:
        if output.exists() and path.exists() and output.samefile(path):
            raise RecordingError(
                f"{output}: a file cannot be recovered into itself; name another output"
            )
        with whole_file(output) as file:
            _write_copy(path, file, run.flaws)
            file.flush()
            return replace(read_run(file.name), path=output)
    except OSError as error:
        raise RecordingError(
            f"{output}: cannot be written: {error.strerror or error}"
        ) from error


def _write_copy(path: Path, file: BinaryIO, flaws: Sequence[Flaw]) -> None:
    """Copies the whole records of a file, and notes its flaws."""
    copy = _Copy(file)
    for record in whole_records(path):
        copy.add(record)
    copy.finish(flaws)


class _Copy:
    """A copy of a recording, in which schemas and channels have new numbers."""

    def __init__(self, file: BinaryIO) -> None:
        self._writer = Writer(
            file, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._writer.start(profile="gpmpc", library="gpmpc")
        self._schemas: dict[int, int] = {}  # numbers in the copy, by those in the file
        self._channels: dict[int, int] = {}
        self._topics: dict[str, str] = {}  # of ``CHANNELS_METADATA``
        self._messages = 0
        self._lists_topics = False
        self._was_recovered = False
        self._earlier_reasons = ""  # what was wrong with the file before this one

    def add(self, record: McapRecord) -> None:
        """Copies a record."""
        if isinstance(record, Schema):
            self._add_schema(record)
        elif isinstance(record, Channel):
            self._add_channel(record)
        elif isinstance(record, Message):
            self._writer.add_message(
                channel_id=self._channels[record.channel_id],
                log_time=record.log_time,
                data=record.data,
                publish_time=record.publish_time,
                sequence=record.sequence,
            )
            self._messages += 1
        elif isinstance(record, Metadata) and record.name == CHANNELS_METADATA:
            self._lists_topics = True
        elif isinstance(record, Metadata) and record.name == RECOVERY_METADATA:
            self._was_recovered = True
            self._earlier_reasons = record.metadata.get("flaws", "")
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                create_time=record.create_time,
                log_time=record.log_time,
                name=record.name,
                media_type=record.media_type,
                data=record.data,
            )

    def _add_schema(self, schema: Schema) -> None:
        if schema.id not in self._schemas:
            self._schemas[schema.id] = self._writer.register_schema(
                name=schema.name, encoding=schema.encoding, data=schema.data
            )

    def _add_channel(self, channel: Channel) -> None:
        if channel.id in self._channels:
            return
        number = self._writer.register_channel(
            topic=channel.topic,
            message_encoding=channel.message_encoding,
            schema_id=self._schemas.get(channel.schema_id, 0),
            metadata=channel.metadata,
        )
        self._channels[channel.id] = number
        self._topics[str(number)] = channel.topic

    def finish(self, flaws: Sequence[Flaw]) -> None:
        """Writes the topics, the flaws of the file that was copied, and the index.

        What was wrong with files that it was recovered from in turn is said first.
        """
        if self._lists_topics:
            self._writer.add_metadata(CHANNELS_METADATA, self._topics)
        earlier = self._earlier_reasons
        reasons = [earlier] if earlier else []
        for flaw in flaws:
            if flaw.kind != RECOVERED and flaw.text not in earlier:
                reasons.append(flaw.text)
        if reasons or self._was_recovered:
            about = {"messages": str(self._messages), "flaws": "; ".join(reasons)}
            self._writer.add_metadata(RECOVERY_METADATA, about)
        self._writer.finish()
