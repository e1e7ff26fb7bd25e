"""Composes the settings of a command with Hydra, and lists what can be set."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, open_dict

import gpmpc
from gpmpc.exceptions import GpmpcError, SettingError

ENDINGS = (".safetensors", ".safetensors'", '.safetensors"')  # of files of models, quoted or not


def config_folder() -> Path:
    """Returns the settings' folder: beside the package's modules in a wheel, beside the package in a checkout."""
    package = Path(gpmpc.__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


@contextmanager
def settings(own: str | None = None) -> Iterator[None]:
    """Lets Hydra find the package's settings, and those in a folder ``own`` behind them.

    What stands in the working folder can be named by ``_target_`` inside, behind everything that is installed.
    """
    try:
        here = os.getcwd()
    except OSError as error:
        raise GpmpcError("the working folder is gone; change to one that exists") from error
    if here not in sys.path:
        sys.path.append(here)
    if own is not None:
        _search_also(Path(own))
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(config_folder())):
        yield


def _search_also(folder: Path) -> None:
    if not folder.is_dir():
        raise SettingError("--config-dir", f"{folder}: no such folder")

    class OwnFolder(SearchPathPlugin):
        def manipulate_search_path(self, search_path: Any) -> None:
            search_path.append("command-line", f"file://{folder.absolute()}")

    Plugins.instance().register(OwnFolder)


def compose(name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Returns the settings of ``conf/NAME.yaml`` with overrides; Hydra's own are ``HydraConfig.get()`` from then on."""
    config = hydra.compose(name, [*overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    return without_hydra(config)


def model_file(override: str) -> list[str]:
    """Returns an override; in the place of ``model=FILE``, of a file or several, the option that reads it."""
    key, _, value = override.partition("=")
    return ["model=saved", f"model.path={value}"] if key == "model" and value.endswith(ENDINGS) else [override]


def without_hydra(config: DictConfig) -> DictConfig:
    config = config.copy()
    with open_dict(config):
        del config["hydra"]
    return config


def setting_names(name: str, overrides: Sequence[str] = ()) -> list[str]:
    """Returns every setting of ``conf/NAME.yaml``, dotted; each after the node that holds it."""

    def keys(node: object, prefix: str = "") -> list[str]:
        if not isinstance(node, dict):
            return []
        return [key for k, value in node.items() for key in (f"{prefix}{k}", *keys(value, f"{prefix}{k}."))]

    return keys(OmegaConf.to_container(hydra.compose(name, [*overrides]), resolve=False))


def group_options(name: str) -> dict[str, list[str]]:
    """Returns the options of every group that ``conf/NAME.yaml`` chooses from; not every command has every group."""
    defaults = OmegaConf.load(config_folder() / f"{name}.yaml").defaults
    keys = [key for entry in defaults if OmegaConf.is_dict(entry) for key in entry if not key.startswith("override ")]
    options = GlobalHydra.instance().config_loader().get_group_options
    found = {key: options(key.partition("@")[0]) for key in sorted(keys)}
    for other in (entry for entry in defaults if isinstance(entry, str) and entry != "_self_"):
        found |= group_options(other)
    return found


def help_text(name: str) -> str:
    """Returns what ``gpmpc COMMAND --help`` prints: how it is used, its choices, every setting with its value."""
    choices = "\n".join(f"{key}: {', '.join(options)}" for key, options in group_options(name).items())
    every, header = OmegaConf.to_yaml(compose(name)), HydraConfig.get().help.header
    return f"{header}\n\nChoices:\n\n{choices}\n\nEvery setting, with its default:\n\n{every}"
