"""Files of models that are made of a known part and a learned one, in the format of ``gpmpc.gp._storage``.

Numbers are stored as arrays. Code cannot be: a nominal model or an effect that is a function is stored as the path it
is imported by and its parameters, which are

* an importable function, alone or in a ``functools.partial`` with keyword arguments,
* an importable dataclass, with its fields,
* a ``CasadiFunction`` of an importable function that makes it,

with parameters that JSON can hold. A ``CasadiFunction`` that no function makes, such as a system's nominal model, is
stored as its operations, which are numbers (``gpmpc._kernels.tape``). Reading imports the module that the file names,
as Python's own ``import`` does: a file from someone else is read where their module is installed on purpose.
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._files import existing_file, new_file
from gpmpc.exceptions import DataError, GpmpcError, UnsupportedModel
from gpmpc.gp import GPPosterior, load_metadata
from gpmpc.gp._storage import posterior_of_parts, posterior_parts, read_model, write_model
from gpmpc.models._delay import DelayedModel
from gpmpc.models._disturbance import DisturbedModel
from gpmpc.models._noisy import NoisyModel
from gpmpc.models._nominal import Affine, CasadiFunction
from gpmpc.models._residual import ResidualModel


def save_model(model: Any, path: str | Path, metadata: Mapping[str, Any] | None = None) -> None:
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
    if kind not in _BUILD:
        raise DataError(f"{path}: holds a {kind}; expected one of {', '.join(_BUILD)}")
    return _built(path, *read_model(path, kind))


def _parts(path: Path, model: Any) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The header, with its kind, and the tensors of a model."""
    kind = type(model).__name__
    if type(model) not in (GPPosterior, ResidualModel, DelayedModel, DisturbedModel, NoisyModel):
        raise UnsupportedModel(f"only {', '.join(_BUILD)} can be saved; got {kind}")
    if isinstance(model, GPPosterior):
        described, tensors = posterior_parts(path, model)
        return {"kind": kind, **described}, tensors
    inner, name = (model.residual, "residual") if isinstance(model, ResidualModel) else (model.model, "model")
    nested, inner_tensors = _parts(path, inner)
    header: dict[str, Any] = {"kind": kind, name: nested}
    tensors = {f"{name}/{key}": value for key, value in inner_tensors.items()}
    if isinstance(model, DelayedModel):
        return header | {"delay": model.delay}, tensors
    if isinstance(model, DisturbedModel):
        numbers: dict[str, Any] = {"std": list(map(float, model.std)), "decay": list(map(float, model.decay or ()))}
        return header | numbers, tensors | {"effect": model.effect}
    if isinstance(model, NoisyModel):
        log_noise, more = _parts(path, model.log_noise)
        own = {f"log_noise/{key}": value for key, value in more.items()}
        return header | {"log_noise": log_noise, "outputs": list(map(int, model.outputs))}, tensors | own
    header["input_dim"] = model.input_dim
    header |= {key: [int(i) for i in getattr(model, key)] for key in ("states", "inputs", "angles")}
    if isinstance(model.nominal, Affine):
        tensors |= {f"nominal/{part}": getattr(model.nominal, part) for part in "ABc"}
    else:
        header["nominal"] = _described("nominal", model.nominal, tensors)
    if callable(model.B):
        header["B"] = _described("B", model.B, tensors)
    else:
        tensors["B"] = model.B
    return header, tensors if model.noise is None else tensors | {"noise": model.noise}


def _built(path: Path, header: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Builds a model of a file's header and tensors, after a check of everything."""
    try:
        return _BUILD[header.get("kind", "GPPosterior")](path, header, tensors)
    except (GpmpcError, AttributeError, KeyError, TypeError) as error:
        text = f"not a consistent model ({error})"
        raise (error if str(error).startswith(str(path)) else DataError(f"{path}: {text}")) from error


def _inner(path: Path, name: str, header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> tuple[Any, dict]:
    """The model inside a model, and the other tensors, all of them finite."""
    own = {key: value for key, value in tensors.items() if not key.startswith(f"{name}/")}
    inner = {key.partition("/")[2]: value for key, value in tensors.items() if key.startswith(f"{name}/")}
    if not all(bool(torch.isfinite(part).all()) for part in own.values()):
        raise DataError("the numbers beside the inner model must be finite")
    return _built(path, header[name], inner), own


def _build_residual(path: Path, header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> ResidualModel:
    gp, own = _inner(path, "residual", header, tensors)
    B, nominal = (_function(header, own, key) for key in ("B", "nominal"))
    nominal = Affine(*(own[f"nominal/{part}"] for part in "ABc")) if nominal is None else nominal
    selected = header["states"], header["inputs"], header["input_dim"], header.get("angles", [])
    return ResidualModel(nominal, gp, own["B"] if B is None else B, *selected, own.get("noise"))


def _build_disturbed(path: Path, header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> DisturbedModel:
    model, own = _inner(path, "model", header, tensors)
    return DisturbedModel(model, own["effect"], header["std"], header["decay"])


_BUILD: dict[str, Callable[[Path, Any, Mapping[str, Tensor]], Any]] = {
    "GPPosterior": posterior_of_parts,
    "ResidualModel": _build_residual,
    "DelayedModel": lambda path, header, tensors: DelayedModel(
        _inner(path, "model", header, tensors)[0], header["delay"]
    ),
    "DisturbedModel": _build_disturbed,
    "NoisyModel": lambda path, header, tensors: NoisyModel(
        _inner(path, "model", header, tensors)[0], _inner(path, "log_noise", header, tensors)[0], header["outputs"]
    ),
}


def _described(key: str, function: Any, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """A function's header: its operations, which go to the tensors, or where it is imported from."""
    tape = function.tape if isinstance(function, CasadiFunction) and function.source is None else None
    if tape is None or not np.isfinite(tape.constants).all():
        return _import_path(key, function)
    tensors |= {f"{key}/{part}": torch.as_tensor(getattr(tape, part)).double() for part in ("code", "constants")}
    return {"kind": "operations", "sizes": function.sizes, "shape": function.shape}


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
    found = _imported(module, name) if module and module != "__main__" and name else None
    if found is None or found is not source or any(isinstance(value, Tensor) for value in parameters.values()):
        raise UnsupportedModel(
            f"{key} is code that a file cannot name: {function!r}. It can be saved as a function of a module, a "
            "functools.partial of one with keyword arguments, a dataclass of numbers with __call__, or "
            "CasadiFunction(function that makes it, ...)"
        )
    return {"kind": kind, "path": f"{module}:{name}", "parameters": parameters}


def _function(header: Mapping[str, Any], tensors: Mapping[str, Tensor], key: str) -> Any:
    """The function that a header names or whose operations are stored; None where there is none."""
    if (entry := header.get(key)) is None:
        return None
    if entry["kind"] == "operations":
        from gpmpc.gp.casadi_ import function_of_tape  # loads CasADi

        code, constants = (tensors[f"{key}/{part}"].numpy() for part in ("code", "constants"))
        return CasadiFunction(function_of_tape(code, constants, entry["sizes"], entry["shape"]))
    kind, parameters = entry["kind"], entry["parameters"]
    module, _, name = entry["path"].partition(":")
    source: Any = _imported(module, name)
    is_class = is_dataclass(source) and isinstance(source, type)
    right = is_class if kind == "dataclass" else type(source) is FunctionType
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
