"""Problem: shells ask at every TAB for what may come next; Hydra completes settings, but knows no subcommands."""

import io
import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import redirect_stderr, redirect_stdout, suppress

import hydra

from gpmpc.cli.configuration import config_folder, groups_of
from gpmpc.exceptions import GpmpcError


def complete(arguments: list[str], configs: Mapping[str, str], others: Iterable[str]) -> None:
    """Answers ``-sc install=bash`` (what a shell evaluates once) and ``-sc query=bash`` (what it asks at TAB).

    Args:
        arguments: All of the command line.
        configs: Name of the configuration, by command.
        others: Commands without one.

    Raises:
        GpmpcError: Neither is asked for.
    """
    asked = [argument for argument in arguments if argument.startswith(("install=", "uninstall=", "query="))]
    if len(asked) != 1:
        raise GpmpcError("-sc: takes one of install=SHELL, uninstall=SHELL and query=SHELL, with bash, zsh or fish")
    if not asked[0].startswith("query="):
        _hydra(asked[0], configs["run"])
        return
    words = os.environ.get("COMP_LINE", "").split(" ")
    if len(words) <= 2:
        print("\n".join([*configs, *others]))
    elif words[1] in configs:
        config_name, found = configs[words[1]], io.StringIO()
        os.environ["COMP_LINE"] = " ".join([words[0], *words[2:]])
        # What is typed so far may be no setting yet: then there is nothing to say, least of all on the standard error.
        with redirect_stdout(found), redirect_stderr(io.StringIO()), suppress(Exception, SystemExit):
            _hydra(asked[0], config_name)
        ours, all_groups = groups_of(config_name), {path.name for path in config_folder().iterdir() if path.is_dir()}
        foreign = tuple(f"{group}=" for group in all_groups - {key.partition("@")[0] for key in ours})
        print("\n".join(word for word in found.getvalue().split() if not word.startswith(foreign)))


def _hydra(asked: str, config_name: str) -> None:
    sys.argv = ["gpmpc", "-sc", asked]
    hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=config_name)(lambda config: None)()
