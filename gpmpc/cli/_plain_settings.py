"""Makes plain data of a run's settings: all that its result depends on.

Loads nothing that flies: a sweep compares thousands of runs before it needs that.
"""

from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

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
    """
    settings = plain_data(config)
    path = settings["model"].get("path")
    if path:
        settings["model"]["sha256"] = model_fingerprint(path)
    settings = {key: value for key, value in settings.items() if key not in ASIDE}
    return settings | {"options": chosen_options(options)}


def model_fingerprint(path: str) -> str:
    """Returns digits that differ where a model's file does."""
    return sha256(Path(path).read_bytes()).hexdigest()


def chosen_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the chosen option of each group that a result depends on."""
    return {group: options.get(group) for group in _GROUPS}
