"""Reads log files as tables: CSV, Parquet, NumPy archives, recordings of this package, ROS 2 bags and PX4 logs.

A file becomes one table a stream: a single one under the empty name, or one a topic, whose column ``timestamp`` holds
the time [s]. Nothing is interpreted here.
"""

import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gpmpc.exceptions import DataError, GpmpcError

STAMP = "timestamp"  # [s], of streams with a topic
Streams = dict[str, pd.DataFrame]


def read_streams(path: str | Path, topics: Iterable[str] = (), partial: bool = False) -> Streams:
    """Reads the tables of a log file: all topics by default, or what is whole of an unfinished recording."""
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    name = path.name.lower().removesuffix(".gz")
    reader = next((read for ending, read in _READERS.items() if name.endswith(ending)), None)
    if reader is None:
        raise DataError(f"{path}: unknown kind of file; known are {', '.join(_READERS)}")
    try:
        streams = reader(path, tuple(topics), partial)
    except GpmpcError:
        raise
    except ImportError as error:
        raise DataError(f"{path}: this kind of file needs pip install 'gpmpc[logs]' ({error})") from error
    except Exception as error:  # whatever a library raises on a damaged file
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{path}: cannot be read ({reason})") from error
    missing = [topic for topic in topics if topic and topic not in streams]
    if missing:
        raise DataError(f"{path}: topic {missing[0]!r} is missing; it has {', '.join(sorted(streams)) or 'no topics'}")
    if not any(len(table) for table in streams.values()):
        raise DataError(f"{path}: holds no rows")
    return streams


def _read_csv(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    import gzip

    opened = gzip.open if path.suffix.lower() == ".gz" else open
    with opened(path, "rt", encoding="utf-8-sig") as file:
        header = file.readline()
    delimiter = max(",;\t", key=header.count)
    names = [name.strip().strip('"') for name in header.strip().split(delimiter)]
    if pd.to_numeric(pd.Series(names), errors="coerce").notna().any():
        raise DataError(f"{path}: the first line holds numbers; expected a header with the names of the columns")
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise DataError(f"{path}: column {twice[0]!r} stands there twice")
    with warnings.catch_warnings():  # of rows that are longer than the header
        warnings.simplefilter("error", pd.errors.ParserWarning)
        table = pd.read_csv(path, sep=delimiter, encoding="utf-8-sig", skipinitialspace=True, index_col=False)
    return {"": table.rename(columns=str.strip)}


def _read_npz(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files if archive[name].ndim in (1, 2)}
    lengths = {name: len(values) for name, values in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(f"{path}: arrays must have the same number of rows; got {lengths}")
    tables = [
        pd.DataFrame(a, columns=[name] if a.ndim == 1 else [f"{name}[{i}]" for i in range(a.shape[1])])
        for name, a in arrays.items()
    ]
    return {"": pd.concat(tables, axis=1) if tables else pd.DataFrame()}


def _read_mcap(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    with path.open("rb") as file:
        head = file.read(512)
    if head[:5] != b"\x89MCAP":
        raise DataError(f"{path}: not an MCAP file")
    length = int.from_bytes(head[17:21], "little")  # of the profile, the first field of the first record
    if head[21 : 21 + length] == b"ros2":
        return _read_ros2(path, topics, partial)
    from gpmpc.recording import read_run

    run = read_run(path)
    if not run.finished and not partial:
        raise DataError(
            f"{path}: unfinished or damaged; gpmpc log recover rescues it, partial=true takes what is whole"
        )
    return {"": run.to_pandas()}


def _read_ros2(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    from mcap.reader import NonSeekingReader
    from mcap_ros2.decoder import DecoderFactory

    rows: dict[str, list[dict[str, float]]] = {}
    with path.open("rb") as file:
        # In the file's order, because the index of a truncated file is lost.
        reader = NonSeekingReader(file, decoder_factories=[DecoderFactory()])
        try:
            for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
                known = rows.setdefault(channel.topic, [])
                if topics and channel.topic not in topics:
                    continue
                header = getattr(decoded, "header", None)
                stamp = message.log_time / 1e9
                if header is not None and (header.stamp.sec or header.stamp.nanosec):
                    stamp = header.stamp.sec + header.stamp.nanosec / 1e9
                known.append({STAMP: stamp, **dict(_fields(decoded, ""))})
        except Exception as error:
            if not (partial and rows):
                hint = "" if partial else "; partial=true takes what is whole"
                raise DataError(f"{path}: the bag cannot be read to its end ({error}){hint}") from error
    return {topic: pd.DataFrame(messages) for topic, messages in rows.items()}


def _fields(message: Any, prefix: str) -> Iterable[tuple[str, float]]:
    """The numbers of a ROS message with their paths, such as ("pose.position.x", 1.5)."""
    for name in message.__slots__:
        value, path = getattr(message, name), f"{prefix}{name}"
        if isinstance(value, bool | int | float):
            yield path, float(value)
        elif hasattr(value, "__slots__"):
            yield from _fields(value, f"{path}.")
        elif isinstance(value, list | tuple | np.ndarray) and len(value) <= 64:
            for i, entry in enumerate(value):
                if isinstance(entry, int | float | np.number):
                    yield f"{path}[{i}]", float(entry)


def _read_ulog(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    from pyulog import ULog

    log = ULog(str(path))
    if log.file_corruption and not partial:
        raise DataError(f"{path}: damaged; partial=true takes what is whole")
    streams = {}
    for data in log.data_list:
        table = pd.DataFrame(data.data)
        table[STAMP] = table["timestamp"] * 1e-6
        streams[data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"] = table
    return streams


_READERS: dict[str, Callable[[Path, tuple[str, ...], bool], Streams]] = {
    ".csv": _read_csv,
    ".tsv": _read_csv,
    ".parquet": lambda path, *_: {"": pd.read_parquet(path)},
    ".npz": _read_npz,
    ".mcap": _read_mcap,
    ".ulg": _read_ulog,
}
