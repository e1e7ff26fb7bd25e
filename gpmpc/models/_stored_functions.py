"""Functions in the files of models: operations that a file holds, or names of code.

A function in CasADi, such as a system's nominal model, is stored as its operations,
which are numbers (``gpmpc._kernels.tape``). Any other is stored as the path it is
imported by and its parameters, in JSON: an importable function, alone or in a
``functools.partial`` with keyword arguments, or an importable dataclass. To import a
module is to run it: a path is followed only into packages that the caller names
(``gpmpc._trust``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpmpc._trust import (
    MODEL_CODE,
    is_trusted,
    may_be_trusted,
    package_of,
    trusted_code,
)
from gpmpc.exceptions import DataError, UnsupportedModel
from gpmpc.models._casadi_function import CasadiFunction
from gpmpc.models._older_files import CASADI_BY_NAME, casadi_function_by_name

OPERATIONS = "operations"
CODE_KINDS = ("function", "partial", "dataclass", CASADI_BY_NAME)
_RULE = (
    "It can be saved as a function of a module, a functools.partial of one with "
    "keyword arguments, a dataclass with __call__, or a CasadiFunction of "
    "expressions"
)


class FunctionSizes(NamedTuple):
    """Sizes that the parts of a model leave to a function."""

    arguments: list[int]  # entries of each argument
    value: list[int]  # rows and columns of the value


class _Code(NamedTuple):
    """Code by what it is made of: an imported object and its parameters."""

    kind: str
    source: Any
    parameters: dict[str, Any]


def describe_function(
    key: str, function: Any
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Returns the header and the tensors of a function.

    Raises:
        UnsupportedModel: It is code that cannot be imported by a path, or a parameter
            of it is none that JSON gives back as it was.
    """
    tape = function.tape if isinstance(function, CasadiFunction) else None
    if tape is not None and np.isfinite(tape.constants).all():
        header = {
            "kind": OPERATIONS,
            "sizes": function.sizes,
            "shape": function.shape,
        }
        tensors = {
            "code": torch.as_tensor(tape.code).double(),
            "constants": torch.as_tensor(tape.constants).double(),
        }
        return header, tensors
    code = _code(function)
    module = getattr(code.source, "__module__", "")
    path = f"{module}:{getattr(code.source, '__qualname__', '')}"
    is_importable = not path.startswith("__main__") and _imported(path) is code.source
    if not is_importable or not _is_of_kind(code.kind, code.source):
        rule = f"{key} is code that a file cannot name"
        raise UnsupportedModel(f"{rule}: {function!r}. {_RULE}")
    for name, value in code.parameters.items():
        if not _is_kept_by_json(value):
            rule = f"{key} has a parameter that a file would change"
            kinds = (
                "numbers and texts, lists of them, dictionaries whose keys are texts"
            )
            got = f"{name}={value!r:.80} ({type(value).__name__})"
            raise UnsupportedModel(f"{rule}: {got}. It can be {kinds}")
    return {"kind": code.kind, "path": path, "parameters": code.parameters}, {}


def _code(function: Any) -> _Code:
    """Takes a function apart into an object that can be imported, and parameters."""
    if isinstance(function, partial) and not function.args:
        return _Code("partial", function.func, dict(function.keywords))
    if is_dataclass(function) and not isinstance(function, type):
        names = [field.name for field in fields(function) if field.init]
        parameters = {name: getattr(function, name) for name in names}
        return _Code("dataclass", type(function), parameters)
    return _Code("function", function, {})


def _is_of_kind(kind: str, source: Any) -> bool:
    """Whether an object is what functions of a kind are made of."""
    if kind == "dataclass":
        return isinstance(source, type) and is_dataclass(source)
    return type(source) is FunctionType


def _is_kept_by_json(value: Any) -> bool:
    """Whether a value comes back from JSON as it was, types within it included."""
    if isinstance(value, list):
        return all(_is_kept_by_json(entry) for entry in value)
    if isinstance(value, dict):
        has_texts_as_keys = all(type(name) is str for name in value)
        return has_texts_as_keys and all(map(_is_kept_by_json, value.values()))
    # NumPy's float64 is a float
    return isinstance(value, float) or type(value) in (bool, int, str, type(None))


def check_code_name(path: Path, key: str, name: Any, trusted: Sequence[str]) -> None:
    """Raises ``DataError`` unless code of this name may be imported.

    Args:
        path: Of the file.
        key: Part of the model that is code.
        name: Of the code, ``module:qualified name``.
        trusted: Names of packages.
    """
    if not isinstance(name, str):
        raise DataError(f"{key} is code without a name")
    if name in MODEL_CODE or is_trusted(name, trusted):
        return
    what = f"{path}: {key} is the code {name!r:.100}"
    package = package_of(name)
    if is_trusted(name, [package]) and may_be_trusted(package):
        call = f"load_model(path, trusted=[{package!r}])"
        command = f"gpmpc run model.trusted=[{package}]"
        rule = f"which is imported only where you trust {package}"
        raise DataError(f"{what}, {rule}: {call}, {command}")
    raise DataError(f"{what}, which no file may name")


def function_of(
    key: str,
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    sizes: FunctionSizes,
    trusted: Sequence[str],
) -> Any:
    """Returns the function whose operations are stored, or that a header names.

    Its name was checked before (``check_code_name``).

    Raises:
        DataError: It has other sizes, or is no code of its kind that can be imported.
    """
    if header["kind"] == OPERATIONS:
        return _function_of_operations(key, header, tensors, sizes)
    return _function_of_code(key, header, trusted)


def _function_of_operations(
    key: str,
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    sizes: FunctionSizes,
) -> CasadiFunction:
    """Returns the function in CasADi that a tape stands for."""
    from gpmpc.gp.casadi_ import function_of_tape  # loads CasADi

    fits = header["sizes"] == sizes.arguments and header["shape"] == sizes.value
    if not fits:
        rule = f"{key} must map vectors of {sizes.arguments} entries to {sizes.value}"
        got = f"{header['sizes']!r:.80} to {header['shape']!r:.80}"
        raise DataError(f"{rule}; got {got}")
    code = tensors["code"].numpy()
    constants = tensors["constants"].numpy()
    function = function_of_tape(code, constants, sizes.arguments, sizes.value)
    return CasadiFunction(function)


def _function_of_code(
    key: str, header: Mapping[str, Any], trusted: Sequence[str]
) -> Any:
    """Imports the function that a header names, and binds its parameters."""
    kind = header["kind"]
    name = header["path"]
    parameters = header["parameters"]
    if not isinstance(parameters, dict):
        raise DataError(f"{key} has no parameters by name")
    source = _imported(name) if name in MODEL_CODE else trusted_code(name, trusted)
    if not _is_of_kind(kind, source):
        raise DataError(f"{key} {name!r} is no {kind} that can be imported here")
    if kind == "function":
        return source
    if kind == "partial":
        return partial(source, **parameters)
    if kind == CASADI_BY_NAME:
        return casadi_function_by_name(source, parameters)
    return source(**parameters)


def _imported(path: str) -> Any:
    """Returns the object ``module:qualified name``; None where there is none."""
    try:
        return resolve_name(path)
    except (ImportError, AttributeError, ValueError):
        return None
