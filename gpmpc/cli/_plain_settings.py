"""Makes plain data of a run's settings: all that its result depends on.

Loads nothing that flies: a sweep compares thousands of runs before it needs that.
"""

from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gpmpc.exceptions import SettingError

#: settings that a result does not depend on
ASIDE = ("launcher", "retries", "chunk", "folder", "live", "tracker")
_GROUPS = (
    "data",
    "trajectory",
    "system",
    "model",
    "controller",
    "propagation",
    "solver",
    "learning",
)


def plain_data(config: DictConfig) -> dict[str, Any]:
    """Returns settings with everything resolved."""
    data: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return data


def plain_settings(config: DictConfig, options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns all that a result depends on, as plain data.

    Args:
        config: The settings.
        options: The chosen option by group, which is kept under ``options``.

    Raises:
        SettingError: The file of the model cannot be read here.
    """
    settings = plain_data(config)
    path = settings["model"].get("path")
    if path:
        settings["model"]["sha256"] = _fingerprint_of_setting(path)
    settings = {key: value for key, value in settings.items() if key not in ASIDE}
    return settings | {"options": chosen_options(options)}


def _fingerprint_of_setting(path: str) -> str:
    """Returns the fingerprint of the model's file that ``model.path`` names.

    Raises:
        SettingError: It cannot be read here.
    """
    try:
        return model_fingerprint(path)
    except OSError as error:
        raise SettingError(
            "model.path", f"cannot read {path}: {error.strerror or error}"
        ) from error


def model_fingerprint(path: str) -> str:
    """Returns digits that differ where a model's file does."""
    return sha256(Path(path).read_bytes()).hexdigest()


def chosen_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the chosen option of each group that a result depends on."""
    return {group: options.get(group) for group in _GROUPS}
