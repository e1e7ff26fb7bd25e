"""Makes one row of rows of one stamp that hold different signals.

Programs that write several streams into one table give each its own rows, and leave
the columns of the others empty.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from gpmpc._dynamics import Array
from gpmpc.logs._findings import RunFindings


class TimedRows(NamedTuple):
    """Rows of a table, and their times."""

    table: pd.DataFrame  # with K rows
    times: Array  # (K,) [s]


def merge_rows(
    rows: TimedRows, columns: Sequence[str], findings: RunFindings
) -> TimedRows:
    """Makes one row of those of one stamp, where none contradicts another.

    Rows that repeat a stamp and have nothing to add stay as they are, and so do rows of
    which two have different values in one column.

    Args:
        rows: In the order of the file.
        columns: Those that are used.
        findings: Takes how many rows went into others.
    """
    table, times = rows
    used = [column for column in dict.fromkeys(columns) if column in table]
    is_shared = pd.Series(times).duplicated(keep=False).to_numpy()
    values = table.loc[is_shared, used]
    if not values.isna().to_numpy().any():
        return rows
    stamps = times[is_shared]
    by_stamp = values.groupby(stamps)
    numbers = by_stamp.ngroup().to_numpy()  # of the stamp of each row
    has_one_value = (by_stamp.nunique() <= 1).all(axis=1).to_numpy()
    is_first = ~pd.Series(stamps).duplicated().to_numpy()
    filled = by_stamp.bfill()
    is_filled = (values.isna() & filled.notna()).any(axis=1).to_numpy()
    gains = np.zeros(len(has_one_value), dtype=bool)
    gains[numbers[is_first & is_filled]] = True
    is_merged = (has_one_value & gains)[numbers]
    count = int((is_merged & ~is_first).sum())
    if not count:
        return rows
    text = f"{count} rows add signals to a row of the same stamp: taken as one with it"
    findings.add("rows of one stamp", count, text)

    first_rows = values.index[is_merged & is_first]
    merged = table.copy()
    for column in used:
        if values[column].isna().any():
            merged.loc[first_rows, column] = filled.loc[first_rows, column]
    stays = np.ones(len(table), dtype=bool)
    stays[is_shared] = is_first | ~is_merged
    return TimedRows(merged[stays], times[stays])
