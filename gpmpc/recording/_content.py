"""Sorts the records of a recording: messages by topic, metadata, configuration."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.records import (
    Attachment,
    Channel,
    Message,
    Metadata,
    Schema,
    Statistics,
)

from gpmpc.exceptions import RecordingError, SettingError
from gpmpc.recording._flaws import Flaw
from gpmpc.recording._records import whole_records
from gpmpc.recording._schema import (
    CHANNELS_METADATA,
    CONFIG_ATTACHMENT,
    STEP,
    TOPICS,
    check_names,
    names_in,
)


@dataclass
class FileContent:
    """The records of a file; messages of the topics that a run is read from."""

    messages: dict[str, list[Message]] = field(
        default_factory=lambda: {topic: [] for topic in TOPICS}
    )
    counts: Counter[int] = field(default_factory=Counter)  # of messages, by channel
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    config: str = ""
    statistics: Statistics | None = None
    flaws: list[Flaw] = field(default_factory=list)

    def channel_table(self) -> dict[str, tuple[int, str]]:
        """Returns the number of messages and the schema's name, by topic."""
        table = {}
        for number, channel in self.channels.items():
            schema = self.schemas.get(channel.schema_id)
            name = "" if schema is None else schema.name
            table[channel.topic] = (self.counts[number], name)
        return table


class Names(NamedTuple):
    """The names of the states and inputs of a run."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]


def read_content(path: Path) -> FileContent:
    """Reads what is whole in a file; its flaws say what is not."""
    content = FileContent()
    for record in whole_records(path, content.flaws):
        if isinstance(record, Message):
            content.counts[record.channel_id] += 1
            topic = content.channels[record.channel_id].topic
            if topic in content.messages:
                content.messages[topic].append(record)
        elif isinstance(record, Schema):
            content.schemas[record.id] = record
        elif isinstance(record, Channel):
            content.channels[record.id] = record
        elif isinstance(record, Metadata) and record.name != CHANNELS_METADATA:
            content.metadata.setdefault(record.name, record.metadata)
        elif isinstance(record, Attachment) and record.name == CONFIG_ATTACHMENT:
            content.config = record.data.decode(errors="replace")
        elif isinstance(record, Statistics):
            content.statistics = record
    return content


def names_in_metadata(path: Path, content: FileContent) -> Names:
    """Reads the names of states and inputs out of the metadata.

    Raises:
        RecordingError: There are none, or they cannot be names.
    """
    about = content.metadata.get("run", {})
    if not {"state_names", "input_names"} <= about.keys():
        raise RecordingError(
            f"{path}: is not the recording of a run; it has no metadata about one"
        )
    return _checked(path, about["state_names"].split(), about["input_names"].split())


def names_in_schema(path: Path, content: FileContent) -> Names | None:
    """Reads the names of states and inputs out of the schema of the steps.

    Returns:
        The names; None where no such schema is left.
    """
    for channel in content.channels.values():
        schema = content.schemas.get(channel.schema_id)
        if channel.topic == STEP and schema is not None:
            names = names_in(schema.data)
            return None if names is None else _checked(path, names[0], names[1])
    return None


def _checked(path: Path, states: list[str], inputs: list[str]) -> Names:
    try:
        return Names(
            states=check_names("state_names", states),
            inputs=check_names("input_names", inputs),
        )
    except SettingError as error:
        raise RecordingError(f"{path}: its metadata are damaged; {error}") from error
