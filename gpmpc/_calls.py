"""Says in one line which argument a call got wrong: unknown, missing or one too many.

Python's own ``TypeError`` names a function of the inside (``Trainer.__init__``), and
not what was meant. Calls that are right cost nothing.
"""

import difflib
import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

from gpmpc.exceptions import SettingError

_Callable = TypeVar("_Callable", bound=Callable[..., Any])

_OTHER_NAMES = {  # what other packages and papers call it
    "n": "horizon",
    "n_horizon": "horizon",
    "dt": "time_step",
    "ts": "time_step",
    "t_step": "time_step",
    "sampling_time": "time_step",
    "x0": "initial",
    "u0": "initial_input",
    "x_ref": "references",
    "reference": "references",
    "n_steps": "steps",
    "lb": "lower",
    "min": "lower",
    "ub": "upper",
    "max": "upper",
    "x": "states",
    "u": "inputs",
    "y": "next_states",
}

_INSIDE = {  # settings that stand inside the value of another argument
    "disturbance_gain": ("prediction", "PredictionSettings"),
    "covariance": ("prediction", "PredictionSettings"),
    "form": ("prediction", "PredictionSettings"),
    "feedback": ("prediction", "PredictionSettings"),
    "Q": ("problem", "Problem(Tracking(Q, R))"),
    "R": ("problem", "Problem(Tracking(Q, R))"),
}


def explains_arguments(target: _Callable) -> _Callable:
    """Makes a function or a class explain calls that do not fit its signature.

    Raises:
        SettingError: On such a call, with the argument, the nearest name and all names.
    """
    if not isinstance(target, type):
        return cast(_Callable, _explained(target, target.__name__))
    constructor: Any = target
    constructor.__init__ = _explained(constructor.__init__, constructor.__name__)
    return constructor


def _explained(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """Returns a function that checks its arguments where a call of it fails."""

    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        try:
            return function(*arguments, **keywords)
        except TypeError:
            check_call(function, name, arguments, keywords)
            raise

    return call


def check_call(
    function: Callable[..., Any],
    name: str,
    arguments: tuple[Any, ...],
    keywords: dict[str, Any],
) -> None:
    """Raises ``SettingError`` unless a call fits the signature of a function.

    Args:
        function: What is called; a method comes with its object as first argument.
        name: What a user calls it.
        arguments: By position.
        keywords: By name.
    """
    signature = inspect.signature(function)
    try:
        signature.bind(*arguments, **keywords)
    except TypeError as error:
        reason = str(error)
    else:
        return
    names = [key for key in signature.parameters if key not in ("self", "cls")]
    takes = f"{name} takes {', '.join(names) or 'no arguments'}"
    for keyword in keywords:
        if keyword not in signature.parameters:
            meant = _nearest(keyword, names) or _home(keyword, signature)
            raise SettingError(keyword, f"is no argument{meant}; {takes}") from None
    if reason.startswith("missing"):
        missing = reason.split("'")[1]
        raise SettingError(missing, f"is missing; {takes}") from None
    raise SettingError(name, f"{reason}; {takes}") from None


def _home(keyword: str, signature: inspect.Signature) -> str:
    """Returns which settings object among the defaults has a field of this name."""
    for key, parameter in signature.parameters.items():
        settings = parameter.default
        if settings is not inspect.Parameter.empty and hasattr(settings, keyword):
            kind = type(settings).__name__
            return f" (did you mean {key}={kind}({keyword}=...)?)"
    return ""


def _nearest(keyword: str, names: list[str]) -> str:
    """Returns what a keyword may stand for, as a question; nothing if unknown."""
    other_name = _OTHER_NAMES.get(keyword.lower())
    if other_name in names:
        return f" (did you mean {other_name!r}?)"
    owner, value = _INSIDE.get(keyword, ("", ""))
    if owner in names:
        inside = value if "(" in value else f"{value}({keyword}=...)"
        return f" (did you mean {owner}={inside}?)"
    close = difflib.get_close_matches(keyword.lower(), names, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
