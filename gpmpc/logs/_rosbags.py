"""Reads bags of ROS: folders of ROS 2, their SQLite files (.db3), and ROS 1's (.bag).

``rosbags`` opens the files, and has the definitions of ROS's own types for bags that
hold none. Messages are decoded as those of MCAP bags are. A folder of MCAP files needs
no other library.
"""

import bz2
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lz4.frame
import zstandard

from gpmpc._bounds import MemoryBudget
from gpmpc.exceptions import DataError
from gpmpc.logs._bag import Bag, BagChannel, read_bag
from gpmpc.logs._file import LogFile, ReadOptions, first_line
from gpmpc.logs._ros2 import Decode, ros2_decoder
from gpmpc.logs._ros_definitions import idl_as_msg, own_definition

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

METADATA = "metadata.yaml"
_PIECE = 2**20  # that is unpacked at once [bytes]
_BZ2 = b"BZh"
_LZ4 = b"\x04\x22\x4d\x18"


def read_bag_folder(path: Path, options: ReadOptions) -> LogFile:
    """Reads a folder that ROS 2 has recorded."""
    files = [file for file in sorted(path.iterdir()) if file.is_file()]
    mcap_files = [file for file in files if file.suffix == ".mcap"]
    if mcap_files:
        bag = read_bag(path, options, mcap_files)
        if bag is None:
            raise DataError(f"{path}: holds a recording of gpmpc; name the file")
        return bag
    databases = [file for file in files if file.suffix == ".db3"]
    if (path / METADATA).exists():
        return _read_with_rosbags(path, options, [path])
    if databases:
        return _read_with_rosbags(path, options, databases)
    raise DataError(
        f"{path}: is a folder without a bag: neither {METADATA} nor .mcap or .db3 files"
    )


def read_rosbag(path: Path, options: ReadOptions) -> LogFile:
    """Reads one file of SQLite (ROS 2) or of ROS 1."""
    return _read_with_rosbags(path, options, [path])


def _read_with_rosbags(
    path: Path, options: ReadOptions, parts: Sequence[Path]
) -> LogFile:
    from rosbags import rosbag1, rosbag2

    bag = Bag(path, options, MemoryBudget(path))
    for part in parts:
        bag.begin_file()
        try:
            if part.suffix == ".bag":
                with rosbag1.Reader(part) as reader:
                    _bound_chunks(reader, bag.budget)
                    _add_messages(bag, reader, version=1)
            else:
                _check_packed_files(part, bag.budget)
                with rosbag2.Reader(part) as reader:
                    if reader.compression_mode == "message":
                        raise DataError(
                            f"{part}: each message is compressed by itself; "
                            "ros2 bag convert writes them plainly"
                        )
                    _add_messages(bag, reader, version=2)
        except (rosbag1.ReaderError, rosbag2.ReaderError) as error:
            raise DataError(f"{part}: {first_line(error)}") from error
    return bag.log_file()


def _add_messages(bag: Bag, reader: Any, version: int) -> None:
    """Adds the messages of an open reader to a bag.

    Args:
        bag: Takes them.
        reader: Of ``rosbags``.
        version: Of ROS.
    """
    read_connections = []
    for connection in reader.connections:
        channel = _channel(bag, connection, version)
        bag.add_channel(connection.id, channel)
        if channel.decode is None:
            channel.messages = connection.msgcount
        else:
            read_connections.append(connection)
    if not read_connections:  # none would mean all
        return
    for connection, log_time, data in reader.messages(connections=read_connections):
        bag.add_data(bag.channels[connection.id], log_time, bytes(data))


def _channel(bag: Bag, connection: "Connection", version: int) -> BagChannel:
    """Finds the decoder of a topic's messages; none if nobody asked for them."""
    if not bag.is_asked_for(connection.topic):
        return BagChannel(connection.topic, decode=None)
    try:
        decode = _decoder(connection, bag.budget, version)
    except DataError:
        raise
    except Exception as error:  # whatever the library raises on a definition
        refusal = f"its definition cannot be read ({first_line(error)})"
        return BagChannel(connection.topic, decode=None, refusal=refusal)
    return BagChannel(connection.topic, decode)


def _decoder(connection: "Connection", budget: MemoryBudget, version: int) -> Decode:
    from rosbags.interfaces import MessageDefinitionFormat

    name = connection.msgtype
    kind, text = connection.msgdef
    if kind == MessageDefinitionFormat.IDL:
        text = idl_as_msg(name, text)
    elif kind == MessageDefinitionFormat.NONE:
        text = own_definition(name)
    return ros2_decoder(name, text, budget, version)


def _bound_chunks(reader: Any, budget: MemoryBudget) -> None:
    """Takes from the budget what the chunks of a ROS 1 bag unfold to, as they do."""

    def unpack(data: bytes) -> bytes:
        unpacker: Any
        if data.startswith(_BZ2):
            unpacker = bz2.BZ2Decompressor()
        elif data.startswith(_LZ4):
            unpacker = lz4.frame.LZ4FrameDecompressor()
        else:
            return data
        return _unpacked(data, unpacker.decompress, lambda: unpacker.eof, budget)

    for position, chunk in reader.chunks.items():
        reader.chunks[position] = chunk._replace(decompressor=unpack)


def _unpacked(
    data: bytes,
    decompress: Callable[..., bytes],
    is_done: Callable[[], bool],
    budget: MemoryBudget,
) -> bytes:
    """Unpacks data piece by piece."""
    pieces = []
    piece = decompress(data, max_length=_PIECE)
    while piece:
        budget.take(len(piece), "its chunks")
        pieces.append(piece)
        if is_done():
            break
        piece = decompress(b"", max_length=_PIECE)
    return b"".join(pieces)


def _check_packed_files(path: Path, budget: MemoryBudget) -> None:
    """Takes from the budget what packed files in a folder unfold to, on the disk."""
    if not path.is_dir():
        return
    for file in path.glob("*.zstd"):
        with file.open("rb") as packed:
            unpacked = zstandard.ZstdDecompressor().stream_reader(packed)
            while piece := unpacked.read(_PIECE):
                budget.take(len(piece), "its packed files")
