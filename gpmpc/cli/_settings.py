"""Composes the settings of commands, and explains a mistake in them in one line."""

import difflib
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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

# Of files of models, quoted or not.
_MODEL_ENDINGS = (".safetensors", ".safetensors'", '.safetensors"')


def folder_of(folder: Any) -> Path:
    """Returns the folder that the setting ``folder`` names."""
    if not isinstance(folder, str) or not folder.strip():
        raise SettingError("folder", f"must be the path of a folder; got {folder!r}")
    return Path(folder)


@contextmanager
def writing(folder: Path, key: str = "folder") -> Iterator[None]:
    """Turns errors of writing to ``folder`` into one of the setting that named it."""
    try:
        yield
    except OSError as error:
        raise SettingError(
            key, f"cannot write to {folder}: {error.strerror or error}"
        ) from error


def write_files(
    folder: Path, files: Mapping[str, str | bytes], key: str = "folder"
) -> str:
    """Writes files, each in one piece, and makes the folder.

    Returns:
        The line that says so.
    """
    with writing(folder, key):
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(folder / name, content)
    return f"written to {folder}: {', '.join(sorted(files))}"


def config_folder() -> Path:
    """Returns the settings' folder.

    It is inside the package in a wheel, beside the package in a checkout.
    """
    package = Path(gpmpc.__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


@contextmanager
def settings(own: str | None = None) -> Iterator[None]:
    """Lets Hydra find the package's settings, and behind them those in ``own``."""
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
    here = working_folder()
    if here not in sys.path:
        sys.path.append(here)


def working_folder() -> str:
    """Returns the working folder.

    Raises:
        GpmpcError: It is gone; libraries that are loaded there may end the process.
    """
    try:
        return os.getcwd()
    except OSError as error:
        raise GpmpcError(
            "the working folder is gone; change to one that exists"
        ) from error


def compose(name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Returns the settings of ``conf/NAME.yaml`` with overrides.

    Hydra's own are ``HydraConfig.get()`` from then on.
    """
    config = hydra.compose(name, [*overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    return without_hydra(config)


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


def group_options(name: str) -> dict[str, list[str]]:
    """Returns the options of every group that ``conf/NAME.yaml`` chooses from."""
    get_options = GlobalHydra.instance().config_loader().get_group_options
    groups = []
    other_files = []
    for entry in OmegaConf.load(config_folder() / f"{name}.yaml").defaults:
        if OmegaConf.is_dict(entry):
            groups += [key for key in entry if not key.startswith("override ")]
        elif isinstance(entry, str) and entry != "_self_":
            other_files.append(entry)
    options = {group: get_options(group.partition("@")[0]) for group in sorted(groups)}
    for other in other_files:
        options |= group_options(other)
    return options


def help_text(name: str) -> str:
    """Returns what ``gpmpc COMMAND --help`` prints: use, choices and settings."""
    choices = "\n".join(
        f"{key}: {', '.join(options)}" for key, options in group_options(name).items()
    )
    every = OmegaConf.to_yaml(compose(name))
    header = HydraConfig.get().help.header
    return (
        f"{header}\n\nChoices:\n\n{choices}\n\n"
        f"Every setting, with its default:\n\n{every}"
    )


def explain(error: Exception, name: str) -> str | None:
    """Returns a user's mistake in one line; None where the error is not the user's."""
    if own_error(error):
        return one_line(error)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _of_settings(error, name)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    # A value that no check foresaw.
    if name and isinstance(error, TypeError | ValueError | ArithmeticError):
        reason = " ".join(str(error).split()) or type(error).__name__
        return f"{reason}; is a setting of the wrong kind? --debug shows where"
    return None


def nearest(name: str, known: Iterable[str]) -> str:
    """Returns what a misspelt name may stand for, as a question.

    Of a name without dots the last parts are compared.
    """

    def compared(key: str) -> str:
        return key.lower() if "." in name else key.rpartition(".")[2].lower()

    names = [*known]
    close = difflib.get_close_matches(
        name.lower(), {compared(key) for key in names}, n=1
    )
    meant = [key for key in names if compared(key) in close]
    meant.sort(key=lambda key: key.count("."))
    without_dots = [key for key in meant if "." not in key]
    shown = without_dots or meant[:3]
    return f" (did you mean {' or '.join(map(repr, shown))}?)" if shown else ""


def _of_settings(error: Exception, name: str) -> str:
    """Returns an error of Hydra or OmegaConf in one line.

    A common one is said in the words of this package.
    """
    if isinstance(error, OverrideParseException):
        return (
            f"{error.override!r}: cannot be read; a setting is written SETTING=VALUE, "
            "in single quotes where the value holds brackets, braces, commas or spaces"
        )
    if isinstance(error, MissingMandatoryValue):
        key = error.full_key
        return f"{key}: this setting has no default; give it as {key}=VALUE"
    text = str(error)
    for pattern, explanation in _EXPLANATIONS:
        match = pattern.search(text)
        if match:
            return explanation(match, name)
    return _joined_lines(text) or type(error).__name__


def _unknown_setting(match: re.Match[str], name: str) -> str:
    setting = match["setting"]
    with settings():
        question = nearest(setting, setting_names(name))
    return f"unknown setting {setting!r}{question}"


def _unknown_option(match: re.Match[str], name: str) -> str:
    option = match["option"]
    available = match["available"].split()
    return (
        f"{match['group']}: no such option {option!r}; "
        f"available are {', '.join(available)}{nearest(option, available)}"
    )


def _unknown_target(match: re.Match[str], name: str) -> str:
    return f"_target_: no such class or function {match['target']!r}"


def _list_without_brackets(match: re.Match[str], name: str) -> str:
    key = match["key"]
    explanation = f"{key}: a list is written in brackets, {key}=[{match['values']}]"
    return f"{explanation}; a sweep takes -m" if name == "run" else explanation


# Messages of Hydra, and what says them in the words of this package: a function of the
# match and of the command's settings.
_EXPLANATIONS: tuple[
    tuple[re.Pattern[str], Callable[[re.Match[str], str], str]], ...
] = (
    (re.compile(r"\ACould not override '(?P<setting>[^']+)'"), _unknown_setting),
    (
        re.compile(
            r"Could not find '(?P<group>[^'/]+)/(?P<option>[^']+)'\s+"
            r"Available options in '[^']+':\n(?P<available>(?:\t.*\n)+)"
        ),
        _unknown_option,
    ),
    (re.compile(r"\AError locating target '(?P<target>[^']+)'"), _unknown_target),
    (
        re.compile(
            r"\AAmbiguous value for argument '(?P<key>[^=]+)=(?P<values>[^']+)'"
        ),
        _list_without_brackets,
    ),
)


def _joined_lines(text: str) -> str:
    """Returns a message of several lines in one, without links to Hydra's pages."""
    lines = [line.strip() for line in text.splitlines() if "hydra.cc" not in line]
    return "; ".join(line.rstrip(".:;") for line in lines if line)


def own_error(error: BaseException | None) -> GpmpcError | None:
    """Returns the error of this package that another one is, or was raised from."""
    while error is not None and not isinstance(error, GpmpcError):
        error = error.__cause__
    return error


def one_line(error: BaseException) -> str:
    """Returns the reason of an error in one line."""
    ours = own_error(error)
    reason = f"{type(error).__name__}: {error}" if ours is None else str(ours)
    return " ".join(reason.split())
