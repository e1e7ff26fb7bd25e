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
FLAWS = "flaws"  # in the ``attrs`` of tables: what is wrong with their file
Streams = dict[str, pd.DataFrame]


def read_streams(
    path: str | Path, topics: Iterable[str] = (), partial: bool = False
) -> Streams:
    """Reads the tables of a log file: all topics by default, or what is whole of an unfinished recording."""
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    name = path.name.lower().removesuffix(".gz")
    reader = next(
        (read for ending, read in _READERS.items() if name.endswith(ending)), None
    )
    if reader is None:
        raise DataError(
            f"{path}: unknown kind of file; known are {', '.join(_READERS)}"
        )
    try:
        streams = reader(path, tuple(topics), partial)
    except GpmpcError:
        raise
    except ImportError as error:
        raise DataError(
            f"{path}: this kind of file needs pip install 'gpmpc[logs]' ({error})"
        ) from error
    except Exception as error:  # whatever a library raises on a damaged file
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{path}: cannot be read ({reason})") from error
    missing = [topic for topic in topics if topic and topic not in streams]
    if missing:
        raise DataError(
            f"{path}: topic {missing[0]!r} is missing; it has {', '.join(sorted(streams)) or 'no topics'}"
        )
    if not any(len(table) for table in streams.values()):
        raise DataError(f"{path}: holds no rows")
    return streams


def _read_csv(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    options: dict[str, Any] = {"encoding": "utf-8-sig", "skipinitialspace": True}

    def first_line(delimiter: str) -> pd.Series:
        return pd.read_csv(
            path, sep=delimiter, header=None, nrows=1, dtype=str, **options
        ).iloc[0]

    delimiter = max(",;\t", key=lambda candidate: len(first_line(candidate)))
    names = first_line(delimiter).str.strip()
    if pd.to_numeric(names, errors="coerce").notna().any() or names.duplicated().any():
        raise DataError(
            f"{path}: the first line must name every column differently; got {', '.join(map(str, names))}"
        )
    with warnings.catch_warnings():  # of rows that are longer than the header
        warnings.simplefilter("error", pd.errors.ParserWarning)
        table = pd.read_csv(path, sep=delimiter, index_col=False, **options)
    return {"": table.rename(columns=str.strip)}


def _read_npz(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    with np.load(path, allow_pickle=False) as archive:
        arrays = {
            name: archive[name]
            for name in archive.files
            if archive[name].ndim in (1, 2)
        }
    columns: dict[str, np.ndarray] = {}  # pandas names arrays of different lengths
    for name, values in arrays.items():
        columns |= (
            {name: values}
            if values.ndim == 1
            else {f"{name}[{i}]": v for i, v in enumerate(values.T)}
        )
    return {"": pd.DataFrame(columns)}


def _read_mcap(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    with path.open("rb") as file:
        if (
            file.read(25)[17:] == b"\4\0\0\0ros2"
        ):  # the profile, with its length, is the first field of an MCAP file
            return _read_ros2(path, topics, partial)
    from gpmpc.recording import read_run

    run = read_run(path)
    if not run.whole and not partial:
        reasons = "; ".join(flaw.text for flaw in run.flaws)
        raise DataError(
            f"{path}: unfinished or damaged; gpmpc log recover rescues it, "
            f"partial=true takes what is whole ({reasons})"
        )
    table = run.to_pandas()
    table.attrs[FLAWS] = run.flaws
    return {"": table}


def _read_ros2(path: Path, topics: tuple[str, ...], partial: bool) -> Streams:
    from mcap.reader import NonSeekingReader
    from mcap_ros2.decoder import DecoderFactory

    from gpmpc.recording import NO_CHECKSUMS, Flaw, bag_flaws

    flaws = bag_flaws(path)
    if not partial and any(flaw.kind != NO_CHECKSUMS for flaw in flaws):
        reasons = "; ".join(flaw.text for flaw in flaws)
        raise DataError(
            f"{path}: the bag cannot be read to its end ({reasons}); "
            "partial=true takes what is whole"
        )
    rows: dict[str, list[dict[str, float]]] = {}
    with path.open("rb") as file:
        # In the file's order, because the index of a truncated file is lost.
        reader = NonSeekingReader(
            file, validate_crcs=True, decoder_factories=[DecoderFactory()]
        )
        try:
            for _, channel, message, decoded in reader.iter_decoded_messages(
                log_time_order=False
            ):
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
                raise DataError(
                    f"{path}: the bag cannot be read to its end ({error}){hint}"
                ) from error
            text = f"the bag cannot be read to its end ({error})"
            flaws += (Flaw("damaged", 1, text),)
    streams = {topic: pd.DataFrame(messages) for topic, messages in rows.items()}
    for table in streams.values():
        table.attrs[FLAWS] = flaws
    return streams


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
        streams[
            data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
        ] = table
    return streams


_READERS: dict[str, Callable[[Path, tuple[str, ...], bool], Streams]] = {
    ".csv": _read_csv,
    ".tsv": _read_csv,
    ".parquet": lambda path, *_: {"": pd.read_parquet(path)},
    ".npz": _read_npz,
    ".mcap": _read_mcap,
    ".ulg": _read_ulog,
}
