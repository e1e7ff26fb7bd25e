"""Files of models that are made of a known part and a learned one, in the format of ``gpmpc.gp.storage``.

Numbers are stored as arrays. Code cannot be: a nominal model or an effect that is a function is stored as the path it
is imported by and its parameters, which are

* an importable function, alone or in a ``functools.partial`` with keyword arguments,
* an importable dataclass, with its fields,
* a ``CasadiFunction`` of an importable function that makes it,

with parameters that JSON can hold. Reading imports the module that the file names, as Python's own ``import`` does: a
file from someone else is read where their module is installed on purpose.
"""

import importlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import torch
from torch import Tensor

from gpmpc.exceptions import DataError, GpmpcError, UnsupportedModel
from gpmpc.gp._archive import existing_file, new_file
from gpmpc.gp.storage import posterior_of_parts, posterior_parts, read_model, write_model
from gpmpc.models.nominal import Affine, CasadiFunction
from gpmpc.models.residual import ResidualModel


def save_residual_model(model: ResidualModel, path: str | Path, metadata: Mapping[str, Any] | None = None) -> None:
    """Writes a residual model to one file, in one piece or not at all.

    Args:
        model: On any device; float64 or float32.
        path: The file; ``.safetensors`` by convention.
        metadata: Stored in the header, such as names and units; what JSON can hold.

    Raises:
        UnsupportedModel: The nominal model or the effect is code that cannot be imported by a path.
        SettingError: A tensor is neither float64 nor float32, or the metadata are no JSON.
        DataError: The folder does not exist.
    """
    path = new_file(path)
    header: dict[str, Any] = {
        "input_dim": model.input_dim,
        "states": [int(i) for i in model.states],
        "inputs": [int(i) for i in model.inputs],
        "angles": [int(i) for i in model.angles],
    }
    header["residual"], residual = posterior_parts(path, model.residual)
    tensors = {f"residual/{name}": value for name, value in residual.items()}
    if isinstance(model.nominal, Affine):
        tensors |= {f"nominal/{name}": getattr(model.nominal, name) for name in ("A", "B", "c")}
    else:
        header["nominal"] = _import_path("nominal", model.nominal)
    if callable(model.B):
        header["B"] = _import_path("B", model.B)
    else:
        tensors["B"] = model.B
    if model.noise is not None:
        tensors["noise"] = model.noise
    write_model(path, "ResidualModel", header, tensors, metadata)


def load_residual_model(path: str | Path) -> ResidualModel:
    """Reads a file of ``save_residual_model``, into host memory.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format, or names code that is not there.
    """
    path = existing_file(path, "a saved ResidualModel")
    header, tensors = read_model(path, "ResidualModel")
    residual = {name.partition("/")[2]: value for name, value in tensors.items() if name.startswith("residual/")}
    gp = posterior_of_parts(path, header.get("residual"), residual)
    numbers = {name: value for name, value in tensors.items() if not name.startswith("residual/")}
    try:
        if not all(bool(torch.isfinite(part).all()) for part in numbers.values()):
            raise DataError("B, the noise and the nominal model must be finite")
        B, nominal = _function(header, "B"), _function(header, "nominal")
        nominal = Affine(*(numbers[f"nominal/{part}"] for part in "ABc")) if nominal is None else nominal
        selected = header["states"], header["inputs"], header["input_dim"], header.get("angles", [])
        return ResidualModel(nominal, gp, numbers["B"] if B is None else B, *selected, numbers.get("noise"))
    except (GpmpcError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a consistent residual model ({error})") from error


def _import_path(key: str, function: Any) -> dict[str, Any]:
    """Where a function is imported from, and its parameters."""
    kind, parameters = "function", {}
    source: Any = function
    if isinstance(function, CasadiFunction):
        kind, source, parameters = "casadi", function.source, function.parameters
    elif isinstance(function, partial) and not function.args:
        kind, source, parameters = "partial", function.func, dict(function.keywords)
    elif is_dataclass(function) and not isinstance(function, type):
        kind, source = "dataclass", type(function)
        parameters = {field.name: getattr(function, field.name) for field in fields(function) if field.init}
    module, name = getattr(source, "__module__", ""), getattr(source, "__qualname__", "")
    found: Any = None
    if module and module != "__main__" and name:
        found = _imported(module, name)
    if found is None or found is not source or any(isinstance(value, Tensor) for value in parameters.values()):
        raise UnsupportedModel(
            f"{key} is code that a file cannot name: {function!r}. It can be saved as a function of a module, a "
            "functools.partial of one with keyword arguments, a dataclass of numbers with __call__, or "
            "CasadiFunction(function that makes it, ...)"
        )
    return {"kind": kind, "path": f"{module}:{name}", "parameters": parameters}


def _function(header: Mapping[str, Any], key: str) -> Any:
    """The function that a header names; None where it names none."""
    if (entry := header.get(key)) is None:
        return None
    kind, parameters = entry["kind"], entry["parameters"]
    module, _, name = entry["path"].partition(":")
    source: Any = _imported(module, name)
    right = is_dataclass(source) and isinstance(source, type)
    if kind != "dataclass":
        right = type(source) is FunctionType
    if not right or kind not in ("function", "partial", "dataclass", "casadi") or not isinstance(parameters, dict):
        raise DataError(f"{key} {entry['path']!r} is no {kind} that can be imported here")
    call: Any = source
    make: dict[str, Any] = {"function": lambda: call, "partial": lambda: partial(call, **parameters)}
    make |= {"casadi": lambda: CasadiFunction(call, **parameters), "dataclass": lambda: call(**parameters)}
    return make[kind]()


def _imported(module: str, name: str) -> Any:
    """A module's object by its qualified name; None where there is none."""
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError):
        return None
    return found
