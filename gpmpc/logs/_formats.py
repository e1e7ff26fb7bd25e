"""The formats of log files, and the reading of a file of any of them.

A file becomes one table per topic, or a single table under the empty name. Nothing is
interpreted here. Memory and time stay in proportion to the file's size: what a file
declares or unfolds to is counted before it is allocated (``gpmpc._bounds``).

To add a format, write its reader in a file of its own, as a function with the signature
of ``LogReader``, and enter it in ``READERS``. The models are ``_npz`` for a format with
a single table, and ``_ulog`` for one with topics.
"""

from collections.abc import Iterable
from os import PathLike
from pathlib import Path

from gpmpc.exceptions import DataError, GpmpcError, check_kind
from gpmpc.logs._columns import with_unique_names
from gpmpc.logs._csv import read_csv
from gpmpc.logs._file import (
    LogFile,
    LogReader,
    ReadOptions,
    Tables,
    first_line,
    needs_extra,
)
from gpmpc.logs._mat import read_mat
from gpmpc.logs._mcap import read_mcap
from gpmpc.logs._npz import read_npz
from gpmpc.logs._parquet import read_parquet
from gpmpc.logs._rosbags import read_bag_folder, read_rosbag
from gpmpc.logs._ulog import read_ulog

#: by the ending of the file's name
READERS: dict[str, LogReader] = {
    ".csv": read_csv,
    ".csv.gz": read_csv,
    ".tsv": read_csv,
    ".tsv.gz": read_csv,
    ".txt": read_csv,
    ".txt.gz": read_csv,
    ".dat": read_csv,
    ".dat.gz": read_csv,
    ".asc": read_csv,
    ".asc.gz": read_csv,
    ".parquet": read_parquet,
    ".npz": read_npz,
    ".mat": read_mat,
    ".mcap": read_mcap,
    ".db3": read_rosbag,
    ".bag": read_rosbag,
    ".ulg": read_ulog,
}

#: files of others, by their endings, with what makes files of them that are read
CONVERTERS = {
    ".bbl": "a blackbox of Betaflight: blackbox_decode makes .csv of it",
    ".bfl": "a blackbox of Betaflight: blackbox_decode makes .csv of it",
    ".bin": "a log of ArduPilot, perhaps: mavlogdump.py --format csv --types ATT,IMU "
    "(of pymavlink) makes .csv of it, one for each type",
    ".log": "a log of ArduPilot, perhaps: mavlogdump.py --format csv --types ATT,IMU "
    "(of pymavlink) makes .csv of it, one for each type; rename other texts to .txt",
    ".tlog": "telemetry of MAVLink: mavlogdump.py --format csv --types ATTITUDE "
    "(of pymavlink) makes .csv of it, one for each type",
    ".bag.active": "an unfinished bag of ROS 1: rosbag reindex finishes it",
    ".xlsx": "a spreadsheet: save it as .csv",
    ".xls": "a spreadsheet: save it as .csv",
    ".ods": "a spreadsheet: save it as .csv",
}


def read_file(
    path: str | Path,
    topics: Iterable[str] = (),
    partial: bool = False,
    stamp: str = "",
) -> LogFile:
    """Reads the tables of a log file.

    Args:
        path: Of the file.
        topics: Those that are read; all by default.
        partial: Takes what is whole of a file that is unfinished or damaged.
        stamp: The times of a bag's messages: "header", "log", or by the rule of
            ``gpmpc.logs._bag``.

    Raises:
        SettingError: ``path`` is no path.
        DataError: The file cannot be read, or holds no rows.
    """
    check_kind("path", path, (str, PathLike), "the name of a file")
    path = Path(path)
    if not path.exists():
        raise DataError(f"{path}: no such file")
    read = _find_reader(path)
    options = ReadOptions(topics=tuple(topics), partial=partial, stamp=stamp)
    try:
        file = read(path, options)
    except GpmpcError:
        raise
    except ImportError as error:
        reason = needs_extra(error)
        raise DataError(f"{path}: this kind of file {reason}") from error
    except Exception as error:  # whatever a library raises on a damaged file
        reason = first_line(error)[:300]
        raise DataError(f"{path}: cannot be read ({reason})") from error
    _check_topics(path, file.tables, options.topics)
    if not any(len(table) for table in file.tables.values()):
        reasons = "; ".join(finding.text for finding in file.findings[:2])
        because = f" ({reasons})" if reasons else ""
        raise DataError(f"{path}: holds no rows{because}")
    tables = {topic: with_unique_names(table) for topic, table in file.tables.items()}
    return file._replace(tables=tables)


def _find_reader(path: Path) -> LogReader:
    if path.is_dir():
        return read_bag_folder
    name = path.name.lower()
    for ending, reader in READERS.items():
        if name.endswith(ending):
            return reader
    for ending, advice in CONVERTERS.items():
        if name.endswith(ending):
            raise DataError(f"{path}: is {advice}")
    raise DataError(f"{path}: unknown kind of file; known are {', '.join(READERS)}")


def _check_topics(path: Path, tables: Tables, topics: Iterable[str]) -> None:
    missing = [topic for topic in topics if topic not in tables]
    if not missing:
        return
    if not missing[0]:
        raise DataError(
            f"{path}: has topics, and the mapping names none for one of its signals"
        )
    present = ", ".join(sorted(topic for topic in tables if topic)) or "no topics"
    raise DataError(f"{path}: topic {missing[0]!r} is missing; it has {present}")
