"""Systems with named parameters as structures: vehicles, and those of the user."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gpmpc._trust import SYSTEM_CODE, package_of, trusted_code
from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs._log import Log
from gpmpc.logs._nominal_system import NominalSystem
from gpmpc.models._namings import order_by_name
from gpmpc.models._system_nominal import (
    FittedParameter,
    SystemNominal,
    numeric_arguments,
    usual_bounds,
)
from gpmpc.systems import (
    DifferentialDrive,
    DynamicBicycle,
    KinematicBicycle,
    LaggedDifferentialDrive,
)

STEERING = "steering"  # input of a bicycle
HEADING = 2  # where the heading stands in the state of a vehicle
_FULL_STEERING = 0.4  # [rad] of steering that has no unit, at its largest
_POSITIVE = (  # parameters that are no sign of anything
    "front_length",
    "front_stiffness",
    "rear_stiffness",
    "front_grip",
    "rear_grip",
    "yaw_ratio",
    "speed_decay",
    "turn_decay",
)
_SMALLEST = 1e-3  # of the start of a positive parameter


class _Vehicle(NamedTuple):
    """What a kind of vehicle is, for a number of states."""

    factory: Any
    states: str  # in words


VEHICLES: dict[str, dict[int, _Vehicle]] = {
    "bicycle": {
        4: _Vehicle(KinematicBicycle, "x, y, heading, speed"),
        6: _Vehicle(
            DynamicBicycle, "x, y, heading, forward speed, lateral speed, yaw rate"
        ),
    },
    "differential_drive": {
        3: _Vehicle(DifferentialDrive, "x, y, heading"),
        5: _Vehicle(LaggedDifferentialDrive, "x, y, heading, speed, turn rate"),
    },
}


def system_nominal(log: Log) -> SystemNominal | None:
    """Returns the system that a log's mapping names; None where it names none.

    Raises:
        SettingError: The system cannot be made, or has other states or inputs.
    """
    if log.mapping.nominal is not None:
        return _nominal_of_user(log.mapping.nominal, log)
    if log.mapping.model in VEHICLES:
        return _nominal_of_vehicle(log)
    return None


def _nominal_of_vehicle(log: Log) -> SystemNominal:
    kinds = VEHICLES[log.mapping.model]
    vehicle = kinds.get(log.space.dim)
    angles = log.space.angles
    if vehicle is None or HEADING not in angles or len(log.input_names) != 2:
        choices = "; or ".join(kind.states for kind in kinds.values())
        raise SettingError(
            "model",
            f"{log.mapping.model} needs the states {choices}, in this order (the "
            "heading of kind: angle), and two inputs; "
            f"got {', '.join(log.space.names)} and {', '.join(log.input_names)}",
        )
    values = numeric_arguments(vehicle.factory, vehicle.factory.__name__)
    fixed: dict[str, float] = {}
    scale = _steering_scale(log)
    if vehicle.factory is KinematicBicycle:
        del values["steering_scale"]
        fixed["steering_scale"] = scale
    elif vehicle.factory is DynamicBicycle:
        values["steering_gain"] = scale
    fitted = [
        FittedParameter(
            name, value, low=_SMALLEST * value if name in _POSITIVE else -np.inf
        )
        for name, value in values.items()
    ]
    return SystemNominal(
        factory=vehicle.factory,
        code=f"gpmpc.systems:{vehicle.factory.__name__}",
        fitted=tuple(fitted),
        time_step=log.time_step,
        state_names=log.space.names,
        input_names=log.input_names,
        fixed=fixed,
        namings=log.mapping.namings,
    )


def _steering_scale(log: Log) -> float:
    """Returns the angle [rad] of a unit of the steering.

    It is the input that is called so, or the first one where none is.
    """
    order = order_by_name((STEERING, "drive"), log.mapping.namings.inputs)
    steering = order[0] if order is not None else 0
    signals = log.mapping.of("inputs")
    units = [signal.group.unit for signal in signals for _ in signal.group.entries]
    if units[steering] == "rad":
        return 1.0
    largest = max(float(np.abs(run.inputs[:, steering]).max()) for run in log)
    return _FULL_STEERING / largest if largest > 0 else 1.0


def _nominal_of_user(system: NominalSystem, log: Log) -> SystemNominal:
    factory = factory_of(system.code)
    defaults = numeric_arguments(factory, system.code)
    parameters = system.parameters
    if not parameters:
        parameters = tuple(
            FittedParameter(name, value)
            for name, value in defaults.items()
            if name not in system.fixed
        )
    if not parameters:
        raise SettingError(
            "nominal", f"{system.code} has no argument that is a number by default"
        )
    arguments = {**system.fixed, **{one.name: one.start for one in parameters}}
    fitted = [
        parameter
        if parameter.name in system.bounded
        else _with_usual_bounds(parameter, factory, system.code, arguments, log)
        for parameter in parameters
    ]
    return SystemNominal(
        factory=factory,
        code=system.code,
        fitted=tuple(fitted),
        time_step=log.time_step,
        state_names=log.space.names,
        input_names=log.input_names,
        fixed=system.fixed,
        namings=log.mapping.namings,
    )


def _with_usual_bounds(
    parameter: FittedParameter,
    factory: Callable[..., Any],
    code: str,
    arguments: dict[str, Any],
    log: Log,
) -> FittedParameter:
    low, high = usual_bounds(factory, code, arguments, parameter.name, log.time_step)
    return FittedParameter(parameter.name, parameter.start, low, high)


def factory_of(code: str) -> Callable[..., Any]:
    """Imports the class or function that makes a system.

    Raises:
        SettingError: There is none.
    """
    try:
        package = "gpmpc" if code in SYSTEM_CODE else package_of(code)
        factory = trusted_code(code, [package])
    except DataError as error:
        raise SettingError("nominal", str(error)) from error
    if not callable(factory):
        raise SettingError("nominal", f"{code} must be a class or a function")
    return factory
