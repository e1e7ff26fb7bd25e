"""Calls functions that users write; says what to write for names of other libraries.

torch follows its own functions alone. numpy asks a tensor for its numbers, math for one
number: both fail with a sentence about tensors, which says nothing of what to write, or
lose a derivative without a word. Dynamics take floats, arrays and CasADi expressions:
math and torch do not.
"""

import dis
from collections.abc import Callable, Iterator, Sequence
from types import CodeType, FrameType, ModuleType, TracebackType
from typing import Any

import torch
from torch import Tensor

from gpmpc._calls import check_call
from gpmpc.exceptions import GpmpcError, SettingError
from gpmpc.gaussian import constant_arrays

_LOST = (TypeError, ValueError, RuntimeError, AttributeError, NotImplementedError)
_OURS = ("gpmpc", "torch", "numpy", "casadi")  # packages whose frames no user wrote
_NUMBERS = ("numpy", "math", "cmath", "scipy")  # what torch does not follow
_TORCH = {  # where torch calls the same function otherwise
    "array": "stack (of numbers torch.tensor)",
    "fabs": "abs",
    "absolute": "abs",
    "power": "pow",
    "max": "amax",
    "min": "amin",
}
_RULE = "must be written with torch, which follows its own functions alone"
_OTHERWISE = "or as a CasADi function"
_OTHERWISE_MODEL = (  # of which torch asks nothing, where it has derivatives of its own
    "or have a linearize() and be planned with by Linearization() and "
    "covariance='zero_order'"
)
_OF_SYSTEMS = (  # functions of ``gpmpc.systems``, called as in math
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh"),
    *("exp", "log", "sqrt", "abs", "min", "max", "where"),
)
_PLAIN = {  # what floats, arrays and CasADi take in the place of another function
    **{name: f"gpmpc.systems.{name}" for name in _OF_SYSTEMS},
    **{
        f"arc{name}": f"gpmpc.systems.a{name}" for name in ("sin", "cos", "tan", "tan2")
    },
    "pow": "**",
    "fabs": "gpmpc.systems.abs",
    "hypot": "gpmpc.systems.sqrt of squares",
    "copysign": "gpmpc.systems.sign",
    "pi": "its number",
    "solve": "the solution written out",
    "inv": "the inverse written out",
}
DYNAMICS_RULE = (
    "must be written with plain arithmetic and functions of gpmpc.systems (sin, sqrt, "
    "where, ...), for floats, arrays and CasADi"
)
_UNDECIDED = ("truth value", "Boolean value")  # of what has no single one
_FILLED = "setting an array element"
_LISTED = "a list of entries in the place of an array that is filled one by one"
_DECISION = (
    "gpmpc.systems.where, min or max for if, and, or, min, max of what has no number "
    "yet"
)


def call(key: str, function: Callable[..., Any], *arguments: Tensor) -> Any:
    """Calls a function of tensors that a user wrote; checks that torch follows it.

    Of a value that torch follows in part the rest is not seen: ``check_slopes`` of
    ``gpmpc.models._nominal`` compares with differences, where a function enters.

    Args:
        key: What the function is, for the message.
        function: In torch.
        arguments: Of it.

    Raises:
        SettingError: It failed where it calls numpy or math, or takes numbers out of a
            tensor; or torch did not follow its value, or a model's mean or covariance.
            Any other error of its own is left as it is.
    """
    if not callable(function):
        got = type(function).__name__
        raise SettingError(key, f"must be a function of tensors; got {got}")
    try:
        value = function(*arguments)
    except GpmpcError:
        raise
    except _LOST as error:
        if isinstance(error, TypeError):
            check_call(function, key, arguments, {})
        advice = _advice(function, error)
        if advice is None:
            raise
        otherwise = _OTHERWISE_MODEL if key == "model" else _OTHERWISE
        raise SettingError(key, f"{_RULE}: {advice}, {otherwise}") from error
    if torch.is_grad_enabled():
        _check_followed(key, function, value, arguments)
    return value


def call_dynamics(function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls the dynamics of a system on arrays or CasADi expressions.

    Raises:
        SettingError: They failed where they call math or torch, or decide by a
            condition. Any other error of their own is left as it is.
    """
    try:
        return function(*arguments)
    except GpmpcError:
        raise
    except _LOST as error:
        advice = dynamics_advice(error, ("math", "cmath", "torch"))
        if advice is None:
            raise
        raise SettingError("dynamics", advice) from error


def dynamics_advice(error: BaseException, packages: Sequence[str]) -> str | None:
    """Returns the rule that dynamics broke; None of other faults.

    They failed where they call one of these packages, numpy with what it does not
    take, or decide by a condition of arrays or symbols.
    """
    if any(words in str(error) for words in _UNDECIDED):
        return f"{DYNAMICS_RULE}: {_DECISION}"
    if _FILLED in str(error):
        return f"{DYNAMICS_RULE}: {_LISTED}"
    if type(error).__module__.partition(".")[0] == "numpy":
        packages = (*packages, "numpy")
    foreign = _foreign_calls(error, packages)
    if not foreign:
        return None
    names = [f"{_plain_name(name)} for {name}" for name in foreign]
    return f"{DYNAMICS_RULE}: {', '.join(names)}"


def _check_followed(
    key: str, function: Callable[..., Any], value: Any, arguments: tuple[Tensor, ...]
) -> None:
    """Raises ``SettingError`` where a value changes with arguments and torch lost it.

    Its derivatives would be taken for zero. A value that torch did not follow may be a
    constant, or one of further arguments: a step away from those that torch follows
    tells.
    """
    if not any(argument.requires_grad for argument in arguments):
        return
    unfollowed = {
        name: part
        for name, part in _tensors_in(value).items()
        if not part.requires_grad
    }
    # what a function transform follows has no numbers to be compared
    if constant_arrays(*(part.cpu() for part in unfollowed.values())) is None:
        return
    if "covariance" in unfollowed and not unfollowed["covariance"].any():
        del unfollowed["covariance"]  # a known model has none
    if not unfollowed:
        return
    with torch.no_grad():
        moved = _tensors_in(function(*[_step_away(one) for one in arguments]))
    for name, part in unfollowed.items():
        is_number = part.isfinite() & moved[name].isfinite()
        if bool((is_number & (part != moved[name])).any()):
            lost = "its values change, and their derivatives are lost"
            ways = "by numpy, math, torch.tensor, .detach() or .item()"
            otherwise = _OTHERWISE_MODEL if key == "model" else _OTHERWISE
            raise SettingError(key, f"{_RULE}: {lost} ({ways}), {otherwise}")


def _tensors_in(value: Any) -> dict[str, Tensor]:
    """Returns a tensor, or mean and covariance of a belief, by their names."""
    if isinstance(value, Tensor):
        return {"value": value}
    parts = {name: getattr(value, name, None) for name in ("mean", "covariance")}
    return {name: part for name, part in parts.items() if isinstance(part, Tensor)}


def _step_away(argument: Tensor) -> Tensor:
    """Returns numbers nearby of an argument that torch follows; another one stays."""
    if not argument.requires_grad:
        return argument
    numbers = argument.detach()
    width = torch.finfo(numbers.dtype).eps ** (1 / 3)
    return numbers + width * (1 + numbers.abs())


def _advice(function: Any, error: BaseException) -> str | None:
    """Returns what to write in place of the failed call; None of other faults."""
    if _is_of(function, _NUMBERS):  # the function itself is one of them
        foreign = [f"{_package_of(function)}.{function.__name__}"]
    else:
        foreign = _foreign_calls(error, _NUMBERS)
    if foreign:
        return ", ".join(f"{_name_in_torch(name)} for {name}" for name in foreign)
    text = str(error)
    if "numpy() on Tensor" in text or ("converted to" in text and "ensor" in text):
        return "it takes numbers out of a tensor (float, .item(), .numpy())"
    return None


def _frame_of_user(traceback: TracebackType | None) -> tuple[FrameType, int] | None:
    """Returns the innermost frame of a user's code, and the line where it stopped."""
    innermost = None
    while traceback is not None:
        module = str(traceback.tb_frame.f_globals.get("__name__", ""))
        if module.partition(".")[0] not in _OURS:
            innermost = traceback.tb_frame, traceback.tb_lineno
        traceback = traceback.tb_next
    return innermost


def _foreign_calls(error: BaseException, packages: Sequence[str]) -> list[str]:
    """Returns the packages' functions on the line where a user's code stopped."""
    frame = _frame_of_user(error.__traceback__)
    if frame is None:
        return []
    names = [name for name, value in _names_on(*frame) if _is_of(value, packages)]
    return list(dict.fromkeys(names))


def _names_on(frame: FrameType, line: int) -> Iterator[tuple[str, Any]]:
    """Yields each name on a line, such as ``np.linalg.norm``, and its value."""
    variables = {**frame.f_globals, **frame.f_locals}
    name = ""
    value = None
    for instruction in _instructions(frame.f_code, line):
        if instruction.opname in ("LOAD_ATTR", "LOAD_METHOD") and name:
            name = f"{name}.{instruction.argval}"
            module = isinstance(value, ModuleType)  # another's attribute may be code
            value = getattr(value, instruction.argval, None) if module else None
            continue
        if name:
            yield name, value
        name = ""
        if instruction.opname.startswith("LOAD_") and isinstance(
            instruction.argval, str
        ):
            name = instruction.argval
            value = variables.get(instruction.argval)
    if name:
        yield name, value


def _instructions(code: CodeType, line: int) -> Iterator[dis.Instruction]:
    """Yields the instructions of one line."""
    current = None
    for instruction in dis.get_instructions(code):
        started = instruction.starts_line
        if isinstance(started, int) and not isinstance(started, bool):
            current = started
        elif started:  # as Python says it from 3.13 on
            current = getattr(instruction, "line_number", current)
        if current == line:
            yield instruction


def _is_of(value: Any, packages: Sequence[str]) -> bool:
    """Returns whether a value is a function of one of these packages."""
    return callable(value) and _package_of(value) in packages


def _package_of(value: Any) -> str:
    module = getattr(value, "__module__", None) or type(value).__module__
    return str(module).partition(".")[0]


def _name_in_torch(name: str) -> str:
    """Returns torch's name of a function of numpy or math: mostly the same."""
    path = name.split(".")[1:] or [name]
    if path[-1] in _TORCH:
        return f"torch.{_TORCH[path[-1]]}"
    function: Any = torch
    for part in path:
        function = getattr(function, part, None)
    return f"torch.{'.'.join(path)}" if callable(function) else "what torch has"


def _plain_name(name: str) -> str:
    """Returns what to write for a function of math or torch in dynamics."""
    return _PLAIN.get(name.rpartition(".")[2], "plain arithmetic")
