"""Errors of misuse, which name the rule that was broken and what was given instead.

A numerical outcome (a solver that stops early, an infeasible problem) is no exception
but a ``gpmpc.status.Status``. Every error of this package derives from ``GpmpcError``;
its text is one line that a user can act on, and it survives the way back from a worker
process (its constructor's arguments are its ``args``).
"""

import sys
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any

_LONG = 40  # characters of a value that a message still quotes


class GpmpcError(Exception):
    """Any error that gpmpc raises on purpose."""


class ShapeError(GpmpcError, ValueError):
    """An array or tensor has another shape than the rule says."""


class SettingError(GpmpcError, ValueError):
    """A setting is unknown, of the wrong type, or outside its range."""

    def __init__(self, key: str, message: str):
        super().__init__(key, message)
        self.key = key  #: the name of the setting, as the user writes it

    def __str__(self) -> str:
        return f"{self.args[0]}: {self.args[1]}"


class DataError(GpmpcError, ValueError):
    """A data file or data set cannot be used.

    The text names the file, the row and the column.
    """


class TrainingError(GpmpcError, RuntimeError):
    """A training failed for at least one output.

    Every start of its search did, or sparse GPs learned nothing where exact ones do.
    """

    def __init__(self, outputs: list[int], message: str):
        super().__init__(outputs, message)
        self.outputs = (
            outputs  #: indices of the outputs (from 0) that could not be trained
        )

    def __str__(self) -> str:
        return self.args[1]


class UnsupportedModel(GpmpcError, TypeError):
    """A method has no formula for this kind of model; the text lists others."""


class ProblemError(GpmpcError, ValueError):
    """An optimisation problem is malformed.

    Its shapes, symmetry, definiteness or bounds are wrong, or it holds NaN.
    """


class SolverFailure(GpmpcError, RuntimeError):
    """A controller's solver failed where its caller had declared no policy."""

    def __init__(self, step: int, advice: str):
        super().__init__(step, advice)
        self.step = step  #: the time step (from 0)

    def __str__(self) -> str:
        return f"the controller's solver failed at step {self.args[0]}: {self.args[1]}"


class Diverged(GpmpcError, ArithmeticError):
    """A simulated system left the finite numbers, or its episode ended."""

    #: the ``Rollout`` of a closed loop up to there (``CascadeRollout`` of a cascade),
    #: without the step that it failed in: None where that was the first
    rollout: Any = None

    def __init__(self, step: int, message: str):
        super().__init__(step, message)
        self.step = step  #: the time step (from 0) that it did so in

    def __str__(self) -> str:
        return f"step {self.args[0]}: {self.args[1]}"


class RecordingError(GpmpcError, RuntimeError):
    """A recording cannot be written or read; the text names the file and the reason."""


def check_number(
    key: str,
    value: Any,
    *,
    above: float | None = None,
    least: float | None = None,
    whole: bool = False,
    unit: str = "",
) -> None:
    """Raises ``SettingError`` unless a setting is one finite number.

    A truth value is none. It is to be larger than ``above``, ``least`` or more,
    ``whole`` or not; the unit, such as "[kg]", is named in the message.
    """
    kind_of_number: Any = Integral if whole else Real
    if (
        isinstance(value, kind_of_number)
        and not isinstance(value, bool)
        # False of nan, and of larger integers.
        and abs(_plain(value)) <= sys.float_info.max
        and (above is None or value > above)
        and (least is None or value >= least)
    ):
        return
    kind = "a whole number" if whole else "a number"
    limit = ""
    if above is not None:
        limit = f" above {above}"
    elif least is not None:
        limit = f", {least} or more"
    in_unit = f" {unit}" if unit else ""
    raise SettingError(key, f"must be {kind}{limit}{in_unit}; got {value!r}")


def _plain(value: Any) -> Any:
    """Returns a scalar of NumPy as Python's number; another one itself."""
    return value.item() if hasattr(value, "item") else value


def check_kind(
    key: str, value: Any, kind: type | tuple[type, ...], example: str
) -> None:
    """Raises ``SettingError`` unless a setting is an object of a kind.

    Args:
        key: Name of the setting.
        value: What was got; a class of the kind is none.
        kind: A class or several.
        example: What it must be, such as ``"Measurement(...)"``.
    """
    if isinstance(value, kind):
        return
    got = type(value).__name__
    if isinstance(value, type):
        got = f"the class {value.__name__}"
    raise SettingError(key, f"must be {example}; got {got}")


def check_method(key: str, value: object, method: str, example: str) -> None:
    """Raises ``SettingError`` unless a setting is an object with a method.

    A class of such objects is none.
    """
    if isinstance(value, type) or not hasattr(value, method):
        got = repr(value)
        if isinstance(value, type):
            got = f"the class {value.__name__}"
        elif len(got) > _LONG:
            got = type(value).__name__
        rule = f"must be an object with the method {method!r}, such as {example}"
        raise SettingError(key, f"{rule}; got {got}")


def check_indices(
    key: str, indices: Any, count: int, *, may_repeat: bool = False
) -> tuple[int, ...]:
    """Returns a setting that is indices from 0 to count - 1, all different.

    Where they ``may_repeat`` some may be equal.

    Raises:
        SettingError: It is no list of them; a mask of truth values is none.
    """
    is_list = isinstance(indices, Iterable) and not isinstance(indices, str)
    entries: tuple[Any, ...] = tuple(indices) if is_list else ()
    whole = all(isinstance(i, Integral) and not isinstance(i, bool) for i in entries)
    in_range = whole and all(0 <= i < count for i in entries)
    repeats = in_range and len(set(entries)) < len(entries)
    if not (is_list and in_range) or (repeats and not may_repeat):
        got = list(entries) if is_list else indices
        kind = "indices" if may_repeat else "different indices"
        rule = f"must be a list of {kind} from 0 to {count - 1}"
        raise SettingError(key, f"{rule}; got {got!r}")
    return tuple(int(i) for i in entries)


def check_flag(key: str, value: Any) -> None:
    """Raises ``SettingError`` unless a setting is a truth value."""
    if not isinstance(value, bool):
        raise SettingError(key, f"must be true or false; got {value!r}")


def check_choice(key: str, value: Any, choices: Sequence[str]) -> None:
    """Raises ``SettingError`` unless a setting is one of several words."""
    if value not in choices:
        raise SettingError(
            key, f"must be one of {', '.join(map(repr, choices))}; got {value!r}"
        )


def check_numbers(key: str, values: Any, length: int, **limits: Any) -> None:
    """Raises unless a setting is a list of ``length`` numbers.

    Each is as ``check_number`` asks for.
    """
    if (
        isinstance(values, str)
        or not hasattr(values, "__len__")
        or len(values) != length
    ):
        raise SettingError(key, f"must be a list of {length} numbers; got {values!r}")
    for value in values:
        check_number(key, value, **limits)
