"""Composes the settings of commands from files and overrides, by Hydra."""

import os
import shlex
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
from gpmpc.exceptions import SettingError

# Of files of models, those of gpmpc 1 included, in quotes or without.
_MODEL_ENDINGS = tuple(
    f"{ending}{quote}"
    for ending in (".safetensors", ".npz")
    for quote in ("", "'", '"')
)

_OWN_FOLDER = "command-line"  # where Hydra says that it found files of --config-dir
_COMMANDS_OF_RUNS = ("run", "tune")  # whose settings are those of `gpmpc run`


def config_folder() -> Path:
    """Returns the settings' folder.

    It is inside the package in a wheel, beside the package in a checkout.
    """
    package = Path(gpmpc.__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


@contextmanager
def settings_folders(own: str | None = None) -> Iterator[None]:
    """Lets Hydra find the package's settings, and behind them those in ``own``."""
    if own is not None:
        folder = Path(own)
        if not folder.is_dir():
            raise SettingError("--config-dir", f"{folder}: no such folder")
        check_own_folder(folder)

        class OwnFolder(SearchPathPlugin):
            def manipulate_search_path(self, search_path: Any) -> None:
                search_path.append(_OWN_FOLDER, f"file://{folder.absolute()}")

        Plugins.instance().register(OwnFolder)
    with hydra.initialize_config_dir(
        version_base="1.3", config_dir=str(config_folder())
    ):
        yield


def check_own_folder(folder: Path) -> None:
    """Raises where a file of ``--config-dir`` would never be read.

    The package's settings are found first, so that each file's name means the same
    everywhere.
    """
    package_folder = config_folder()
    for path in sorted(package_folder.rglob("*.yaml")):
        name = path.relative_to(package_folder)
        own = folder / name
        if own.is_file() and own.read_bytes() != path.read_bytes():
            raise SettingError(
                "--config-dir",
                f"{own} has the name of a file of gpmpc, which would be used in its "
                "place; choose another name",
            )


def compose(name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Returns the settings of ``conf/NAME.yaml`` with overrides.

    Hydra's own are ``HydraConfig.get()`` from then on.
    """
    config = hydra.compose(name, [*overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    return without_hydra(config)


def config_source_options(hydra_settings: Any) -> tuple[str, ...]:
    """Returns the options of a command by which its settings were found.

    A folder below the working folder is named from there, any other in full.

    Args:
        hydra_settings: Hydra's own, of settings that were composed.
    """
    options: list[str] = []
    name = hydra_settings.job.config_name
    if name not in _COMMANDS_OF_RUNS:
        options += ["--config-name", name]
    for source in hydra_settings.runtime.config_sources:
        if source.provider == _OWN_FOLDER:
            folder = os.path.relpath(source.path)
            if folder.startswith(os.pardir):
                folder = source.path
            options += ["--config-dir", folder]
    return tuple(options)


def run_command(options: Sequence[str], overrides: Sequence[str]) -> str:
    """Returns the command that flies one run.

    Args:
        options: By which its settings are found, of ``config_source_options``.
        overrides: What distinguishes it, ``key=value`` each.
    """
    return shlex.join(["gpmpc", "run", *options, *overrides])


def model_file(override: str) -> list[str]:
    """Returns an override, or for ``model=FILE`` the choices that read the file.

    ``FILE`` may be several, of a sweep.
    """
    key, _, value = override.partition("=")
    if key == "model" and value.endswith(_MODEL_ENDINGS):
        return ["model=saved", f"model.path={value}"]
    return [override]


def without_hydra(config: DictConfig) -> DictConfig:
    config = config.copy()
    with open_dict(config):
        del config["hydra"]
    return config


def setting_names(name: str, overrides: Sequence[str] = ()) -> list[str]:
    """Returns every setting of ``conf/NAME.yaml``, dotted, behind its node."""
    settings = OmegaConf.to_container(hydra.compose(name, [*overrides]), resolve=False)
    return _dotted_keys(settings)


def _dotted_keys(node: object, prefix: str = "") -> list[str]:
    """Returns the keys of nested mappings, dotted; each behind that of its node."""
    if not isinstance(node, dict):
        return []
    keys = []
    for key, value in node.items():
        dotted = f"{prefix}{key}"
        keys += [dotted, *_dotted_keys(value, f"{dotted}.")]
    return keys


def group_options(name: str, own: str | None = None) -> dict[str, list[str]]:
    """Returns the options of every group that ``NAME.yaml`` chooses from.

    Args:
        name: Of a file in ``conf/``, or else in ``own``.
        own: The folder of ``--config-dir``.
    """
    get_options = GlobalHydra.instance().config_loader().get_group_options
    groups = []
    other_files = []
    file = config_folder() / f"{name}.yaml"
    if own is not None and not file.exists():
        file = Path(own) / f"{name}.yaml"
    settings: Any = OmegaConf.load(file)
    for entry in settings.get("defaults", ()):
        if OmegaConf.is_dict(entry):
            groups += [key for key in entry if not key.startswith("override ")]
        elif isinstance(entry, str) and entry != "_self_":
            other_files.append(entry)
    options = {group: get_options(group.partition("@")[0]) for group in sorted(groups)}
    for other in other_files:
        options |= group_options(other, own)
    return options


def help_text(name: str, own: str | None = None) -> str:
    """Returns what ``gpmpc COMMAND --help`` prints: use, choices and settings.

    Arguments are those of ``group_options``.
    """
    every = OmegaConf.to_yaml(compose(name))
    choices = "\n".join(
        f"{key}: {', '.join(options)}"
        for key, options in group_options(name, own).items()
    )
    header = HydraConfig.get().help.header
    return (
        f"{header}\n\nChoices:\n\n{choices}\n\n"
        f"Every setting, with its default:\n\n{every}"
    )
