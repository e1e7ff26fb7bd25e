"""Files of models that are made of a known part and a learned one, in the format of ``gpmpc.gp._storage``.

A model is its fields: tensors are stored as arrays, numbers in the header, a model inside as a header in the header. A
function in CasADi, such as a system's nominal model, is stored as its operations, which are numbers
(``gpmpc._kernels.tape``); any other as the path it is imported by and its parameters, in JSON: an importable
function, alone or in a ``functools.partial`` with keyword arguments, or an importable dataclass. Reading imports the
module that the file names, as Python's own ``import`` does: a file from someone else is read where their module is
installed on purpose.
"""

from collections.abc import Mapping
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
from gpmpc.exceptions import DataError, GpmpcError, UnsupportedModel
from gpmpc.gp import GPPosterior, load_metadata
from gpmpc.gp._storage import (
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
        DataError: The folder does not exist.
    """
    path = new_file(path)
    header, tensors = _parts(path, model)
    write_model(path, header.pop("kind"), header, tensors, metadata)


def load_model(path: str | Path) -> Any:
    """Reads a file of ``save_model`` or ``save_posterior``, into host memory.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format, or names code that is not there.
    """
    path = existing_file(path, "a saved model")
    kind = load_metadata(path).get("kind")
    if kind not in _MODELS:
        raise DataError(f"{path}: holds a {kind}; expected one of {', '.join(_MODELS)}")
    header, tensors = read_model(path, kind)
    try:
        return _built(path, header | {"kind": kind}, tensors)
    except (GpmpcError, AttributeError, KeyError, TypeError) as error:
        text = f"{path}: not a consistent model ({error})"
        raise (
            error if str(error).startswith(str(path)) else DataError(text)
        ) from error


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
        value, inner = getattr(model, name), {}
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


def _built(path: Path, header: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Builds a model of a file's header and tensors, after a check of everything."""
    model = _MODELS[header["kind"]]
    if model is GPPosterior:
        return posterior_of_parts(path, header, tensors)
    parts: dict[str, Any] = {}
    for name in (field.name for field in fields(model)):
        entry = header.get(name)
        if name == "signals":
            parts[name] = Signals.from_header(entry)
            continue
        inner = {
            key.partition("/")[2]: value
            for key, value in tensors.items()
            if key.startswith(f"{name}/")
        }
        if isinstance(entry, dict) and entry.get("kind") in _MODELS:
            parts[name] = _built(path, entry, inner)
            continue
        if not all(
            bool(torch.isfinite(part).all())
            for part in (*inner.values(), tensors.get(name, torch.zeros(1)))
        ):
            raise DataError("the numbers beside the inner model must be finite")
        if isinstance(entry, dict):
            parts[name] = _function(name, entry, inner)
        elif name in header:
            parts[name] = entry
        elif name in tensors:
            parts[name] = tensors[name]
        elif inner:
            parts[name] = Affine(**inner)
    return model(**parts)


def _described(key: str, function: Any, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """A function's header: its operations, which go to the tensors, or where it is imported from."""
    tape = function.tape if isinstance(function, CasadiFunction) else None
    if tape is not None and np.isfinite(tape.constants).all():
        tensors |= {
            part: torch.as_tensor(getattr(tape, part)).double()
            for part in ("code", "constants")
        }
        return {"kind": "operations", "sizes": function.sizes, "shape": function.shape}
    kind, source, parameters = "function", function, {}
    if isinstance(function, partial) and not function.args:
        kind, source, parameters = "partial", function.func, dict(function.keywords)
    elif is_dataclass(function) and not isinstance(function, type):
        kind, source = "dataclass", type(function)
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


def _function(key: str, entry: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Any:
    """The function that a header names, or whose operations are stored."""
    if entry["kind"] == "operations":
        from gpmpc.gp.casadi_ import function_of_tape  # loads CasADi

        code, constants = (tensors[part].numpy() for part in ("code", "constants"))
        return CasadiFunction(
            function_of_tape(code, constants, entry["sizes"], entry["shape"])
        )
    kind, parameters = entry["kind"], entry["parameters"]
    source: Any = _imported(entry["path"])
    right = (
        isinstance(source, type) and is_dataclass(source)
        if kind == "dataclass"
        else type(source) is FunctionType
    )
    if (
        not right
        or kind not in ("function", "partial", "dataclass", "casadi")
        or not isinstance(parameters, dict)
    ):
        raise DataError(
            f"{key} {entry['path']!r} is no {kind} that can be imported here"
        )
    if kind in ("function", "partial"):
        return partial(source, **parameters) if kind == "partial" else source
    made = source(**parameters)
    return (
        made if kind == "dataclass" else CasadiFunction(made)
    )  # as older files name what makes it


def _imported(path: str) -> Any:
    """A module's object by ``module:qualified name``; None where there is none."""
    try:
        return resolve_name(path)
    except (ImportError, AttributeError, ValueError):
        return None
