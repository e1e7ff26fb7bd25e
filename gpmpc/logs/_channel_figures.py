"""Describes the channels of a log by figures, and says what to beware of in them.

White noise is found by second differences, whose variance is six times that of the
noise, and smoothing by their correlation with the ones before: -2/3 for white noise,
positive for a smoothed signal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from gpmpc._dynamics import Array

NAMED = 3  # channels that are named where many have the same remark
MOSTLY_REPEATED = 0.5  # share of repeated values from which a channel is slow
SMOOTHED = 0.3  # correlation of second differences from which a channel is smoothed
# makes a median absolute deviation the standard deviation of a normal distribution
MEDIAN_TO_STD = 1.4826


@dataclass(frozen=True)
class ChannelFigures:
    """The figures of one channel; NaN where no row tells."""

    lowest: float = np.nan
    highest: float = np.nan
    std: float = np.nan
    white_noise: float = np.nan  # standard deviation
    missing: float = np.nan  # share of the rows
    repeated: float = np.nan  # share of the rows with the value of the row before
    longest: float = np.nan  # [rows] with one value
    smoothness: float = np.nan  # correlation of neighbouring second differences

    def row(self) -> dict[str, float]:
        """Returns the figures by the names of the columns of a table."""
        return {
            "lowest": self.lowest,
            "highest": self.highest,
            "std": self.std,
            "white noise": self.white_noise,
            "missing": self.missing,
            "repeated": self.repeated,
            "longest [rows]": self.longest,
            "smoothness": self.smoothness,
        }


class _Remark(NamedTuple):
    """What to beware of in one channel."""

    subject: str  # the channel
    text: str  # of this channel
    kind: str  # of all channels that it is said of with other numbers


def describe_channel(values: Array) -> ChannelFigures:
    """Computes the figures of a channel (K,)."""
    finite = values[np.isfinite(values)]
    missing = 1 - len(finite) / len(values) if len(values) else 1.0
    if not len(finite):
        return ChannelFigures(missing=missing)
    repeats = np.diff(finite) == 0
    changes = np.flatnonzero(np.concatenate([[True], ~repeats, [True]]))
    # Values of 1e200 have no square: figures are computed in units of the largest.
    unit = max(float(np.abs(finite).max()), np.finfo(float).tiny)
    scaled = finite / unit
    white_noise = np.nan
    smoothness = np.nan
    curvature = np.diff(scaled, 2)
    if len(curvature):
        white_noise = _white_noise(curvature) * unit
        smoothness = _smoothness(curvature)
    return ChannelFigures(
        lowest=float(finite.min()),
        highest=float(finite.max()),
        std=float(scaled.std()) * unit,
        white_noise=white_noise,
        missing=missing,
        repeated=float(repeats.mean()) if len(repeats) else 0.0,
        longest=int(np.diff(changes).max()),
        smoothness=smoothness,
    )


def _white_noise(curvature: Array) -> float:
    """Returns the standard deviation of the noise in second differences.

    The median is deaf to manoeuvres.
    """
    deviation = float(np.median(np.abs(curvature - np.median(curvature))))
    return MEDIAN_TO_STD * deviation / float(np.sqrt(6))


def _smoothness(curvature: Array) -> float:
    power = float(curvature @ curvature)
    return float(curvature[1:] @ curvature[:-1]) / power if power > 0 else np.nan


def channel_table(channels: Mapping[str, ChannelFigures]) -> pd.DataFrame:
    """Makes a table with a row for each channel, by name."""
    rows = {name: figures.row() for name, figures in channels.items()}
    table = pd.DataFrame.from_dict(rows, orient="index")
    return table.rename_axis("channel")


def channel_warnings(channels: Mapping[str, ChannelFigures]) -> list[str]:
    """Says what to beware of in the channels; one line where many share it."""
    by_kind: dict[str, list[_Remark]] = {}
    for name, figures in channels.items():
        for remark in _remarks(name, figures):
            by_kind.setdefault(remark.kind, []).append(remark)
    return [line for remarks in by_kind.values() for line in _lines(remarks)]


def _remarks(name: str, channel: ChannelFigures) -> list[_Remark]:
    """Lists what to beware of in one channel."""
    remarks = []
    if channel.lowest == channel.highest:
        remarks.append(_Remark(name, "never changes", "never changes"))
    elif channel.repeated > MOSTLY_REPEATED:
        rows = 1 / max(1 - channel.repeated, 1e-9)
        text = f"a new value every {rows:.1f} rows"
        remarks.append(_Remark(name, text, "a new value every few rows only"))
    elif channel.smoothness > SMOOTHED:
        text = "smoothed: its errors hang together over rows"
        remarks.append(_Remark(name, text, text))
    if channel.missing == 1:
        remarks.append(_Remark(name, "holds no value", "holds no value"))
    elif channel.missing:
        text = f"{channel.missing:.1%} of the values are missing"
        remarks.append(_Remark(name, text, "values are missing"))
    return remarks


def _lines(remarks: Sequence[_Remark]) -> list[str]:
    """Writes remarks of one kind: a line each, or one line for many."""
    if len(remarks) <= NAMED:
        return [f"{remark.subject}: {remark.text}" for remark in remarks]
    named = ", ".join(remark.subject for remark in remarks[:NAMED])
    unnamed = len(remarks) - NAMED
    channels = "channel" if unnamed == 1 else "channels"
    return [f"{named} and {unnamed} more {channels}: {remarks[0].kind}"]


def text_warning(names: Sequence[str]) -> list[str]:
    """Names the columns that hold no numbers; no line where all do."""
    if not names:
        return []
    listed = ", ".join(names[:NAMED])
    if len(names) > NAMED:
        listed += ", ..."
    return [f"{len(names)} columns hold no numbers: {listed}"]
