"""Where the configuration lies, which choices each command has, and where its classes are looked for."""

import os
import sys
from pathlib import Path

from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

import gpmpc
from gpmpc.exceptions import GpmpcError


def config_folder() -> Path:
    """The configuration: beside the package's modules in a wheel, beside the package in a checkout."""
    package = Path(gpmpc.__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def find_modules_here() -> None:
    """Lets ``_target_`` name what stands in the working folder, behind everything that is installed.

    Raises:
        GpmpcError: There is no working folder any more.
    """
    try:
        here = os.getcwd()
    except OSError as error:
        raise GpmpcError("the working folder is gone; change to one that exists") from error
    if here not in sys.path:
        sys.path.append(here)


def groups_of(config_name: str) -> list[str]:
    """The groups that a command chooses from; all commands share the folder, but not every group."""
    defaults = OmegaConf.load(config_folder() / f"{config_name}.yaml").defaults
    keys = [key for entry in defaults if OmegaConf.is_dict(entry) for key in entry]
    return [key for key in keys if not key.startswith("override ")]


def _choices_of(config_name: str) -> str:
    """For the help: a line a group."""
    options = GlobalHydra.instance().config_loader().get_group_options
    return "\n".join(f"{key}: {', '.join(options(key.partition('@')[0]))}" for key in sorted(groups_of(config_name)))


OmegaConf.register_new_resolver("choices_of", _choices_of, replace=True)
