"""Makes one row of rows of one stamp that hold different signals.

Programs that write several streams into one table give each its own rows, and leave
the columns of the others empty.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from gpmpc._dynamics import Array
from gpmpc.logs._clocks import find_restarts
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
    which two have different values in one column. After a clock began anew a stamp is
    another one.

    Args:
        rows: In the order of the file.
        columns: Those that are used.
        findings: Takes how many rows went into others.
    """
    table, times = rows
    if not np.isfinite(times).all():  # which is refused where rows are ordered
        return rows
    used = [column for column in dict.fromkeys(columns) if column in table]
    parts = _parts_of_clock(times, table[used].notna().to_numpy())
    moments = pd.DataFrame({"part": parts, "stamp": times}, index=table.index)
    is_shared = moments.duplicated(keep=False).to_numpy()
    values = table.loc[is_shared, used]
    if not values.isna().to_numpy().any():
        return rows
    moments = moments[is_shared]
    by_stamp = values.groupby([moments["part"], moments["stamp"]])
    # Below, rows are those that share their stamp with another one.
    numbers = by_stamp.ngroup().to_numpy()  # of the stamp of each row
    has_one_value = (by_stamp.nunique() <= 1).all(axis=1).to_numpy()
    is_first = ~moments.duplicated().to_numpy()
    filled = by_stamp.bfill()
    is_filled = (values.isna() & filled.notna()).any(axis=1).to_numpy()
    gains = np.zeros(len(has_one_value), dtype=bool)  # of the stamps
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


def _parts_of_clock(times: Array, has_value: np.ndarray) -> np.ndarray:
    """Numbers the parts (K,) of rows between which their clock began anew.

    Streams that stand below each other, each with columns of its own, have one clock.

    Args:
        times: Of the rows (K,) [s].
        has_value: Whether a row has a value of a column (K, columns).
    """
    parts = np.zeros(len(times), dtype=int)
    begin = 0
    restarts = find_restarts(times)
    ends = np.r_[restarts, len(times)][1:]
    for restart, end in zip(restarts, ends, strict=True):
        before = has_value[begin:restart].any(axis=0)
        after = has_value[restart:end].any(axis=0)
        if (before & after).any():
            parts[restart:] += 1
        begin = restart
    return parts
