"""Converts units of a log's columns to SI units.

A unit is a symbol, or products and quotients of symbols: "deg", "m/s2", "N m", "km/h".
An unknown unit is an error: to take it as it stands would leave feet as metres.
"""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from gpmpc.exceptions import SettingError


class Conversion(NamedTuple):
    """The value of one of a unit."""

    unit: str  #: the SI unit
    factor: float  #: how many of it


DEGREE = float(np.pi / 180)
SYMBOLS = {
    "m": Conversion("m", 1.0),
    "mm": Conversion("m", 1e-3),
    "cm": Conversion("m", 1e-2),
    "km": Conversion("m", 1e3),
    "rad": Conversion("rad", 1.0),
    "mrad": Conversion("rad", 1e-3),
    "deg": Conversion("rad", DEGREE),
    "s": Conversion("s", 1.0),
    "ms": Conversion("s", 1e-3),
    "us": Conversion("s", 1e-6),
    "ns": Conversion("s", 1e-9),
    "min": Conversion("s", 60.0),
    "h": Conversion("s", 3600.0),
    "Hz": Conversion("Hz", 1.0),
    "kHz": Conversion("Hz", 1e3),
    "kg": Conversion("kg", 1.0),
    "N": Conversion("N", 1.0),
    "mN": Conversion("N", 1e-3),
    "kN": Conversion("N", 1e3),
    "J": Conversion("J", 1.0),
    "W": Conversion("W", 1.0),
    "kW": Conversion("W", 1e3),
    "Pa": Conversion("Pa", 1.0),
    "hPa": Conversion("Pa", 1e2),
    "kPa": Conversion("Pa", 1e3),
    "bar": Conversion("Pa", 1e5),
    "V": Conversion("V", 1.0),
    "mV": Conversion("V", 1e-3),
    "A": Conversion("A", 1.0),
    "mA": Conversion("A", 1e-3),
    "T": Conversion("T", 1.0),
    "uT": Conversion("T", 1e-6),
    "K": Conversion("K", 1.0),
    "mol": Conversion("mol", 1.0),
    "kmol": Conversion("mol", 1e3),
    "%": Conversion("", 1e-2),
    "rpm": Conversion("rad/s", float(np.pi / 30)),
    "g": Conversion("m/s2", 9.80665),  # standard gravity, not the gram
}
# in small letters; others are taken for the time where these are not there
NAMES_OF_TIMES = (
    *("timestamp", "t", "time", "stamp", "seconds", "datetime", "elapsed"),
    *("zeit", "zeitstempel"),
)
TIME_UNITS = {  # of the times of rows [s]
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "min": 60.0,
    "h": 3600.0,
    "d": 86400.0,
}
_TIME_WORDS = {  # for units of time, in small letters
    word: unit
    for unit, words in {
        "s": "sec secs second seconds sekunden",
        "ms": "msec msecs millis millisecond milliseconds",
        "us": "usec usecs micros microsecond microseconds",
        "ns": "nsec nsecs nanos nanosecond nanoseconds",
        "min": "mins minute minutes minuten",
        "h": "hr hrs hour hours stunden",
        "d": "day days tage",
    }.items()
    for word in words.split()
}
# Greek's mu and the sign of micro look alike
_SIGNS = {
    "\N{DEGREE SIGN}": "deg",
    "\N{MICRO SIGN}": "u",
    "\N{GREEK SMALL LETTER MU}": "u",
}
_CAPITALS = {"S": "s", "MS": "ms"}  # units of times, where all is in capitals
_SINCE = re.compile(r" (?:since|from|after) ")
_NO_UNIT = ("", "1", "-")
_UNITS_KEY = "units"  # in the ``attrs`` of a table
# names of times that say their unit: "Time [ms]", "time (usec)", "t_s"; TimeUS is
# ArduPilot's
_TIME_WITH_UNIT = re.compile(
    r"(?:[Tt]imestamp|[Tt]ime|TIME|t|[Zz]eit)"
    r"(?: ?[\[(]([^\[\]()]+)[\])]|_(s|ms|us|ns|[mun]?secs?))"
)
_TIMES_BY_NAME = {"TimeUS": "us", "millis": "ms", "micros": "us"}  # and their units
# time_boot_ms, Zeit/min, time in s
_ENDS_WITH_UNIT = re.compile(r".*\S(?:_| ?/ ?| in )([^\W\d_]+)")
_NAME_WITH_UNIT = re.compile(r".*\S ?(?:\[([^\[\]]+)\]|\(([^()]+)\))")
_FACTOR = re.compile(r"([A-Za-z%]+)\^?((?:-?\d)?)")


def conversion(key: str, unit: str) -> Conversion:
    """Returns what one of a unit is in SI units.

    Args:
        key: The setting that names the unit, for the error.
        unit: Such as "deg", "m/s2" or "N m"; "", "1" and "-" are no unit.

    Raises:
        SettingError: The unit is unknown, or no text.
    """
    if not isinstance(unit, str):
        raise SettingError(key, f"must be the name of a unit; got {unit!r}")
    if is_no_unit(unit):
        return Conversion("", 1.0)
    symbols = _as_symbols(unit)
    if symbols in SYMBOLS:
        return SYMBOLS[symbols]
    numerator, *denominators = symbols.split("/")
    product = _product(key, unit, numerator)
    for denominator in denominators:
        divisor = _product(key, unit, denominator)
        product = Conversion(
            f"{product.unit}/{divisor.unit}", product.factor / divisor.factor
        )
    return product


def _as_symbols(unit: str) -> str:
    """Writes a unit in ``SYMBOLS``: msec as ms, and signs by letters."""
    for sign, letters in _SIGNS.items():
        unit = unit.replace(sign, letters)
    return re.sub("[A-Za-z]+", lambda word: _as_time_symbol(word[0]), unit)


def _as_time_symbol(word: str) -> str:
    """Returns the symbol of a unit of time that is written out; others as they are."""
    return _TIME_WORDS.get(word.casefold(), word)


def unit_of_time(text: str) -> str:
    """Returns the unit of ``TIME_UNITS`` that a text means; empty where it is none.

    >>> unit_of_time("msec"), unit_of_time("Hours"), unit_of_time("left")
    ('ms', 'h', '')
    """
    symbols = _as_symbols(text.strip())
    return symbols if symbols in TIME_UNITS else ""


def unit_said_of_time(text: str) -> str:
    """Returns the unit of ``TIME_UNITS`` that a file says of a time; empty for none.

    >>> unit_said_of_time("sec."), unit_said_of_time("ms since boot")
    ('s', 'ms')
    >>> unit_said_of_time("S"), unit_said_of_time("UTC")
    ('s', '')
    """
    word = _SINCE.split(text.strip(), maxsplit=1)[0].rstrip(".")
    return unit_of_time(_CAPITALS.get(word, word))


def is_name_of_time(name: str) -> bool:
    """Tells whether a column is called as times are; T is rather a temperature."""
    return name == "t" or (len(name) > 1 and name.casefold() in NAMES_OF_TIMES)


def is_no_unit(text: str) -> bool:
    """Tells whether a text stands for a number without a unit."""
    return text.strip() in _NO_UNIT


def is_known(unit: str) -> bool:
    """Tells whether ``conversion`` takes a unit."""
    try:
        conversion("unit", unit)
    except SettingError:
        return False
    return True


def unit_in_name(column: str) -> str:
    """Returns the unit that the name of a column of times says; empty for none.

    >>> unit_in_name("t_ms"), unit_in_name("time [us]"), unit_in_name("t")
    ('ms', 'us', '')
    """
    if column in _TIMES_BY_NAME:
        return _TIMES_BY_NAME[column]
    match = _TIME_WITH_UNIT.fullmatch(column)
    return unit_of_time(match[1] or match[2]) if match is not None else ""


def unit_text_of_time(time: str) -> str:
    """Returns what the name of a time says of its unit, as it is written there.

    In brackets that may be any word, but for a letter, as of a channel: (A).

    >>> unit_text_of_time("elapsed (msec)"), unit_text_of_time("time_boot_ms")
    ('msec', 'ms')
    >>> unit_text_of_time("Zeit/min"), unit_text_of_time("items")
    ('min', '')
    """
    if time in _TIMES_BY_NAME:
        return _TIMES_BY_NAME[time]
    text = _text_in_brackets(time)
    if text and (len(text) > 1 or unit_said_of_time(text)):
        return text
    match = _ENDS_WITH_UNIT.fullmatch(time)
    is_unit = match is not None and match[1] != "d" and unit_of_time(match[1])
    return match[1] if match is not None and is_unit else ""


def _text_in_brackets(name: str) -> str:
    """Returns the text in brackets at the end of a name; empty for an index."""
    match = _NAME_WITH_UNIT.fullmatch(name)
    text = (match[1] or match[2]).strip() if match is not None else ""
    return "" if text.isdecimal() else text


def unit_in_brackets(name: str) -> str:
    """Returns the unit at the end of a column's name; empty where there is none.

    A number there is that of an entry of a list.

    >>> unit_in_brackets("speed [km/h]"), unit_in_brackets("motor[1]")
    ('km/h', '')
    """
    unit = _text_in_brackets(name)
    return unit if is_known(unit) else ""


def units_of(table: pd.DataFrame) -> dict[str, str]:
    """Returns the units that a file says of a table's columns, by their names."""
    return dict(table.attrs.get(_UNITS_KEY, {}))


def said_units(table: pd.DataFrame) -> dict[str, str]:
    """Returns the units that a file says of a table's columns, also in their names."""
    in_names = {name: unit_in_name(name) or unit_in_brackets(name) for name in table}
    units = {name: unit for name, unit in in_names.items() if unit}
    return {**units, **{name: unit for name, unit in units_of(table).items() if unit}}


def with_units(table: pd.DataFrame, units: Mapping[str, str]) -> pd.DataFrame:
    """Returns a table with what a file says of its units, in place of before."""
    table = table.copy(deep=False)
    table.attrs = {**table.attrs, _UNITS_KEY: dict(units)}
    return table


def _product(key: str, unit: str, text: str) -> Conversion:
    """Returns what a product of symbols is, such as "N m" or "s2" in ``unit``."""
    names = []
    factor = 1.0
    for part in re.split(r"[ *]+", text.strip()):
        if part == "1":
            names.append("1")
            continue
        match = _FACTOR.fullmatch(part)
        symbol = SYMBOLS.get(match[1]) if match else None
        if match is None or symbol is None or not symbol.unit.isalpha():
            raise SettingError(key, _unknown(unit))
        names.append(symbol.unit + match[2])
        factor *= symbol.factor ** int(match[2] or 1)
    return Conversion(" ".join(names), factor)


def _unknown(unit: str) -> str:
    return (
        f"{unit!r} is an unknown unit; known are {', '.join(SYMBOLS)}, and their "
        "products and quotients, such as 'N m' and 'm/s2'; for another, name the unit "
        "that the values come out in, and give their scale"
    )
