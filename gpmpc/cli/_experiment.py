"""Makes the objects of a flight from its settings.

    settings -> checked -> completed, each part as it will be called -> Experiment

Those that a user gives may call anything; those out of a file are checked first.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf, open_dict

from gpmpc._dynamics import DynamicsModel
from gpmpc.cli._folders import folder_of
from gpmpc.cli._mlflow import check_tracker
from gpmpc.cli._plain_settings import plain_data
from gpmpc.cli._recorded_settings import checked_settings
from gpmpc.exceptions import SettingError, check_number
from gpmpc.logs import SavedModel
from gpmpc.simulation import Noise
from gpmpc.studies.flight import Experiment
from gpmpc.systems import System

_NEEDED_GROUPS = ("data", "trajectory", "system", "model", "controller")
_SECTIONS = (  # settings that have settings
    *_NEEDED_GROUPS,
    "controller.problem",
    "controller.problem.cost",
    "controller.problem.inputs",
    "controller.problem.input_rates",
    "controller.prediction",
    "noise",
    "plant",
    "nominal",
)
# Settings that no object takes, and their values.
_CHOICES = {
    "recorder": ("mcap", "none"),
    "tracker": ("mlflow", "none"),
    "live": (True, False),
}


def experiment_of(config: DictConfig) -> Experiment:
    """Makes the objects that a user's settings describe; they may call anything.

    What is flown is tracked: what a file describes is not.
    """
    check_tracker(config.get("tracker"))
    return _build(_completed(DictConfig(plain_data(config))))


def experiment_of_file(settings: dict[str, Any], trusted: Sequence[str]) -> Experiment:
    """Makes the objects that settings out of a file describe.

    Args:
        settings: Plain data (``read_settings``).
        trusted: Packages whose code they may call, besides what ``gpmpc._trust`` lists.

    Raises:
        DataError: They call something else.
    """
    completed = plain_data(_completed(DictConfig(settings)))
    return _build(DictConfig(checked_settings(completed, trusted)))


def _completed(config: DictConfig) -> DictConfig:
    """Checks settings and completes their parts, each as it will be called.

    Nothing that they name is imported or called before ``_build``.
    """
    _check(config)
    _complete_systems(config)
    _choose_parts(config)
    return config


def _complete_systems(config: DictConfig) -> None:
    """Makes whole systems of what a nominal system and a plant differ in.

    The settings of a plant repeat those of its system, so that each can be set: a
    plant that differs in none is the system itself.
    """
    with open_dict(config):
        nominal = config.nominal
        if nominal and "_target_" not in nominal:
            config.nominal = OmegaConf.merge(config.system, nominal)
        changes = {
            key: value
            for key, value in (config.plant or {}).items()
            if value != config.system.get(key)
        }
        config.plant = OmegaConf.merge(config.system, changes) if changes else None


def _choose_parts(config: DictConfig) -> None:
    """Gives the controller the propagator and the solver that are chosen beside it."""
    for group, argument in (("propagation", "propagator"), ("solver", "solver")):
        if not config.get(group):
            continue
        if argument not in config.controller:
            raise SettingError(
                group, "this controller has none to choose; leave it out"
            )
        own = config.controller[argument]
        if isinstance(own, str):
            raise SettingError(
                group,
                f"this controller takes one by its name, as controller.{argument}="
                f"{own}; got {config[group].get('_target_')}",
            )
        with open_dict(config):
            config.controller[argument] = config[group]


def _build(config: DictConfig) -> Experiment:
    """Makes the objects of completed settings."""
    system = _system_of(config.system)
    if config.nominal:
        system = replace(system, nominal=_system_of(config.nominal))
    with open_dict(config):
        size = config.data.pop("size")  # rows for the training; no DataSource takes it
        _complete_controller(config.controller, system)
    ((name, trajectory),) = config.trajectory.items()
    data = instantiate(config.data, _convert_="all")
    controller = instantiate(config.controller, _convert_="all")
    disturbances = instantiate(config.disturbances, _convert_="all")
    train = instantiate(config.model, _convert_="all")
    model = _saved_model(train, system)
    training: Any = train if model is None else None
    if config.nominal and getattr(train, "predicts", "") not in ("difference", None):
        raise SettingError(
            "nominal", "needs model=difference_gp, which learns what it misses"
        )
    has_noise = config.noise and any(config.noise.values())
    noise = Noise(**config.noise) if has_noise else None
    learning = None
    if config.get("learning"):
        learning = instantiate(config.learning, _convert_="all")
    return Experiment(
        data=data,
        trajectory=instantiate(trajectory, _convert_="all"),
        system=system,
        train=training,
        controller=controller,
        plant=_system_of(config.plant) if config.plant else None,
        name=name,
        size=size,
        steps=config.steps,
        seed=config.seed,
        loop=config.loop,
        propagator=getattr(controller, "keywords", {}).get("propagator"),
        noise=noise,
        disturbances=disturbances,
        on_failure=config.on_failure,
        learning=learning,
        model=model,
        kinematics=config.get("kinematics", "learned"),  # as older runs were
    )


def _saved_model(train: Any, system: System) -> DynamicsModel | None:
    """Returns the model out of a file; None where the settings train one."""
    if not isinstance(train, SavedModel):
        return None
    return train.model_for(system)


def _complete_controller(controller: DictConfig, system: System) -> None:
    """Sets what the controller and its problem leave to the system."""
    _set_where_null(controller, "initial_input", system.initial_input)
    problem = controller.problem
    if problem.cost.get("Q") is None or problem.cost.get("R") is None:
        raise SettingError(
            "controller.problem.cost",
            f"has no weights Q and R; {system.name} is to bring them",
        )
    _set_where_null(problem.cost, "angles", system.angle_indices)
    _set_where_null(problem.inputs, "lower", system.input_lower)
    _set_where_null(problem.inputs, "upper", system.input_upper)


def _set_where_null(config: DictConfig, key: str, numbers: Sequence[float]) -> None:
    if config.get(key) is None:
        config[key] = list(numbers)


def _system_of(settings: Any) -> System:
    """Makes the system that the settings ``system`` describe."""
    system = instantiate(settings, _convert_="all")
    if not isinstance(system, System):
        raise SettingError(
            "system",
            "_target_ must name a function that returns a gpmpc.systems.System; "
            f"got {type(system).__name__}",
        )
    return system


def _check_sections(config: DictConfig) -> None:
    """Raises where one value stands in the place of a section's settings."""
    for key in _SECTIONS:
        section = OmegaConf.select(config, key)
        if section is None or OmegaConf.is_dict(section):
            continue
        rule = f"must be set by its parts, as {key}.NAME=VALUE"
        raise SettingError(key, f"{rule}; got {section!r}")


def _check(config: DictConfig) -> None:
    """Raises where a setting that no object takes is none of its choices.

    Likewise where a group has no option.
    """
    folder_of(config.folder)
    check_number("horizon", config.horizon, least=1, whole=True)
    if not OmegaConf.is_list(config.disturbances):
        raise SettingError(
            "disturbances", f"must be a list; got {config.disturbances!r}"
        )
    for key, values in _CHOICES.items():
        if config[key] is not None and config[key] not in values:
            names = " or ".join(map(repr, values))
            raise SettingError(key, f"must be {names}; got {config[key]!r}")
    if config.live and config.recorder != "mcap":
        raise SettingError(
            "live", f"needs recorder=mcap; got recorder={config.recorder}"
        )
    for group in _NEEDED_GROUPS:
        if not config.get(group):
            raise SettingError(group, "choose one")
    _check_sections(config)
    if len(config.trajectory) != 1:
        raise SettingError(
            "trajectory", f"choose one; got {', '.join(config.trajectory)}"
        )
