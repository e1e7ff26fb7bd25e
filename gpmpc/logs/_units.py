"""Converts units of a log's columns to SI units.

A unit is a symbol, or products and quotients of symbols: "deg", "m/s2", "N m", "km/h".
An unknown unit is an error: to take it as it stands would leave feet as metres.
"""

import re
from typing import NamedTuple

import numpy as np

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
_NO_UNIT = ("", "1", "-")
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
    if unit.strip() in _NO_UNIT:
        return Conversion("", 1.0)
    if unit in SYMBOLS:
        return SYMBOLS[unit]
    numerator, *denominators = unit.split("/")
    product = _product(key, unit, numerator)
    for denominator in denominators:
        divisor = _product(key, unit, denominator)
        product = Conversion(
            f"{product.unit}/{divisor.unit}", product.factor / divisor.factor
        )
    return product


def is_known(unit: str) -> bool:
    """Tells whether ``conversion`` takes a unit."""
    try:
        conversion("unit", unit)
    except SettingError:
        return False
    return True


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
