"""Finds the decoder of the messages of a bag's channel: ROS 2, JSON, or protobuf.

Another encoding is entered in ``find_decoder``.
"""

import json
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from mcap.records import Channel, Schema

from gpmpc._bounds import MemoryBudget
from gpmpc.exceptions import GpmpcError
from gpmpc.logs._file import (
    MOST_COLUMNS,
    are_names,
    first_line,
    names_of_list,
    needs_extra,
)
from gpmpc.logs._ros2 import LISTED, Cells, Decode, ros2_decoder
from gpmpc.logs._ros_definitions import idl_as_msg

_Fields = Iterable[tuple[str, Any]]
_LONGEST = 4 * 2**20  # of a message in JSON or protobuf [bytes]
READ = "cdr with ros2msg or ros2idl, json, and protobuf are"


class UnreadError(Exception):
    """Messages are of a kind that is not read; the text says why."""


def find_decoder(
    channel: Channel, schema: Schema | None, budget: MemoryBudget
) -> Decode:
    """Returns the function that reads the numbers of a channel's messages.

    Raises:
        UnreadError: Messages of this kind are not read; the text says why.
    """
    message = channel.message_encoding
    definition = schema.encoding if schema else ""
    try:
        if message == "cdr" and schema and definition == "ros2msg":
            text = schema.data.decode()
            return ros2_decoder(schema.name, text, budget)
        if message == "cdr" and schema and definition == "ros2idl":
            text = idl_as_msg(schema.name, schema.data.decode())
            return ros2_decoder(schema.name, text, budget)
        if message == "json":
            return _decode_json
        if message == "protobuf" and schema and definition == "protobuf":
            return _protobuf_decoder(schema)
    except GpmpcError:
        raise
    except ImportError as error:
        raise UnreadError(f"it {needs_extra(error)}") from error
    except Exception as error:  # whatever a library raises on a definition
        reason = first_line(error)
        raise UnreadError(f"its definition cannot be read ({reason})") from error
    described = f"{message or 'nothing'} with {definition or 'no definition'}"
    raise UnreadError(f"it is encoded as {described}, which is not read; {READ}")


def _decode_json(data: bytes) -> Cells:
    _check_length(data)
    content = json.loads(data)
    if not isinstance(content, dict):
        raise ValueError(f"it is {type(content).__name__} in JSON; expected an object")
    cells: Cells = {}
    _collect(content, "", cells, _json_fields)
    return cells


def _protobuf_decoder(schema: Schema) -> Decode:
    from mcap_protobuf.decoder import DecoderFactory

    parse = DecoderFactory().decoder_for("protobuf", schema)
    if parse is None:
        raise ValueError("it is no set of file descriptors")

    def decode(data: bytes) -> Cells:
        _check_length(data)
        cells: Cells = {}
        _collect(parse(data), "", cells, _protobuf_fields)
        return cells

    return decode


def _json_fields(value: Any) -> _Fields | None:
    """Returns the fields of an object; None of what is none."""
    return value.items() if isinstance(value, dict) else None


def _protobuf_fields(value: Any) -> _Fields | None:
    """Returns the fields of a message, and of those inside it that are set.

    Numbers that are not set are zero, as everywhere in protobuf. None of what is no
    message.
    """
    if not hasattr(value, "DESCRIPTOR"):
        return None
    fields = ((f.name, getattr(value, f.name)) for f in value.DESCRIPTOR.fields)
    return (
        (name, content)
        for name, content in fields
        if not hasattr(content, "DESCRIPTOR") or value.HasField(name)
    )


def _collect(
    message: Any,
    prefix: str,
    cells: Cells,
    fields_of: Callable[[Any], _Fields | None],
) -> None:
    """Collects the numbers of a message and of those inside it."""
    lists: dict[str, Sequence[Any]] = {}
    for name, value in fields_of(message) or ():
        path = f"{prefix}{name}"
        if isinstance(value, bool | int | float):
            cells[path] = float(value)
        elif fields_of(value) is not None:
            _collect(value, f"{path}.", cells, fields_of)
        elif _is_short_list(value):
            for i, entry in enumerate(value):
                if isinstance(entry, bool | int | float):
                    cells[f"{path}[{i}]"] = float(entry)
            lists[path] = value
        if len(cells) > MOST_COLUMNS:
            raise ValueError(f"it holds more than {MOST_COLUMNS} numbers")
    _add_names(cells, lists)


def _add_names(cells: Cells, lists: Mapping[str, Sequence[Any]]) -> None:
    """Adds checksums of names, for lists of numbers that are as long as the names."""
    all_names = [
        [*texts]
        for path, texts in lists.items()
        if are_names(path) and all(isinstance(text, str) for text in texts)
    ]
    for path in lists:
        if f"{path}[0]" not in cells:
            continue
        names = [one for one in all_names if len(one) == len(lists[path])]
        if names:
            cells[names_of_list(path)] = float(zlib.crc32(repr(names).encode()))


def _is_short_list(value: Any) -> bool:
    is_text = isinstance(value, str | bytes)
    is_map = hasattr(value, "keys")  # of protobuf
    return hasattr(value, "__len__") and not (is_text or is_map or len(value) > LISTED)


def _check_length(data: bytes) -> None:
    if len(data) > _LONGEST:
        raise ValueError(f"it has {len(data)} bytes; {_LONGEST} at most are read")
