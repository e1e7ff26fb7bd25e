"""Models of logs in files: their layout, and its checks.

The header has ``groups``, ``kinematics``, ``nominal``, ``history``, ``lag``, ``gps``,
``names``, ``time_step`` and, where the model has them, the steps of its ``correction``,
its ``memory`` and ``without_nominal``; the tensors are ``theta``, ``noise/...``, those
of the GPs, ``gp0/...``, and where there are some ``correction/...``,
``start_filter/...``, ``time_constants`` and ``weights``. ``gpmpc.logs`` adds the record
of the identification.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import Array
from gpmpc._trust import SYSTEM_CODE, trusted_code
from gpmpc.exceptions import DataError, SettingError, check_choice, check_number
from gpmpc.gp._storage import (
    consistent,
    posterior_of_parts,
    posterior_parts,
    read_model,
)
from gpmpc.models._correction import BINS, ROWS_SEEN, Correction, StartFilter
from gpmpc.models._grouped import GroupedNominal
from gpmpc.models._kinematics import Increments, Kinematics, RigidBodyKinematics
from gpmpc.models._log_dynamics import LogDynamics, OutputNoise, TubeNoise
from gpmpc.models._log_model import LogModel, OutputGP
from gpmpc.models._memory import NO_MEMORY, Memory, Products
from gpmpc.models._namings import NO_NAMINGS, Namings
from gpmpc.models._older_files import STILL, namings_of_columns
from gpmpc.models._parametric import AffineNominal, MultirotorNominal
from gpmpc.models._state_space import StateGroup, StateSpace
from gpmpc.models._stored_functions import check_code_name
from gpmpc.models._stored_values import tensors_below, texts
from gpmpc.models._system_nominal import FittedParameter, SystemNominal
from gpmpc.signals import Signals

LOG_MODEL = "LogModel"  # the kind of the files
_RIGID_BODY = "RigidBody"  # as files call its kinematics
_INCREMENTS = "Increments"
_AFFINE_NAMES = ("AffineNominal", STILL)  # as files call that nominal model
_MULTIROTOR_NAME = "MultirotorNominal"
_GROUPED_NAME = "GroupedNominal"
_SYSTEM_NAME = "SystemNominal"
_REGRESSION_TENSORS = ("mean", "deviation", "weights")
_KINDS_OF_GROUPS = ("vector", "angle", "quaternion")
_OLDER_TIME_CONSTANTS = (0.0, 0.05, 0.25, 1.0)  # of noise [s], of files without them
_LONGEST = 10_000  # rows that a model from a file looks back
_SLOWEST = 1e9  # time step of a model from a file [s]
_MOST = 2048  # states, inputs or context of a model from a file
_MOST_DECAYS = 64  # exponential means in a memory
_MOST_PRODUCTS = 100_000  # of past features, about


class NamedLogModel(NamedTuple):
    """A model of a log, with its noise and the names of its signals."""

    model: LogModel
    noise: OutputNoise
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    context_names: tuple[str, ...]
    time_step: float
    namings: Namings = NO_NAMINGS  # what states and inputs may be called


def log_model_parts(
    path: Path, named: NamedLogModel
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Returns the header and the tensors of a model of a log.

    Raises:
        SettingError: The nominal model is of no kind that a file holds: those of gpmpc
            and, by the name of its code, a user's system.
    """
    model = named.model
    tensors = {
        "theta": torch.from_numpy(model.theta),
        "noise/outputs": torch.from_numpy(named.noise.outputs),
        "noise/measurement": torch.from_numpy(named.noise.measurement),
    }
    if named.noise.steps:
        tensors["noise/scales"] = torch.from_numpy(named.noise.scales)
    if named.noise.largest.size:
        tensors["noise/largest"] = torch.from_numpy(named.noise.largest)
    if named.noise.tube is not None:
        tensors["noise/tube_outputs"] = torch.from_numpy(named.noise.tube.outputs)
        tensors["noise/tube_start"] = torch.from_numpy(named.noise.tube.start)
    gps = []
    for i, gp in enumerate(model.gps):
        gp_header, gp_tensors = posterior_parts(path, gp.posterior)
        gps.append([gp.outputs, gp_header, gp.sees_memory])
        for key, tensor in gp_tensors.items():
            tensors[f"gp{i}/{key}"] = tensor
    is_rigid_body = isinstance(model.kinematics, RigidBodyKinematics)
    header = {
        "groups": [asdict(group) for group in model.kinematics.space.groups],
        "kinematics": _RIGID_BODY if is_rigid_body else _INCREMENTS,
        "nominal": _nominal_header(model.nominal),
        "history": model.history,
        "lag": model.lag,
        "noise_steps": named.noise.steps,
        "noise_rows": named.noise.time_constants,
        "gps": gps,
        "names": [named.state_names, named.input_names, named.context_names],
        "time_step": named.time_step,
    }
    if named.namings != NO_NAMINGS:
        header["namings"] = named.namings._asdict()
    if model.correction is not None:
        header["correction"] = model.correction.steps
    for name, part in _regressions(model).items():
        for key in _REGRESSION_TENSORS:
            tensors[f"{name}/{key}"] = torch.from_numpy(getattr(part, key))
    if model.memory != NO_MEMORY:
        header["memory"] = asdict(model.memory)
    if model.without_nominal:
        header["without_nominal"] = model.without_nominal
    if len(model.time_constants):
        tensors["time_constants"] = torch.from_numpy(model.time_constants)
    if model.weights.size:
        tensors["weights"] = torch.from_numpy(model.weights)
    return header, tensors


def _noise_rows(header: Mapping[str, Any]) -> tuple[float, ...]:
    """Returns the time constants of the noise of outputs [rows]."""
    if "noise_rows" in header:
        return tuple(header["noise_rows"])
    return tuple(constant / header["time_step"] for constant in _OLDER_TIME_CONSTANTS)


def _regressions(model: LogModel) -> dict[str, Correction | StartFilter]:
    """Returns the regressions on the past that a model has, by name."""
    regressions = {"correction": model.correction, "start_filter": model.start_filter}
    return {
        name: regression
        for name, regression in regressions.items()
        if regression is not None
    }


def _nominal_header(nominal: Any) -> list[Any]:
    """Returns the name and the settings of a nominal model."""
    name = type(nominal).__name__
    if isinstance(nominal, MultirotorNominal):
        return [name, asdict(nominal)]
    if isinstance(nominal, AffineNominal):
        return [name, {"fitted": nominal.fitted}]
    if isinstance(nominal, SystemNominal):
        return [name, nominal.settings]
    if isinstance(nominal, GroupedNominal):
        settings = {
            "parts": [_nominal_header(part) for part in nominal.parts],
            "outputs_of": nominal.outputs_of,
            "sizes": nominal.sizes,
        }
        return [name, settings]
    rule = "only nominal models of gpmpc.models can be saved"
    raise SettingError("nominal", f"{rule}; got {name}")


def read_log_dynamics(path: Path, trusted: Sequence[str] = ()) -> LogDynamics:
    """Reads a model of a log that a controller can plan with.

    Args:
        path: Of the file.
        trusted: Packages whose code the file may name.

    Raises:
        DataError: The file is damaged, of another kind or of a newer format, or names
            code that is not trusted.
        SettingError: No controller can plan with the model.
    """
    header, tensors = read_model(path, LOG_MODEL)
    with consistent(path, f"not a readable {LOG_MODEL}"):
        named = log_model_of_parts(path, header, tensors, trusted)
    if named.context_names:
        context = ", ".join(named.context_names)
        rule = f"needs a context ({context}), which is not known in flight"
        raise SettingError("model", f"{path} {rule}")
    return LogDynamics(
        model=named.model,
        input_dim=len(named.input_names),
        time_step=named.time_step,
        noise=named.noise,
        signals=Signals(
            state_names=named.namings.first_states,
            input_names=named.namings.first_inputs,
            time_step=named.time_step,
        ),
        ranges=tensors["ranges"].numpy() if "ranges" in tensors else None,
        namings=named.namings,
    )


def log_model_of_parts(
    path: Path,
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    trusted: Sequence[str] = (),
) -> NamedLogModel:
    """Makes a model of a log of a file's header and tensors.

    Raises:
        DataError: The parts do not belong together.
    """
    state_values, input_values, context_values, *_ = header["names"]
    state_names = texts("state_names", state_values)
    input_names = texts("input_names", input_values)
    kinematics = _kinematics(header["kinematics"], _space(header["groups"]))
    namings = namings_of_columns(kinematics.space, state_names, input_names)
    if "namings" in header:
        sizes = (kinematics.space.dim, len(input_names))
        namings = _namings(header["namings"], *sizes)
    origin = _ModelOrigin(
        path=path,
        kinematics=kinematics,
        state_names=state_names,
        input_names=input_names,
        context_names=texts("context_names", context_values),
        time_step=header["time_step"],
        namings=namings,
        trusted=tuple(trusted),
    )
    model = _model(header, tensors, origin)
    noise = OutputNoise(
        outputs=tensors["noise/outputs"].numpy(),
        measurement=tensors["noise/measurement"].numpy(),
        time_constants=_noise_rows(header),
    )
    if header.get("noise_steps"):  # older files have none
        noise = replace(
            noise,
            steps=tuple(header["noise_steps"]),
            scales=tensors["noise/scales"].numpy(),
        )
    if "noise/largest" in tensors:  # likewise
        noise = replace(noise, largest=tensors["noise/largest"].numpy())
    if "noise/tube_outputs" in tensors:  # likewise
        tube = TubeNoise(
            outputs=tensors["noise/tube_outputs"].numpy(),
            start=tensors["noise/tube_start"].numpy(),
        )
        noise = replace(noise, tube=tube)
    _check_noise(noise, kinematics)
    named = NamedLogModel(
        model=model,
        noise=noise,
        state_names=origin.state_names,
        input_names=origin.input_names,
        context_names=origin.context_names,
        time_step=origin.time_step,
        namings=namings,
    )
    _check_named(named)
    return named


def _namings(fields: Any, states: int, inputs: int) -> Namings:
    """Reads what states and inputs may be called.

    Raises:
        DataError: They are other numbers of names, or two are the same.
    """
    ways: dict[str, tuple[tuple[str, ...], ...]] = {}
    for role, count in (("states", states), ("inputs", inputs)):
        ways[role] = tuple(texts("namings", names) for names in fields[role])
        for names in ways[role]:
            if len(names) != count or len(set(names)) < count:
                rule = f"namings must be {count} different {role}"
                raise DataError(f"{rule}; got {names!r:.80}")
    return Namings(**ways)


def _model(
    header: Mapping[str, Any], tensors: Mapping[str, Tensor], origin: "_ModelOrigin"
) -> LogModel:
    """Makes the model of a header and tensors, and checks its sizes.

    Raises:
        DataError: The parts do not belong together.
    """
    kinematics = origin.kinematics
    input_names = origin.input_names
    features = kinematics.features(
        states=kinematics.space.origin[None],
        inputs=np.zeros((1, len(input_names))),
        context=np.zeros((1, len(origin.context_names))),
    )
    feature_count = features.shape[1]
    memory = _memory(header.get("memory"))
    regressor_count = memory.regressor_dim(feature_count, len(header["history"]))
    model = LogModel(
        kinematics=kinematics,
        nominal=_nominal(header["nominal"], origin),
        theta=tensors["theta"].numpy(),
        history=tuple(header["history"]),
        lag=header["lag"],
        gps=_gps(header["gps"], tensors, origin.path),
        correction=_correction(header, tensors, kinematics, input_names, feature_count),
        start_filter=_start_filter(tensors, kinematics, input_names, feature_count),
        time_constants=_numbers(tensors, "time_constants", (0,)),
        memory=memory,
        weights=_numbers(tensors, "weights", (0, 0)),
        without_nominal=tuple(header.get("without_nominal", ())),
    )
    for gp in model.gps:
        _check_gp(gp, regressor_count - 1 if gp.sees_memory else feature_count)
    _check_model(model, feature_count)
    _check_past(model, len(input_names), regressor_count)
    return model


def _gps(
    headers: Any, tensors: Mapping[str, Tensor], path: Path
) -> tuple[OutputGP, ...]:
    """Makes the GPs of a model of their headers and tensors."""
    gps = []
    for i, (outputs, posterior_header, *sees_memory) in enumerate(headers):
        posterior_tensors = tensors_below(f"gp{i}", tensors)
        posterior = posterior_of_parts(path, posterior_header, posterior_tensors)
        gps.append(OutputGP(tuple(outputs), posterior, any(sees_memory)))
    return tuple(gps)


def _memory(fields: Any) -> Memory:
    """Makes a memory of its fields in a header; none where there are none."""
    if fields is None:
        return NO_MEMORY
    _check_rows("memory", fields["rows"])
    decays = [fields[key] for key in ("decays", "output_decays")]
    if sum(map(len, decays)) > _MOST_DECAYS:
        raise DataError(f"a memory has more than {_MOST_DECAYS} means")
    for decay in itertools.chain(*decays):
        check_number("decays", decay, least=0)
    memory = Memory(
        rows=fields["rows"],
        decays=tuple(decays[0]),
        output_decays=tuple(decays[1]),
        products=_products(fields.get("products")),
    )
    if memory.rows_back > _LONGEST:
        raise DataError(f"a memory reaches back {memory.rows_back} rows")
    return memory


def _products(fields: Any) -> Products | None:
    """Makes products of their fields in a header; None where there are none."""
    if fields is None:
        return None
    _check_rows("products", fields["rows"])
    check_number("degree", fields["degree"], least=2, whole=True)
    low, high = (tuple(map(float, fields[key])) for key in ("low", "high"))
    variables = fields["rows"] * len(low)
    if variables ** min(fields["degree"], 10) > _MOST_PRODUCTS:
        raise DataError(f"products of {variables} features are too many")
    return Products(fields["rows"], fields["degree"], low, high)


def _numbers(tensors: Mapping[str, Tensor], key: str, empty: tuple[int, ...]) -> Array:
    """Returns a tensor as an array; an empty one where there is none."""
    if key not in tensors:
        return np.empty(empty)
    array = tensors[key].numpy()
    if array.dtype != np.float64 or not np.isfinite(array).all():
        raise DataError(f"{key} must be finite float64 numbers")
    return array


def _space(groups: Any) -> StateSpace:
    """Makes a state space of the groups in a header."""
    state_groups = []
    for fields in groups:
        entries = texts("entries", fields["entries"])
        group = StateGroup(**fields | {"entries": entries})
        check_choice("kind", group.kind, _KINDS_OF_GROUPS)
        if not entries or (group.kind == "quaternion" and len(entries) != 4):
            raise DataError(f"a {group.kind} cannot have {len(entries)} entries")
        state_groups.append(group)
    return StateSpace(tuple(state_groups))


def _kinematics(name: str, space: StateSpace) -> Kinematics:
    """Makes kinematics of their name in a file.

    Raises:
        DataError: There are no such kinematics, or the space is not theirs.
    """
    if name == _INCREMENTS:
        return Increments(space)
    if name != _RIGID_BODY:
        names = f"{_INCREMENTS}, {_RIGID_BODY}"
        raise DataError(f"unknown kinematics {name!r:.80}; known are {names}")
    groups = [(group.kind, len(group.entries)) for group in space.groups]
    vector = ("vector", 3)
    if groups != [vector, ("quaternion", 4), vector, vector]:
        raise DataError("a rigid body has position, attitude, velocity and rate")
    return RigidBodyKinematics(space)


class _ModelOrigin(NamedTuple):
    """Where a model comes from: its file, its signals, whose code it may name."""

    path: Path
    kinematics: Kinematics
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    context_names: tuple[str, ...]
    time_step: float
    namings: Namings
    trusted: tuple[str, ...]


def _nominal(
    name_and_settings: Any, origin: _ModelOrigin
) -> MultirotorNominal | AffineNominal | GroupedNominal | SystemNominal:
    """Makes a nominal model of its name and settings.

    Raises:
        DataError: There is no such model, or the settings are not those of this one.
    """
    name, settings = name_and_settings
    if name in _AFFINE_NAMES:
        return AffineNominal(origin.kinematics, settings.get("fitted", name != STILL))
    if name == _SYSTEM_NAME:
        return _system_nominal(settings, origin)
    if name == _GROUPED_NAME:
        return GroupedNominal(
            parts=tuple(_nominal(part, origin) for part in settings["parts"]),
            outputs_of=tuple(tuple(outputs) for outputs in settings["outputs_of"]),
            sizes=tuple(settings["sizes"]),
        )
    if name != _MULTIROTOR_NAME:
        own = (*_AFFINE_NAMES, _MULTIROTOR_NAME, _GROUPED_NAME, _SYSTEM_NAME)
        names = ", ".join(own)
        raise DataError(f"unknown nominal model {name!r:.80}; known are {names}")
    motors = settings["motors"]
    inputs = len(origin.input_names)
    if type(motors) is not int or motors != inputs:
        raise DataError(f"a multirotor of {inputs} inputs has no {motors!r:.80} motors")
    voltage = settings.get("voltage", 0.0)
    check_number("voltage", voltage, least=0)
    if voltage and not origin.context_names:
        raise DataError("a multirotor whose voltage counts has it in its context")
    if not isinstance(origin.kinematics, RigidBodyKinematics):
        raise DataError("a multirotor is a rigid body")
    return MultirotorNominal(**settings)


def _system_nominal(settings: Mapping[str, Any], origin: _ModelOrigin) -> SystemNominal:
    """Makes a system of the code and the parameters that a file names.

    Raises:
        DataError: The code may not be imported, or is not that of a system.
    """
    code = settings["code"]
    if code in SYSTEM_CODE:
        factory = trusted_code(code, ["gpmpc"])
    else:
        check_code_name(origin.path, "nominal", code, origin.trusted)
        factory = trusted_code(code, origin.trusted)
    if not isinstance(origin.kinematics, Increments):
        raise DataError("the states of a system are no rigid body's")
    fixed = settings["fixed"]
    # Older files do not say how the system calls what the fit took.
    states = settings.get("states", list(origin.kinematics.space.names))
    columns = origin.namings.first_inputs or origin.input_names
    inputs = settings.get("inputs", list(columns))
    for name, value in fixed.items():
        if not isinstance(value, bool | int | float | str):
            raise DataError(f"fixed.{name} must be a number or a text")
    return SystemNominal(
        factory=factory,
        code=code,
        fitted=tuple(
            FittedParameter(
                name=str(name),
                start=float(start),
                low=-np.inf if low is None else float(low),
                high=np.inf if high is None else float(high),
            )
            for name, start, low, high in settings["fitted"]
        ),
        time_step=origin.time_step,
        state_names=texts("states", states),
        input_names=texts("inputs", inputs),
        fixed=fixed,
    )


def _correction(
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    kinematics: Kinematics,
    input_names: tuple[str, ...],
    feature_count: int,
) -> Correction | None:
    """Makes the correction by the past of a file's parts; None where it has none."""
    steps = header.get("correction")
    if steps is None:
        return None
    for before, after in itertools.pairwise([0, *steps]):
        check_number("correction", after, above=before, whole=True, unit="[steps]")
    arrays = _regression_arrays(
        "correction", tensors, kinematics, input_names, feature_count, (len(steps),)
    )
    return Correction(kinematics, tuple(steps), **arrays)


def _start_filter(
    tensors: Mapping[str, Tensor],
    kinematics: Kinematics,
    input_names: tuple[str, ...],
    feature_count: int,
) -> StartFilter | None:
    """Makes the filter of the start of a file's parts; None where it has none."""
    if "start_filter/weights" not in tensors:
        return None
    arrays = _regression_arrays(
        "start_filter", tensors, kinematics, input_names, feature_count, ()
    )
    return StartFilter(kinematics, **arrays)


def _regression_arrays(
    name: str,
    tensors: Mapping[str, Tensor],
    kinematics: Kinematics,
    input_names: tuple[str, ...],
    feature_count: int,
    batch: tuple[int, ...],
) -> dict[str, Array]:
    """Returns the arrays of regressions on the past.

    Raises:
        DataError: They are not those of the model.
    """
    arrays = {key: tensors[f"{name}/{key}"].numpy() for key in _REGRESSION_TENSORS}
    e = kinematics.space.error_dim
    m = len(input_names)
    r = feature_count + len(ROWS_SEEN) * (e + m) + BINS * m + e
    check_shape(f"{name}/mean", arrays["mean"], (*batch, r))
    check_shape(f"{name}/deviation", arrays["deviation"], (*batch, r))
    check_shape(f"{name}/weights", arrays["weights"], (*batch, 1 + r, e))
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise DataError(f"{name} must be finite")
    if not (arrays["deviation"] > 0).all():
        raise DataError(f"the deviations of {name} must be positive")
    return arrays


def _parameter_count(nominal: Any, outputs: int, feature_count: int) -> int:
    """Returns the number of parameters of a nominal model.

    Raises:
        DataError: It is put together of parts whose sizes are not theirs.
    """
    if isinstance(nominal, GroupedNominal):
        sizes = [
            _parameter_count(part, outputs, feature_count) for part in nominal.parts
        ]
        indices = [i for own in nominal.outputs_of for i in own]
        if nominal.sizes != tuple(sizes) or len(indices) != outputs:
            raise DataError(
                f"the parts of a nominal model must have {sizes} parameters"
            )
        return sum(sizes)
    if not isinstance(nominal, AffineNominal):
        return len(nominal.parameter_names)
    return outputs * (feature_count + 1) if nominal.fitted else 0


def _check_gp(gp: OutputGP, feature_count: int) -> None:
    """Raises ``DataError`` unless a GP predicts its outputs of the features."""
    posterior = gp.posterior
    dimensions = (posterior.state_dim, posterior.input_dim, posterior.output_dim)
    expected = (feature_count, 0, len(gp.outputs))
    if posterior.predicts != "value" or dimensions != expected:
        rule = f"a GP must predict {gp.outputs!r:.80} of {feature_count} features"
        raise DataError(rule)


def _check_named(named: NamedLogModel) -> None:
    """Raises unless names and time step are those of the model."""
    n = named.model.kinematics.space.dim
    if max(n, len(named.input_names), len(named.context_names)) > _MOST:
        raise DataError(f"the model has more than {_MOST} states or inputs")
    check_number("time_step", named.time_step, above=0, unit="[s]")
    if named.time_step > _SLOWEST:
        raise DataError(f"time_step must be {_SLOWEST:g} s at most")
    if len(named.state_names) != n:
        raise DataError(f"must have {n} names of states; got {named.state_names}")


def _check_model(model: LogModel, feature_count: int) -> None:
    """Raises unless parameters, rows of the past and outputs are those of the model."""
    _check_rows("lag", model.lag)
    for rows in model.history:
        _check_rows("history", rows)
    outputs = len(model.kinematics.output_names)
    count = _parameter_count(model.nominal, outputs, feature_count)
    check_shape("theta", model.theta, (count,))
    if not np.isfinite(model.theta).all():
        raise DataError("theta must be finite")
    for gp in model.gps:
        in_range = all(type(i) is int and 0 <= i < outputs for i in gp.outputs)
        if not in_range or len(set(gp.outputs)) < len(gp.outputs):
            raise DataError(f"a GP must predict outputs; got {gp.outputs!r:.80}")


def _check_past(model: LogModel, input_dim: int, regressor_count: int) -> None:
    """Raises ``DataError`` unless what a model remembers has the model's sizes."""
    outputs = len(model.kinematics.output_names)
    if len(model.time_constants):
        check_shape("time_constants", model.time_constants, (input_dim,))
        if (model.time_constants < 0).any():
            raise DataError("time_constants must not be negative")
    seen_by_gps = any(gp.sees_memory for gp in model.gps)
    if model.weights.size or not (model.memory.empty or seen_by_gps):
        check_shape("weights", model.weights, (outputs, regressor_count))
    without = model.without_nominal
    if not all(type(i) is int and 0 <= i < outputs for i in without):
        raise DataError(f"without_nominal must name outputs; got {without!r:.80}")
    if regressor_count > _MOST:
        raise DataError(f"the model remembers more than {_MOST} numbers")


def _check_rows(key: str, rows: Any) -> None:
    """Raises unless a number of rows of the past is one."""
    check_number(key, rows, least=0, whole=True, unit="[rows]")
    if rows > _LONGEST:
        raise DataError(f"{key} must be {_LONGEST} rows at most; got {rows}")


def _check_noise(noise: OutputNoise, kinematics: Kinematics) -> None:
    """Raises ``DataError`` unless the noise is that of a model with kinematics."""
    outputs = len(kinematics.output_names)
    for rows in noise.time_constants:
        check_number("noise_rows", rows, least=0, unit="[rows]")
    check_shape("noise/outputs", noise.outputs, (len(noise.time_constants), outputs))
    check_shape("noise/measurement", noise.measurement, (kinematics.space.error_dim,))
    if not all(np.isfinite(a).all() for a in (noise.outputs, noise.measurement)):
        raise DataError("noise must be finite")
    if noise.tube is not None:
        _check_tube(noise.tube, outputs, kinematics.space.error_dim)
    if not noise.steps:
        return
    _check_noise_steps(noise.steps)
    shape = len(noise.steps), kinematics.space.error_dim
    check_shape("noise/scales", noise.scales, shape)
    if not (np.isfinite(noise.scales) & (noise.scales > 0)).all():
        raise DataError("noise/scales must be finite and positive")
    if not noise.largest.size:
        return
    check_shape("noise/largest", noise.largest, shape)
    if not (np.isfinite(noise.largest) & (noise.largest > 0)).all():
        raise DataError("noise/largest must be finite and positive")


def _check_tube(tube: TubeNoise, outputs: int, error_dim: int) -> None:
    """Raises ``DataError`` unless the noise of a tube is that of a model."""
    check_shape("noise/tube_outputs", tube.outputs, (outputs,))
    check_shape("noise/tube_start", tube.start, (error_dim,))
    for name, variances in tube._asdict().items():
        if not (np.isfinite(variances) & (variances >= 0)).all():
            raise DataError(f"noise/tube_{name} must be finite and not negative")


def _check_noise_steps(steps: Sequence[int]) -> None:
    """Raises ``DataError`` unless steps are numbers of steps that increase."""
    for step in steps:
        check_number("noise_steps", step, least=1, whole=True)
    if list(steps) != sorted(set(steps)):
        raise DataError("noise_steps must increase")


def check_shape(key: str, array: Array, shape: tuple[int, ...]) -> None:
    """Raises ``DataError`` unless an array has a shape."""
    if array.shape != shape:
        raise DataError(f"{key} must have shape {shape}; got {array.shape}")
