"""Reads the columns of numbers and texts of Parquet files.

Encoded columns may hold far more than their bytes. So rows are counted for numbers, and
texts stay in their dictionaries, or are left out where they are encoded otherwise.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from gpmpc._bounds import MemoryBudget
from gpmpc.logs._file import (
    NUMBER_BYTES,
    TEXT_BYTES,
    LogFile,
    ReadOptions,
    check_column_count,
    unread_columns,
)

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

# names that pandas gives the columns of an index without a name, which is the time in
# many logs
_INDEX_NAMES = {"__index_level_0__": "index", "__index_level_1__": "index 2"}
_EXPANDING = "DELTA_BYTE_ARRAY"  # the encoding of texts that repeats their beginnings


def read_parquet(path: Path, options: ReadOptions) -> LogFile:
    """Reads a file as one table."""
    import pyarrow.parquet as pq

    budget = MemoryBudget(path)
    with pq.ParquetFile(path) as file:
        schema = file.schema_arrow
        metadata = file.metadata
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    rows = max(metadata.num_rows, sum(group.num_rows for group in groups))
    check_column_count(path, len(schema))
    check_column_count(path, metadata.num_columns)
    budget.take(sum(group.total_byte_size for group in groups), "its pages")

    texts = _text_columns(schema, groups)
    columns = [
        field.name
        for field in schema
        if field.name in texts or _holds_numbers(_value_type(field))
    ]
    bytes_per_row = NUMBER_BYTES * len(columns) + TEXT_BYTES * len(texts)
    budget.take(rows * bytes_per_row, f"{rows} rows of {len(columns)} columns")

    with pq.ParquetFile(path, read_dictionary=texts) as file:
        content = file.read(columns=columns if len(columns) < len(schema) else None)
    table = _as_frame(content)
    unread = [name for name in schema.names if name not in columns]
    return LogFile({"": table}, unread_columns(path, unread))


def _text_columns(schema: "pa.Schema", groups: "list[pq.RowGroupMetaData]") -> list:
    """Lists the columns of texts whose size follows from the file's."""
    import pyarrow as pa

    expanding = {
        group.column(i).path_in_schema
        for group in groups
        for i in range(group.num_columns)
        if _EXPANDING in group.column(i).encodings
    }
    texts = []
    for field in schema:
        kind = _value_type(field)
        is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
        if is_text and field.name not in expanding:
            texts.append(field.name)
    return texts


def _value_type(field: "pa.Field") -> "pa.DataType":
    import pyarrow as pa

    if pa.types.is_dictionary(field.type):
        return field.type.value_type
    return field.type


def _holds_numbers(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    return (
        pa.types.is_integer(kind)
        or pa.types.is_floating(kind)
        or pa.types.is_decimal(kind)
        or pa.types.is_boolean(kind)
        or pa.types.is_timestamp(kind)
        or pa.types.is_duration(kind)
        or pa.types.is_null(kind)
    )


def _as_frame(content: "pa.Table") -> pd.DataFrame:
    """Makes a frame of plain columns: decimals as numbers, texts as objects."""
    import pyarrow as pa

    for i, field in enumerate(content.schema):
        if pa.types.is_decimal(field.type):
            exact = content.column(i)
            content = content.set_column(i, field.name, exact.cast(pa.float64()))
    table = content.to_pandas(ignore_metadata=True)
    for name in table.select_dtypes("category"):
        table[name] = table[name].astype(object)
    free = {old: new for old, new in _INDEX_NAMES.items() if new not in table}
    return table.rename(columns=free)
