"""The folder of the settings, the choices that each command has, and their completion in a shell."""

import io
import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

import gpmpc
from gpmpc.exceptions import GpmpcError


def config_folder() -> Path:
    """Returns the settings' folder: beside the package's modules in a wheel, beside the package in a checkout."""
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


def settings_of(config_name: str) -> list[str]:
    """Returns every setting of a command, dotted."""

    def keys(node: object, prefix: str = "") -> list[str]:
        if not isinstance(node, dict):
            return []
        return [name for key, value in node.items() for name in (f"{prefix}{key}", *keys(value, f"{prefix}{key}."))]

    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(config_folder())):
        return keys(OmegaConf.to_container(hydra.compose(config_name), resolve=False))


def complete(arguments: list[str], configs: Mapping[str, str], others: Iterable[str]) -> None:
    """Prints what a shell evaluates once (``-sc install=bash``), or what may come next (``-sc query=bash``).

    Hydra completes settings, but has no subcommands.

    Args:
        arguments: All of the command line.
        configs: Name of the configuration, by command.
        others: Commands without one.

    Raises:
        GpmpcError: The arguments ask for neither.
    """
    asked = [argument for argument in arguments if argument.startswith(("install=", "uninstall=", "query="))]
    if len(asked) != 1:
        raise GpmpcError("-sc: takes one of install=SHELL, uninstall=SHELL and query=SHELL, with bash, zsh or fish")
    if not asked[0].startswith("query="):
        _complete_by_hydra(asked[0], configs["run"])
        return
    words = os.environ.get("COMP_LINE", "").split(" ")
    if len(words) <= 2:
        print("\n".join([*configs, *others]))
    elif words[1] in configs:
        config_name, found = configs[words[1]], io.StringIO()
        os.environ["COMP_LINE"] = " ".join([words[0], *words[2:]])
        # What is typed so far may be no setting yet: then there is nothing to say, least of all on the standard error.
        with redirect_stdout(found), redirect_stderr(io.StringIO()), suppress(Exception, SystemExit):
            _complete_by_hydra(asked[0], config_name)
        ours, all_groups = _groups_of(config_name), {path.name for path in config_folder().iterdir() if path.is_dir()}
        foreign = tuple(f"{group}=" for group in all_groups - {key.partition("@")[0] for key in ours})
        print("\n".join(word for word in found.getvalue().split() if not word.startswith(foreign)))


def _complete_by_hydra(asked: str, config_name: str) -> None:
    sys.argv = ["gpmpc", "-sc", asked]
    hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=config_name)(lambda config: None)()


def _groups_of(config_name: str) -> list[str]:
    """Returns the groups that a command chooses from; all commands share the folder, but not every group."""
    defaults = OmegaConf.load(config_folder() / f"{config_name}.yaml").defaults
    keys = [key for entry in defaults if OmegaConf.is_dict(entry) for key in entry]
    return [key for key in keys if not key.startswith("override ")]


def _choices_of(config_name: str) -> str:
    """Returns a line a group, for the help."""
    options = GlobalHydra.instance().config_loader().get_group_options
    return "\n".join(f"{key}: {', '.join(options(key.partition('@')[0]))}" for key in sorted(_groups_of(config_name)))


OmegaConf.register_new_resolver("choices_of", _choices_of, replace=True)
