"""Says which code a file may name: what is listed here, and packages of the caller's.

A saved model, or the settings in a recording, may name functions and classes by a
dotted path, and to import a module is to run it. So every name of a file is compared
with a list before anything is imported. ``gpmpc.`` as a prefix is no permission: most
of the package reads, writes or imports what its arguments say.

Of a package that the caller names its own code may be called, not what its modules have
imported from elsewhere: ``my_robot.os.system`` is no part of ``my_robot``.
"""

import re
import sys
from collections.abc import Iterable, Sequence
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

from gpmpc.exceptions import DataError, SettingError

#: functions that a saved model may name, ``module:name``; most models hold operations
#: and name none of these
MODEL_CODE = frozenset(
    {
        *(
            f"{module}:{function}"
            for module in ("gpmpc.systems", "gpmpc.systems._elementary")
            for function in (
                *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
                *("exp", "log", "sqrt", "abs"),
            )
        ),
        # as older files name them
        "gpmpc.systems._system:sin",
        "gpmpc.systems._system:cos",
        "gpmpc.systems._system:exp",
    }
)

#: what makes a system of numbers: a saved model of a log, or a mapping, may name it
SYSTEM_CODE = frozenset(
    f"gpmpc.systems:{name}"
    for name in [
        "DifferentialDrive",
        "DynamicBicycle",
        "KinematicBicycle",
        "LaggedDifferentialDrive",
        "acrobot",
        "cart_pole",
        "differential_drive",
        "double_integrator",
        "double_pendulum",
        "dynamic_bicycle",
        "kinematic_bicycle",
        "pendulum",
        "planar_quadrotor",
        "stirred_tank",
    ]
)

_SETTINGS = {
    "gpmpc.datasets": "ExcitedData Excitation NMPCData PaperData RandomData Tracking",
    "gpmpc.export": "compiled_controller",
    "gpmpc.gp": "SlidingWindow SoftLimits SparseTrainer Trainer centre identity "
    "min_max standardize",
    "gpmpc.learning": "EpisodicLearning OnlineLearning",
    "gpmpc.logs": "load_flyable",
    "gpmpc.mpc": "Box GPMPC Halfspaces Inequality LeastSquares ManyStarts "
    "NonlinearGPMPC PredictionSettings Problem Tracking",
    "gpmpc.mpc.baselines": "LQR NMPC StateFormMPC",
    "gpmpc.mpc.gp_mpc": "GPMPC NonlinearGPMPC",
    "gpmpc.mpc.problem": "Box Halfspaces Inequality LeastSquares Problem Tracking",
    "gpmpc.propagation": "Linearization MeanEquivalence MomentMatching MonteCarlo "
    "Unscented",
    "gpmpc.qp": "CvxpySolver DualActiveSet PrimalActiveSet",
    "gpmpc.simulation": "Dropout Gust Noise Replaced",
    "gpmpc.systems": "Coupled Map Rotational System Translational acrobot cart_pole "
    "coupled differential_drive double_integrator double_pendulum dynamic_bicycle "
    "kinematic_bicycle pendulum planar_quadrotor rotational stirred_tank translational",
    "gpmpc.systems.gymnasium_": "gymnasium_system",
    "gpmpc.systems.mujoco_": "mujoco_system",
    "gpmpc.systems.mujoco_quadrotor": "RigidBody mujoco_quadrotor",
    "gpmpc.trajectories": "Elliptical Hover Lorenz Step Waypoints",
}
#: classes and functions that settings in a file may call: what describes a flight
SETTINGS_CODE = frozenset(
    f"{module}.{name}" for module, names in _SETTINGS.items() for name in names.split()
)

#: functions of Hydra that return code by the name that is their argument ``path``
LOOKUPS = tuple(
    f"hydra.utils.get_{kind}" for kind in ("class", "method", "object", "static_method")
)

_NEVER = {*sys.stdlib_module_names, "gpmpc", "hydra", "omegaconf"}


def trusted_packages(key: str, names: Any) -> tuple[str, ...]:
    """Returns the names of packages that a caller trusts; none for None.

    Raises:
        SettingError: They are no list of names, or one is of Python itself or of what
            gpmpc is made of, whose functions do anything that their arguments say.
            ``key`` is what the setting is called.
    """
    if names is None:
        return ()
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise SettingError(
            key, f"must be a list of packages, such as ['my_robot']; got {names!r}"
        )
    packages = tuple(names)
    for name in packages:
        if not isinstance(name, str) or not all(map(str.isidentifier, parts_of(name))):
            raise SettingError(key, f"must be names of packages; got {name!r}")
        if not may_be_trusted(name):
            raise SettingError(
                key, f"{name} is no package to trust: a file could do anything with it"
            )
    return packages


def may_be_trusted(name: str) -> bool:
    """Whether a package can be trusted: not Python's own, nor what gpmpc is made of."""
    package = package_of(name)
    return package.isascii() and package not in _NEVER  # letters of others look alike


def parts_of(name: str) -> list[str]:
    """Returns the parts of a path such as ``my_robot.arm:Arm``."""
    return re.split("[.:]", name)


def package_of(name: str) -> str:
    """Returns the package that a path such as ``my_robot.arm:Arm`` begins with."""
    return parts_of(name)[0]


def is_trusted(name: str, packages: Sequence[str]) -> bool:
    """Whether a path leads into one of some packages, as far as its text says."""
    parts = parts_of(name)
    plain = all(part.isidentifier() and part[:2] != "__" for part in parts)
    return plain and any(
        parts[: len(package)] == package for package in map(parts_of, packages)
    )


def trusted_code(name: str, packages: Sequence[str]) -> Any:
    """Imports what a path names within packages that are trusted (``is_trusted``).

    Raises:
        DataError: There is nothing of this name, or it came into the package from
            another one that is neither trusted nor on a list of this module.
    """
    parts = parts_of(name)
    try:
        code: Any = import_module(parts[0])
        for count, part in enumerate(parts[1:], start=2):
            if isinstance(code, ModuleType) and not hasattr(code, part):
                import_module(".".join(parts[:count]))
            code = getattr(code, part)
            if isinstance(code, ModuleType):
                _check_home(name, code.__name__, code, packages)
    except DataError:
        raise
    except Exception as error:  # whatever the package raises when it is imported
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise DataError(f"{name} cannot be imported here ({reason})") from error
    _check_home(name, _home(code), code, packages)
    return code


def shipped_name(code: Any) -> str | None:
    """Returns the name that an object has in ``SETTINGS_CODE``; None without one."""
    if package_of(_home(code)) != "gpmpc":
        return None
    for name in SETTINGS_CODE:
        module, _, attribute = name.rpartition(".")
        if getattr(sys.modules.get(module), attribute, None) is code:
            return name
    return None


def _home(code: Any) -> str:
    """The module that a function, a class or the class of an object was written in."""
    while isinstance(code, partial):
        code = code.func
    return getattr(code, "__module__", None) or type(code).__module__


def _check_home(name: str, home: str, code: Any, packages: Sequence[str]) -> None:
    """Raises ``DataError`` of code from elsewhere that is not shipped either."""
    holds_trusted = isinstance(code, ModuleType) and any(
        package.startswith(f"{home}.") for package in packages
    )
    if holds_trusted or is_trusted(home, packages) or shipped_name(code) is not None:
        return
    raise DataError(
        f"{name} is code of {package_of(home)}, which {package_of(name)} only imports"
    )
