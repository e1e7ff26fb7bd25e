"""Reads log files as tables: CSV, Parquet, NumPy archives, recordings of this package, ROS 2 bags and PX4 logs.

A file becomes one table a stream: a single one under the empty name, or one a topic. Nothing is interpreted here.
Memory and time stay in proportion to the file's size: what a file declares or unfolds to is counted before it is
allocated (``gpmpc._bounds``).
"""

import gzip
import io
import math
import warnings
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gpmpc._bounds import Room
from gpmpc.exceptions import DataError, GpmpcError
from gpmpc.logs._bags import has_own_profile, read_bag
from gpmpc.logs._csv import DELIMITERS, CsvText, open_csv
from gpmpc.logs._file import (
    NUMBER,
    TEXT,
    LogFile,
    check_column_count,
    flaw_findings,
    run_name,
)
from gpmpc.logs._log import Finding
from gpmpc.logs._ulogs import read_ulog

_DELIMITERS = [mark.encode() for mark in DELIMITERS]
LONGEST_LINE = 2**20  # of a text file [bytes]
# pandas before version 3 reads some numbers wrong in their last digit else
_EXACT: dict[str, Any] = (
    {"float_precision": "round_trip"} if int(pd.__version__.split(".")[0]) < 3 else {}
)
_PART = 500_000  # cells of a text file that are parsed at once
_QUOTED = 3  # further copies of a text in quotes, which may stand over many lines


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
            ``gpmpc.logs._bags``.

    Raises:
        DataError: The file cannot be read, or holds no rows.
    """
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
        file = reader(path, tuple(topics), partial, stamp)
    except GpmpcError:
        raise
    except ImportError as error:
        raise DataError(
            f"{path}: this kind of file needs pip install 'gpmpc[logs]' ({error})"
        ) from error
    except Exception as error:  # whatever a library raises on a damaged file
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{path}: cannot be read ({reason[:300]})") from error
    streams = file.streams
    missing = [topic for topic in topics if topic not in streams]
    if missing:
        known = ", ".join(sorted(topic for topic in streams if topic)) or "no topics"
        what = f"topic {missing[0]!r} is missing; it has {known}"
        if not missing[0]:
            what = "has topics, and the mapping names none for one of its signals"
        raise DataError(f"{path}: {what}")
    for topic, table in streams.items():
        if table.columns.has_duplicates:
            twice = table.columns[table.columns.duplicated()][0]
            where = f"{path}, {topic}" if topic else str(path)
            raise DataError(f"{where}: column {twice!r} stands there twice")
    if not any(len(table) for table in streams.values()):
        reasons = "; ".join(finding.text for finding in file.findings[:2])
        raise DataError(f"{path}: holds no rows{f' ({reasons})' if reasons else ''}")
    return file


def _read_csv(path: Path, *_: Any) -> LogFile:
    room = Room(path)
    _check_text(path, room)
    with _open(path) as file:
        csv = open_csv(str(path), file)
        with warnings.catch_warnings():  # of rows that are longer than the header
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = _read_in_parts(csv, room)
    findings = ()
    if csv.is_cut:
        text = "the last line has no end, and may be cut within a number: left out"
        findings = (Finding("cut line", run_name(path), 1, text),)
    return LogFile({"": table.rename(columns=str.strip)}, findings)


def _open(path: Path) -> io.BufferedReader:
    """Opens a file, unpacked where it is packed."""
    if path.name.lower().endswith(".gz"):
        return io.BufferedReader(gzip.GzipFile(path))
    return path.open("rb")


def _check_text(path: Path, room: Room) -> None:
    """Counts what a text file unfolds to, before anything of it is parsed."""
    with _open(path) as file:
        first_line = file.readline(LONGEST_LINE)
        check_column_count(path, max(map(first_line.count, _DELIMITERS)) + 1)
        block = first_line
        copies = 1
        while block:
            lines = max(block.count(b"\n"), block.count(b"\r"))
            if len(block) == LONGEST_LINE and not lines:
                raise DataError(f"{path}: has a line of more than {LONGEST_LINE} bytes")
            if b'"' in block:
                copies = 1 + _QUOTED
            cells = max(map(block.count, _DELIMITERS)) + lines
            room.take(copies * len(block) + NUMBER * cells, "its text")
            block = file.read(LONGEST_LINE)


def _read_in_parts(csv: CsvText, room: Room) -> pd.DataFrame:
    """Parses text part by part, so that texts are counted before there are many."""
    parts: list[pd.DataFrame] = []
    texts: set[Any] = set()  # names of columns that hold some
    with pd.read_csv(
        csv.text,
        sep=csv.delimiter,
        decimal=csv.decimal,
        chunksize=max(_PART // len(csv.names), 1),
        index_col=False,
        skipinitialspace=True,
        **_EXACT,
    ) as reader:
        for part in reader:
            is_text = part.select_dtypes(exclude=["number", "bool"])
            room.take(TEXT * is_text.size, "its texts")
            texts |= {*is_text.columns}
            parts.append(part)
    # Numbers in a column that also holds texts become objects, like texts.
    numbers = sum(part[column].size for part in parts for column in texts)
    room.take(TEXT * numbers, "its texts")
    return pd.concat(parts, ignore_index=True)


class _Array(NamedTuple):
    """What an archive says of an array before it is read."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def is_table(self) -> bool:
        """Whether it has columns of numbers or short texts."""
        return len(self.shape) in (1, 2) and self.dtype.kind in "biufSU"


def _read_npz(path: Path, *_: Any) -> LogFile:
    room = Room(path)
    declared = _declared_arrays(path)
    tables = {name: array for name, array in declared.items() if array.is_table}
    widths = {name: math.prod(array.shape[1:]) for name, array in tables.items()}
    check_column_count(path, sum(widths.values()))
    for name, array in tables.items():
        is_number = array.dtype.kind in "biuf"
        of_cell = NUMBER if is_number else TEXT + 2 * array.dtype.itemsize
        what = f"array {name!r} of shape {array.shape}"
        room.take(math.prod(array.shape) * of_cell, what)
    columns: dict[str, np.ndarray] = {}  # pandas names arrays of different lengths
    with np.load(path, allow_pickle=False) as archive:
        for name, array in tables.items():
            values = archive[name]
            if len(array.shape) == 1:
                columns[name] = values
            else:
                columns |= {f"{name}[{i}]": v for i, v in enumerate(values.T)}
    others = sorted(declared.keys() - tables.keys())
    return LogFile({"": pd.DataFrame(columns)}, _left_out(path, others))


def _left_out(path: Path, names: list[str]) -> tuple[Finding, ...]:
    """What is said of columns that hold no numbers; nothing where there are none."""
    if not names:
        return ()
    text = f"{', '.join(names[:5])}: no columns of numbers, left out"
    return (Finding("not read", run_name(path), len(names), text),)


def _declared_arrays(path: Path) -> dict[str, _Array]:
    """The arrays of an archive by their heads, without their contents."""
    headers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise DataError(f"{path}: array {name!r} is compressed in another way")
            with archive.open(member) as file:
                header = headers.get(np.lib.format.read_magic(file))
                if header is None:  # of structured arrays, which are no columns
                    arrays[name] = _Array((), np.dtype(object))
                    continue
                shape, _, dtype = header(file)
            size = math.prod(shape) * dtype.itemsize
            if min(shape, default=0) < 0 or (
                dtype.kind != "O" and size > member.file_size
            ):
                raise DataError(f"{path}: array {name!r} is shorter than its head says")
            arrays[name] = _Array(shape, dtype)
    return arrays


def _read_parquet(path: Path, *_: Any) -> LogFile:
    """Reads the columns of numbers and texts.

    Encoded columns may hold far more than their bytes: rows are counted for numbers,
    and texts stay in their dictionaries, or are left out where they have another code.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    room = Room(path)
    with pq.ParquetFile(path) as file:
        schema = file.schema_arrow
        metadata = file.metadata
        groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    rows = max(metadata.num_rows, sum(group.num_rows for group in groups))
    check_column_count(path, len(schema))
    check_column_count(path, metadata.num_columns)
    room.take(sum(group.total_byte_size for group in groups), "its pages")
    expanding = {
        group.column(i).path_in_schema
        for group in groups
        for i in range(group.num_columns)
        if "DELTA_BYTE_ARRAY" in group.column(i).encodings
    }
    are_numbers = (
        pa.types.is_integer,
        pa.types.is_floating,
        pa.types.is_decimal,
        pa.types.is_boolean,
        pa.types.is_timestamp,
        pa.types.is_duration,
        pa.types.is_null,
    )
    numbers = []
    texts = []
    for field in schema:
        kind = (
            field.type.value_type if pa.types.is_dictionary(field.type) else field.type
        )
        is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
        if is_text and field.name not in expanding:
            texts.append(field.name)
        elif any(is_number(kind) for is_number in are_numbers):
            numbers.append(field.name)
    used = [name for name in schema.names if name in {*numbers, *texts}]
    room.take(
        rows * (NUMBER * len(used) + TEXT * len(texts)),
        f"{rows} rows of {len(used)} columns",
    )
    with pq.ParquetFile(path, read_dictionary=texts) as file:
        content = file.read(columns=used if len(used) < len(schema) else None)
    for i, field in enumerate(content.schema):
        if pa.types.is_decimal(field.type):
            exact = content.column(i)
            content = content.set_column(i, field.name, exact.cast(pa.float64()))
    table = content.to_pandas(ignore_metadata=True)
    for name in table.select_dtypes("category"):
        table[name] = table[name].astype(object)
    table = table.loc[:, [not n.startswith("__index_level_") for n in table.columns]]
    others = [name for name in schema.names if name not in used]
    return LogFile({"": table}, _left_out(path, others))


def _read_mcap(
    path: Path, topics: tuple[str, ...], partial: bool, stamp: str
) -> LogFile:
    bag = None
    if not has_own_profile(path):
        bag = read_bag(path, topics, partial, stamp)
    if bag is not None:
        return bag
    from gpmpc.recording import read_run

    run = read_run(path)
    if not run.whole and not partial:
        reasons = "; ".join(flaw.text for flaw in run.flaws)
        raise DataError(
            f"{path}: unfinished or damaged; gpmpc log recover rescues it, "
            f"partial=true takes what is whole ({reasons})"
        )
    return LogFile({"": run.to_pandas()}, tuple(flaw_findings(path, run.flaws)))


def _read_ulog(path: Path, topics: tuple[str, ...], partial: bool, _: str) -> LogFile:
    return read_ulog(path, topics, partial)


_READERS: dict[str, Callable[[Path, tuple[str, ...], bool, str], LogFile]] = {
    ".csv": _read_csv,
    ".tsv": _read_csv,
    ".parquet": _read_parquet,
    ".npz": _read_npz,
    ".mcap": _read_mcap,
    ".ulg": _read_ulog,
}
