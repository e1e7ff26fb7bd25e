"""Files of models that are made of a known part and a learned one, in the format of ``gpmpc.gp._storage``.

A model is its fields: tensors are stored as arrays, numbers in the header, a model inside as a header in the header. A
function in CasADi, such as a system's nominal model, is stored as its operations, which are numbers
(``gpmpc._kernels.tape``); any other as the path it is imported by and its parameters, in JSON: an importable
function, alone or in a ``functools.partial`` with keyword arguments, or an importable dataclass. To import a module is
to run it: a path is followed only into packages that the caller names (``gpmpc._trust``), and all paths of a file are
checked before anything is imported. Sizes that a header declares are compared with the arrays before anything is made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from types import FunctionType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._files import existing_file, new_file
from gpmpc._trust import (
    MODEL_CODE,
    is_trusted,
    may_be_trusted,
    package_of,
    trusted_code,
    trusted_packages,
)
from gpmpc.exceptions import DataError, UnsupportedModel, check_number
from gpmpc.gp import GPPosterior, load_metadata
from gpmpc.gp._storage import (
    brief,
    consistent,
    posterior_of_parts,
    posterior_parts,
    read_model,
    write_model,
)
from gpmpc.models._nominal import Affine, CasadiFunction
from gpmpc.models._residual import ResidualModel
from gpmpc.models._wrapper import DelayedModel, DisturbedModel, NoisyModel
from gpmpc.signals import Signals

_MODELS = {
    model.__name__: model
    for model in (GPPosterior, ResidualModel, DelayedModel, DisturbedModel, NoisyModel)
}
_CODE_KINDS = ("function", "partial", "dataclass", "casadi")  # the last in older files
_DEEPEST = 16  # models inside each other; three are many
_MOST = 2048  # states, and inputs, of a model from a file: a matrix of theirs is 32 MB


def save_model(
    model: Any, path: str | Path, metadata: Mapping[str, Any] | None = None
) -> None:
    """Writes a model of this package to one file, in one piece or not at all.

    Args:
        model: A ``GPPosterior``, ``ResidualModel``, ``DelayedModel``, ``DisturbedModel`` or ``NoisyModel``, on any
            device.
        path: The file; ``.safetensors`` by convention.
        metadata: Stored in the header, such as names and units; what JSON can hold.

    Raises:
        UnsupportedModel: It is another model, or its nominal model or effect is code that cannot be imported by a path.
        SettingError: A tensor is neither float64 nor float32, or the metadata are no JSON.
        DataError: The folder does not exist, or the model is too large to be read again.
    """
    path = new_file(path)
    header, tensors = _parts(path, model)
    _check_size(model)
    write_model(path, header.pop("kind"), header, tensors, metadata)


def load_model(path: str | Path, trusted: Sequence[str] = ()) -> Any:
    """Reads a file of ``save_model`` or ``save_posterior``, into host memory.

    Args:
        path: The file.
        trusted: Names of packages, such as ``["my_robot"]``, whose code the file may
            name: a nominal model or an effect that was saved by its path is imported
            from there. Nothing else is imported.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format,
            or names code that is not there or not trusted.
        SettingError: ``trusted`` is no list of names of packages.
    """
    packages = trusted_packages("trusted", trusted)
    path = existing_file(path, "a saved model")
    kind = load_metadata(path).get("kind")
    if not isinstance(kind, str) or kind not in _MODELS:
        raise DataError(
            f"{path}: holds a {brief(kind)}; expected one of {', '.join(_MODELS)}"
        )
    header, tensors = read_model(path, kind)
    with consistent(path, "not a consistent model"):
        whole = header | {"kind": kind}
        _check_code(path, whole, packages)
        return _built(path, whole, tensors, packages)


def _check_code(
    path: Path, header: Mapping[str, Any], trusted: Sequence[str], depth: int = 0
) -> None:
    """Raises ``DataError`` unless all code that a header names may be imported."""
    if depth > _DEEPEST:
        raise DataError(f"holds models inside each other, more than {_DEEPEST}")
    for field in fields(_MODELS[header["kind"]]):
        entry = header.get(field.name)
        if not isinstance(entry, dict) or field.name == "signals":
            continue
        kind = entry.get("kind")
        if kind in [*_MODELS]:
            _check_code(path, entry, trusted, depth + 1)
        elif kind in _CODE_KINDS:
            _check_name(path, field.name, entry.get("path"), trusted)
        elif kind != "operations":
            raise DataError(f"{field.name} is of an unknown kind, {brief(kind)}")


def _check_name(path: Path, key: str, name: Any, trusted: Sequence[str]) -> None:
    """Raises ``DataError`` unless code of this name may be imported."""
    if not isinstance(name, str):
        raise DataError(f"{key} is code without a name")
    if name in MODEL_CODE or is_trusted(name, trusted):
        return
    named = f"{path}: {key} is the code {name!r:.100}"
    package = package_of(name)
    if is_trusted(name, [package]) and may_be_trusted(package):
        call = f"load_model(path, trusted=[{package!r}])"
        command = f"gpmpc run model.trusted=[{package}]"
        raise DataError(
            f"{named}, which is imported only where you trust {package}: {call}, {command}"
        )
    raise DataError(f"{named}, which no file may name")


def _parts(path: Path, model: Any) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The header, with its kind, and the tensors of a model."""
    kind = type(model).__name__
    if type(model) not in _MODELS.values():
        raise UnsupportedModel(f"only {', '.join(_MODELS)} can be saved; got {kind}")
    if isinstance(model, GPPosterior):
        described, own = posterior_parts(path, model)
        return {"kind": kind, **described}, own
    header: dict[str, Any] = {"kind": kind}
    tensors: dict[str, Tensor] = {}
    for name in (field.name for field in fields(model)):
        value = getattr(model, name)
        inner = {}
        if isinstance(value, Tensor):
            tensors[name] = value
        elif isinstance(value, Signals):
            header[name] = value.to_header()
        elif isinstance(value, Affine):
            inner = vars(Affine(value.A, value.B, value.c))
        elif hasattr(value, "predict"):
            header[name], inner = _parts(path, value)
        elif callable(value):
            header[name] = _described(name, value, inner)
        elif value is not None:
            header[name] = np.asarray(value).tolist()
        tensors |= {f"{name}/{key}": part for key, part in inner.items()}
    return header, tensors


def _built(
    path: Path,
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    trusted: Sequence[str],
) -> Any:
    """Builds a model of a file's header and tensors, after a check of everything."""
    kind = _MODELS[header["kind"]]
    if kind is GPPosterior:
        model = posterior_of_parts(path, header, tensors)
    else:
        model = kind(**_fields(path, kind, header, tensors, trusted))
    _check_size(model)
    return model


def _check_size(model: Any) -> None:
    """Raises ``DataError`` of a model whose covariances would be too large to make."""
    if max(model.state_dim, model.output_dim, model.input_dim) > _MOST:
        raise DataError(f"the model has more than {_MOST} states, outputs or inputs")


def _fields(
    path: Path,
    kind: type[Any],
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    trusted: Sequence[str],
) -> dict[str, Any]:
    """The fields of a model that is made of others, by name."""
    values: dict[str, Any] = {}
    for name in (field.name for field in fields(kind)):
        entry = header.get(name)
        if name == "signals":
            values[name] = Signals.from_header(entry)
            continue
        inner = {
            key.partition("/")[2]: value
            for key, value in tensors.items()
            if key.startswith(f"{name}/")
        }
        if isinstance(entry, dict) and entry["kind"] in _MODELS:
            values[name] = _built(path, entry, inner, trusted)
            continue
        if not all(
            bool(torch.isfinite(part).all())
            for part in (*inner.values(), tensors.get(name, torch.zeros(1)))
        ):
            raise DataError("the numbers beside the inner model must be finite")
        if isinstance(entry, dict):
            arguments, value = _function_sizes(name, header, tensors)
            values[name] = _function(name, entry, inner, arguments, value, trusted)
        elif name in header:
            values[name] = _plain(name, entry)
        elif name in tensors:
            values[name] = tensors[name]
        elif inner and name == "nominal":
            values[name] = Affine(**inner)
    return values


def _plain(name: str, entry: Any) -> Any:
    """A field that is a number or a list of numbers; ``DataError`` of anything else.

    A model may not notice it before it predicts.
    """
    numbers = entry if isinstance(entry, list) else [entry]
    if not all(type(number) in (int, float) for number in numbers):
        raise DataError(
            f"{name} is neither numbers nor a part of a model: {brief(entry)}"
        )
    if name == "input_dim":
        check_number(name, entry, least=0, whole=True)
    elif name != "delay" and not isinstance(entry, list):
        raise DataError(f"{name} must be a list of numbers; got {brief(entry)}")
    return entry


def _function_sizes(
    name: str, header: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> tuple[list[int], list[int]]:
    """The sizes that a residual model's function must have, by the model's arrays.

    Returns:
        Entries of each argument, and rows and columns of the value.
    """
    square = tensors["noise"] if "noise" in tensors else tensors["B"]
    n = len(square)
    k = tensors["residual/targets"].shape[1]
    m = header["input_dim"]
    if max(n, _plain("input_dim", m)) > _MOST:
        raise DataError(f"the model has more than {_MOST} states, outputs or inputs")
    return ([n, m], [n, 1]) if name == "nominal" else ([n], [n, k])


def _described(key: str, function: Any, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """A function's header: its operations, which go to the tensors, or where it is imported from."""
    tape = function.tape if isinstance(function, CasadiFunction) else None
    if tape is not None and np.isfinite(tape.constants).all():
        tensors |= {
            part: torch.as_tensor(getattr(tape, part)).double()
            for part in ("code", "constants")
        }
        return {"kind": "operations", "sizes": function.sizes, "shape": function.shape}
    kind = "function"
    source = function
    parameters = {}
    if isinstance(function, partial) and not function.args:
        kind = "partial"
        source = function.func
        parameters = dict(function.keywords)
    elif is_dataclass(function) and not isinstance(function, type):
        kind = "dataclass"
        source = type(function)
        parameters = {
            field.name: getattr(function, field.name)
            for field in fields(function)
            if field.init
        }
    path = f"{getattr(source, '__module__', '')}:{getattr(source, '__qualname__', '')}"
    found = None if path.startswith("__main__") else _imported(path)
    if (
        found is None
        or found is not source
        or any(isinstance(value, Tensor) for value in parameters.values())
    ):
        raise UnsupportedModel(
            f"{key} is code that a file cannot name: {function!r}. It can be saved as a function of a module, a "
            "functools.partial of one with keyword arguments, a dataclass of numbers with __call__, or a "
            "CasadiFunction of expressions"
        )
    return {"kind": kind, "path": path, "parameters": parameters}


def _function(
    key: str,
    entry: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    arguments: list[int],
    value: list[int],
    trusted: Sequence[str],
) -> Any:
    """The function whose operations are stored, or that a header names.

    Its name was checked before (``_check_code``).
    """
    if entry["kind"] == "operations":
        from gpmpc.gp.casadi_ import function_of_tape  # loads CasADi

        if (entry["sizes"], entry["shape"]) != (arguments, value):
            said = f"{entry['sizes']!r:.80} to {entry['shape']!r:.80}"
            raise DataError(
                f"{key} must map vectors of {arguments} entries to {value}; got {said}"
            )
        code, constants = (tensors[part].numpy() for part in ("code", "constants"))
        return CasadiFunction(function_of_tape(code, constants, arguments, value))
    kind = entry["kind"]
    name = entry["path"]
    parameters = entry["parameters"]
    if not isinstance(parameters, dict):
        raise DataError(f"{key} has no parameters by name")
    source = _imported(name) if name in MODEL_CODE else trusted_code(name, trusted)
    right = (
        isinstance(source, type) and is_dataclass(source)
        if kind == "dataclass"
        else type(source) is FunctionType
    )
    if not right:
        raise DataError(f"{key} {name!r} is no {kind} that can be imported here")
    if kind == "function":
        return source
    if kind == "partial":
        return partial(source, **parameters)
    function = source(**parameters)
    if kind == "casadi":  # older files name what makes the function
        return CasadiFunction(function)
    return function


def _imported(path: str) -> Any:
    """A module's object by ``module:qualified name``; None where there is none."""
    try:
        return resolve_name(path)
    except (ImportError, AttributeError, ValueError):
        return None
