"""Elementary functions for dynamics: of floats, arrays, CasADi expressions and tensors.

They are named as in numpy, whose own functions take floats, arrays and CasADi as well.
``abs``, ``min`` and ``max`` stand in the place of Python's in files that import them.
"""

import builtins
from typing import Any

import numpy as np

from gpmpc.exceptions import check_number


def sin(angle: Any) -> Any:
    """Returns the sine of an angle [rad].

    >>> float(sin(0.0))
    0.0

    See Also:
        numpy's functions of the same names, which plain dynamics may use as
        well.
    """
    return _unary("sin", angle)


def cos(angle: Any) -> Any:
    """Returns the cosine of an angle [rad].

    >>> float(cos(0.0))
    1.0
    """
    return _unary("cos", angle)


def tan(angle: Any) -> Any:
    """Returns the tangent of an angle [rad].

    >>> float(tan(0.0))
    0.0
    """
    return _unary("tan", angle)


def asin(value: Any) -> Any:
    """Returns the angle [rad] in [-pi/2, pi/2] of a sine.

    >>> float(asin(0.0))
    0.0
    """
    return _unary("arcsin", value)


def acos(value: Any) -> Any:
    """Returns the angle [rad] in [0, pi] of a cosine.

    >>> float(acos(1.0))
    0.0
    """
    return _unary("arccos", value)


def atan(value: Any) -> Any:
    """Returns the angle [rad] in [-pi/2, pi/2] of a tangent.

    >>> float(atan(0.0))
    0.0
    """
    return _unary("arctan", value)


def atan2(y: Any, x: Any) -> Any:
    """Returns the angle [rad] in [-pi, pi] of the direction (x, y).

    >>> float(atan2(0.0, 1.0))
    0.0
    """
    return _binary("arctan2", y, x)


def exp(value: Any) -> Any:
    """Returns e to the power of a value.

    >>> float(exp(0.0))
    1.0
    """
    return _unary("exp", value)


def log(value: Any) -> Any:
    """Returns the natural logarithm of a positive value.

    >>> float(log(1.0))
    0.0
    """
    return _unary("log", value)


def sqrt(value: Any) -> Any:
    """Returns the square root of a value; its slope is infinite at zero.

    >>> float(sqrt(4.0))
    2.0
    """
    return _unary("sqrt", value)


def sinh(value: Any) -> Any:
    """Returns the hyperbolic sine of a value.

    >>> float(sinh(0.0))
    0.0
    """
    return _unary("sinh", value)


def cosh(value: Any) -> Any:
    """Returns the hyperbolic cosine of a value.

    >>> float(cosh(0.0))
    1.0
    """
    return _unary("cosh", value)


def tanh(value: Any) -> Any:
    """Returns the hyperbolic tangent of a value.

    >>> float(tanh(0.0))
    0.0
    """
    return _unary("tanh", value)


def abs(value: Any) -> Any:
    """Returns the magnitude of a value; its slope is zero at zero.

    >>> abs(-2.0)
    2.0
    """
    return builtins.abs(value)


def sign(value: Any, width: float) -> Any:
    """Returns a smooth sign, tanh(value / width), such as that of dry friction.

    A controller needs slopes, which a step has not.

    Args:
        value: Of any kind.
        width: In its unit: at plus or minus ``width`` the sign is 0.76, at twice that
            0.96.

    >>> float(round(sign(0.02, width=0.01), 2))
    0.96
    """
    check_number("width", width, above=0)
    return tanh(value / width)


def min(first: Any, second: Any) -> Any:
    """Returns the smaller of two values, element by element.

    >>> float(min(1.0, 2.0))
    1.0
    """
    return _binary("minimum", first, second)


def max(first: Any, second: Any) -> Any:
    """Returns the larger of two values, element by element.

    >>> float(max(1.0, 2.0))
    2.0
    """
    return _binary("maximum", first, second)


def where(condition: Any, value: Any, otherwise: Any) -> Any:
    """Returns one of two values by a condition such as ``x[0] > 0``.

    Both are computed. It takes the place of ``if``, which a condition of arrays or
    CasADi expressions cannot decide.

    >>> float(where(True, 1.0, 2.0))
    1.0

    See Also:
        ``sign``, which is smooth.
    """
    package = _package_of(condition, value, otherwise)
    if package == "casadi":
        import casadi

        return casadi.if_else(condition, value, otherwise)
    if package == "torch":
        import torch

        return torch.where(torch.as_tensor(condition), value, otherwise)
    return np.where(condition, value, otherwise)[()]


def _unary(name: str, value: Any) -> Any:
    """Calls a function of one value by numpy's name, its own where it has one."""
    if hasattr(value, name):
        return getattr(value, name)()
    return getattr(np, name)(value)


_IN_CASADI = {"minimum": "fmin", "maximum": "fmax", "arctan2": "atan2"}


def _binary(name: str, first: Any, second: Any) -> Any:
    """Calls a function of two values by numpy's name, in the library of either."""
    package = _package_of(first, second)
    if package == "casadi":
        import casadi

        return getattr(casadi, _IN_CASADI[name])(first, second)
    if package == "torch":
        import torch

        like = first if isinstance(first, torch.Tensor) else second
        tensors = [
            torch.as_tensor(value, dtype=like.dtype, device=like.device)
            for value in (first, second)
        ]
        return getattr(torch, name)(*tensors)
    return getattr(np, name)(first, second)


def _package_of(*values: Any) -> str:
    """Returns the package whose expressions or tensors are among values; or numpy."""
    for value in values:
        package = type(value).__module__.partition(".")[0]
        if package in ("casadi", "torch"):
            return package
    return "numpy"
