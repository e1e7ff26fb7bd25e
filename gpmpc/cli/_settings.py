"""Settings of commands: how they are composed, and a user's mistake in them as one line."""

import difflib
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, OverrideParseException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

import gpmpc
from gpmpc._files import write_whole
from gpmpc.exceptions import GpmpcError, SettingError

ENDINGS = (
    ".safetensors",
    ".safetensors'",
    '.safetensors"',
)  # of files of models, quoted or not
_EXTRAS = {
    "submitit_slurm": "slurm",
    "submitit_local": "slurm",
    "ray": "ray",
}  # that bring a launcher


def folder_of(folder: Any) -> Path:
    """Returns the folder that the setting ``folder`` names."""
    if not isinstance(folder, str) or not folder.strip():
        raise SettingError("folder", f"must be the path of a folder; got {folder!r}")
    return Path(folder)


@contextmanager
def writing(folder: Path, key: str = "folder") -> Iterator[None]:
    """Turns errors of writing to ``folder`` into one of the setting ``key``, which named it."""
    try:
        yield
    except OSError as error:
        raise SettingError(
            key, f"cannot write to {folder}: {error.strerror or error}"
        ) from error


def write_files(
    folder: Path, files: Mapping[str, str | bytes], key: str = "folder"
) -> str:
    """Writes files, each in one piece, and makes the folder; returns the line that says so."""
    with writing(folder, key):
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(folder / name, content)
    return f"written to {folder}: {', '.join(sorted(files))}"


def config_folder() -> Path:
    """Returns the settings' folder: beside the package's modules in a wheel, beside the package in a checkout."""
    package = Path(gpmpc.__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


@contextmanager
def settings(own: str | None = None) -> Iterator[None]:
    """Lets Hydra find the package's settings, and those in a folder ``own`` behind them."""
    if own is not None:
        folder = Path(own)
        if not folder.is_dir():
            raise SettingError("--config-dir", f"{folder}: no such folder")

        class OwnFolder(SearchPathPlugin):
            def manipulate_search_path(self, search_path: Any) -> None:
                search_path.append("command-line", f"file://{folder.absolute()}")

        Plugins.instance().register(OwnFolder)
    with hydra.initialize_config_dir(
        version_base="1.3", config_dir=str(config_folder())
    ):
        yield


def find_modules_here() -> None:
    """Lets ``_target_`` name modules of the working folder, behind all installed ones.

    Only where they are to be called: whoever asks for help, or presses TAB, in a folder
    of somebody else's runs nothing of it. Hydra, which imports what is called like a
    plugin of its own, has looked for plugins before.
    """
    try:
        here = os.getcwd()
    except OSError as error:
        raise GpmpcError(
            "the working folder is gone; change to one that exists"
        ) from error
    if here not in sys.path:
        sys.path.append(here)


def compose(name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Returns the settings of ``conf/NAME.yaml`` with overrides; Hydra's own are ``HydraConfig.get()`` from then on."""
    config = hydra.compose(name, [*overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    return without_hydra(config)


def model_file(override: str) -> list[str]:
    """Returns an override; in the place of ``model=FILE``, of a file or several, the option that reads it."""
    key, _, value = override.partition("=")
    return (
        ["model=saved", f"model.path={value}"]
        if key == "model" and value.endswith(ENDINGS)
        else [override]
    )


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
        return [
            key
            for k, value in node.items()
            for key in (f"{prefix}{k}", *keys(value, f"{prefix}{k}."))
        ]

    return keys(
        OmegaConf.to_container(hydra.compose(name, [*overrides]), resolve=False)
    )


def group_options(name: str) -> dict[str, list[str]]:
    """Returns the options of every group that ``conf/NAME.yaml`` chooses from; not every command has every group."""
    defaults = OmegaConf.load(config_folder() / f"{name}.yaml").defaults
    keys = [
        key
        for entry in defaults
        if OmegaConf.is_dict(entry)
        for key in entry
        if not key.startswith("override ")
    ]
    options = GlobalHydra.instance().config_loader().get_group_options
    found = {key: options(key.partition("@")[0]) for key in sorted(keys)}
    for other in (
        entry for entry in defaults if isinstance(entry, str) and entry != "_self_"
    ):
        found |= group_options(other)
    return found


def help_text(name: str) -> str:
    """Returns what ``gpmpc COMMAND --help`` prints: how it is used, its choices, every setting with its value."""
    choices = "\n".join(
        f"{key}: {', '.join(options)}" for key, options in group_options(name).items()
    )
    every = OmegaConf.to_yaml(compose(name))
    header = HydraConfig.get().help.header
    return f"{header}\n\nChoices:\n\n{choices}\n\nEvery setting, with its default:\n\n{every}"


def explain(error: Exception, name: str) -> str | None:
    """Returns a user's mistake in one line; None where the error is not the user's."""
    if own_error(error):
        return one_line(error)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _of_settings(error, name)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    if name and isinstance(
        error, TypeError | ValueError | ArithmeticError
    ):  # a value that no check foresaw
        reason = " ".join(str(error).split()) or type(error).__name__
        return f"{reason}; is a setting of the wrong kind? --debug shows where"
    return None


def nearest(name: str, known: Iterable[str]) -> str:
    """Returns what a misspelt name stands for, as a question; of a name without dots the last parts are compared."""
    part = (lambda key: key) if "." in name else (lambda key: key.rpartition(".")[2])
    close = difflib.get_close_matches(
        name.lower(), {part(key).lower() for key in known}, n=1
    )
    meant = sorted(
        (key for key in known if part(key).lower() in close),
        key=lambda key: key.count("."),
    )
    meant = [key for key in meant if "." not in key] or meant[:3]
    return f" (did you mean {' or '.join(map(repr, meant))}?)" if meant else ""


def _of_settings(error: Exception, name: str) -> str:
    """Returns an error of Hydra or OmegaConf in one line, in the words of this package where it is a common one."""
    text = str(error)
    if unknown := re.match(r"Could not override '([^']+)'", text):
        with settings():
            return f"unknown setting {unknown[1]!r}{nearest(unknown[1], setting_names(name))}"
    option = re.search(
        r"Could not find '([^'/]+)/([^']+)'\s+Available options in '[^']+':\n((?:\t.*\n)+)",
        text,
    )
    if option and (extra := _EXTRAS.get(option[2].removeprefix("launcher/"))):
        return f"launcher: this one is not installed: pip install 'gpmpc[{extra}]'"
    if option:
        known = option[3].split()
        available = f"available are {', '.join(known)}{nearest(option[2], known)}"
        return f"{option[1]}: no such option {option[2]!r}; {available}"
    if isinstance(error, OverrideParseException):
        rule = f"{error.override!r}: cannot be read; a setting is written SETTING=VALUE"
        return f"{rule}, in single quotes where the value holds brackets, braces, commas or spaces"
    if unlocated := re.match(r"Error locating target '([^']+)'", text):
        return f"_target_: no such class or function {unlocated[1]!r}"
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key}: this setting has no default; give it as {error.full_key}=VALUE"
    if ambiguous := re.match(r"Ambiguous value for argument '([^=]+)=([^']+)'", text):
        listed = f"{ambiguous[1]}: a list is written in brackets, {ambiguous[1]}=[{ambiguous[2]}]"
        return f"{listed}; a sweep takes -m" if name == "run" else listed
    lines = [
        line.strip()
        for line in text.splitlines()
        if line.strip() and "hydra.cc" not in line
    ]
    return "; ".join(line.rstrip(".:;") for line in lines) or type(error).__name__


def own_error(error: BaseException | None) -> GpmpcError | None:
    """Returns the error of this package that another one was raised from, or is; None where there is none."""
    while error is not None and not isinstance(error, GpmpcError):
        error = error.__cause__
    return error


def one_line(error: BaseException) -> str:
    """Returns the reason of an error in one line."""
    ours = own_error(error)
    return " ".join((str(ours) if ours else f"{type(error).__name__}: {error}").split())
