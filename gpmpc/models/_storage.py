"""Files of models that are made of a known part and a learned one.

They are in the format of ``gpmpc.gp._storage``. A model is its fields: tensors are
stored as arrays, numbers in the header, a model inside as a header in the header, a
function as ``_stored_functions`` says. A model of a log has a layout of its own
(``_stored_log_model``). All code that a file names is checked before anything is
imported, and sizes that a header declares are compared with the arrays before anything
is made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel
from gpmpc._files import existing_file, new_file
from gpmpc._trust import trusted_packages
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
from gpmpc.models._delayed import DelayedModel
from gpmpc.models._disturbed import DisturbedModel
from gpmpc.models._noisy import NoisyModel
from gpmpc.models._nominal import Affine
from gpmpc.models._residual import ResidualModel
from gpmpc.models._stored_functions import (
    CODE_KINDS,
    OPERATIONS,
    FunctionSizes,
    check_code_name,
    describe_function,
    function_of,
)
from gpmpc.models._stored_log_model import LOG_MODEL, read_log_dynamics
from gpmpc.models._stored_values import tensors_below
from gpmpc.signals import Signals

_MODELS = {
    model.__name__: model
    for model in (GPPosterior, ResidualModel, DelayedModel, DisturbedModel, NoisyModel)
}
_DEEPEST = 16  # models inside each other; three are many
_MOST = 2048  # states, and inputs, of a model from a file: a matrix of theirs is 32 MB


@explains_arguments
def save_model(
    model: Any, path: str | Path, metadata: Mapping[str, Any] | None = None
) -> None:
    """Writes a model of this package to one file, in one piece or not at all.

    Args:
        model: A ``GPPosterior``, ``ResidualModel``, ``DelayedModel``,
            ``DisturbedModel`` or ``NoisyModel``, on any device. What was learned from a
            log is saved by ``gpmpc.logs.save_learned``.
        path: The file; ``.safetensors`` by convention.
        metadata: Stored in the header, such as names and units; what JSON can hold.

    Raises:
        UnsupportedModel: It is another model, or its nominal model or effect is code
            that cannot be imported by a path.
        SettingError: A tensor is neither float64 nor float32, or the metadata are no
            JSON.
        DataError: The folder does not exist, or the model is too large to be read
            again.

    See Also:
        ``load_model``, which reads the file; ``gpmpc.gp.save_posterior`` for a
        GP alone.
    """
    path = new_file(path)
    header, tensors = _model_parts(path, model)
    _check_size(model)
    write_model(path, header.pop("kind"), header, tensors, metadata)


@explains_arguments
def load_model(path: str | Path, trusted: Sequence[str] = ()) -> Any:
    """Reads a model from a file into host memory.

    Args:
        path: The file, of ``save_model``, ``save_posterior`` or
            ``gpmpc.logs.save_learned``; the last holds a ``LogDynamics``.
        trusted: Names of packages, such as ``["my_robot"]``, whose code the file may
            name: a nominal model or an effect that was saved by its path is imported
            from there. Nothing else is imported.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format,
            or names code that is not there or not trusted.
        SettingError: ``trusted`` is no list of names of packages, or no controller can
            plan with a model of a log.

    See Also:
        ``save_model``, which writes the file.
    """
    packages = trusted_packages("trusted", trusted)
    path = existing_file(path, "a saved model")
    kind = load_metadata(path).get("kind")
    if kind == LOG_MODEL:
        return read_log_dynamics(path, packages)
    if not isinstance(kind, str) or kind not in _MODELS:
        expected = ", ".join(_MODELS)
        raise DataError(f"{path}: holds a {brief(kind)}; expected one of {expected}")
    header, tensors = read_model(path, kind)
    header = header | {"kind": kind}
    with consistent(path, "not a consistent model"):
        _check_code(path, header, packages)
        return _model_of_parts(path, header, tensors, packages)


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
        if kind in list(_MODELS):
            _check_code(path, entry, trusted, depth + 1)
        elif kind in CODE_KINDS:
            check_code_name(path, field.name, entry.get("path"), trusted)
        elif kind != OPERATIONS:
            raise DataError(f"{field.name} is of an unknown kind, {brief(kind)}")


def _model_parts(path: Path, model: Any) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Returns the header of a model, with its kind, and its tensors."""
    kind = type(model).__name__
    if type(model) not in _MODELS.values():
        expected = ", ".join(_MODELS)
        raise UnsupportedModel(f"only {expected} can be saved; got {kind}")
    header: dict[str, Any] = {"kind": kind}
    if isinstance(model, GPPosterior):
        posterior_header, tensors = posterior_parts(path, model)
        return header | posterior_header, tensors
    tensors = {}
    for field in fields(model):
        name = field.name
        value = getattr(model, name)
        inner_tensors: dict[str, Tensor] = {}
        if isinstance(value, Tensor):
            tensors[name] = value
        elif isinstance(value, Signals):
            header[name] = value.to_header()
        elif isinstance(value, Affine):
            inner_tensors = {"A": value.A, "B": value.B, "c": value.c}
        elif hasattr(value, "predict"):
            header[name], inner_tensors = _model_parts(path, value)
        elif callable(value):
            header[name], inner_tensors = describe_function(name, value)
        elif value is not None:
            header[name] = np.asarray(value).tolist()
        for key, tensor in inner_tensors.items():
            tensors[f"{name}/{key}"] = tensor
    return header, tensors


def _model_of_parts(
    path: Path,
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    trusted: Sequence[str],
) -> DynamicsModel:
    """Makes a model of a file's header and tensors, with a check of everything."""
    kind = _MODELS[header["kind"]]
    if kind is GPPosterior:
        model = posterior_of_parts(path, header, tensors)
    else:
        values: dict[str, Any] = {}
        for field in fields(kind):
            value = _field_of_parts(path, field.name, header, tensors, trusted)
            if value is not None:
                values[field.name] = value
        model = kind(**values)
    _check_size(model)
    return model


def _field_of_parts(
    path: Path,
    name: str,
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    trusted: Sequence[str],
) -> Any:
    """Makes a field of a model that is made of others; None where the file has none."""
    entry = header.get(name)
    if name == "signals":
        return Signals.from_header(entry)
    inner_tensors = tensors_below(name, tensors)
    if isinstance(entry, dict) and entry["kind"] in _MODELS:
        return _model_of_parts(path, entry, inner_tensors, trusted)
    _check_finite(inner_tensors)
    if name in tensors:
        _check_finite({name: tensors[name]})
    if isinstance(entry, dict):
        sizes = _function_sizes(name, header, tensors)
        return function_of(name, entry, inner_tensors, sizes, trusted)
    if name in header:
        return _numbers(name, entry)
    if name in tensors:
        return tensors[name]
    if inner_tensors and name == "nominal":
        return Affine(**inner_tensors)
    return None


def _check_finite(tensors: Mapping[str, Tensor]) -> None:
    """Raises ``DataError`` unless all entries of tensors are finite."""
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise DataError("the numbers beside the inner model must be finite")


def _check_size(model: Any) -> None:
    """Raises ``DataError`` of a model whose covariances would be too large to make."""
    _check_dimensions(model.state_dim, model.output_dim, model.input_dim)


def _check_dimensions(*dimensions: int) -> None:
    """Raises ``DataError`` of a model that is too large."""
    if max(dimensions) > _MOST:
        raise DataError(f"the model has more than {_MOST} states, outputs or inputs")


def _numbers(name: str, entry: Any) -> Any:
    """Returns a field that is a number or a list of numbers.

    A model may not notice anything else before it predicts.

    Raises:
        DataError: It is anything else.
    """
    numbers = entry if isinstance(entry, list) else [entry]
    if not all(type(number) in (int, float) for number in numbers):
        rule = f"{name} is neither numbers nor a part of a model"
        raise DataError(f"{rule}: {brief(entry)}")
    if name == "input_dim":
        check_number(name, entry, least=0, whole=True)
    elif name != "delay" and not isinstance(entry, list):
        raise DataError(f"{name} must be a list of numbers; got {brief(entry)}")
    return entry


def _function_sizes(
    name: str, header: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> FunctionSizes:
    """Returns the sizes that a function of a residual model must have."""
    square = tensors["noise"] if "noise" in tensors else tensors["B"]
    n = len(square)
    k = tensors["residual/targets"].shape[1]
    m = _numbers("input_dim", header["input_dim"])
    _check_dimensions(n, m)
    if name == "nominal":
        return FunctionSizes(arguments=[n, m], value=[n, 1])
    return FunctionSizes(arguments=[n], value=[n, k])
