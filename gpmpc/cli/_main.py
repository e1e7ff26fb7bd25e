"""Runs the command line, from the words behind ``gpmpc`` to an exit code.

    words -> flags of all commands -> command -> parsed arguments -> settings ->
    function

A user's mistake is one line and exit code 2. Hydra is loaded for what needs it alone.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from gpmpc.cli._commands import COMMANDS, FLAGS, Result, Subcommand
from gpmpc.cli._folders import find_modules_here, working_folder
from gpmpc.cli._spelling import nearest
from gpmpc.cli._terminal import OutputEnded, print_error, redirected_output
from gpmpc.exceptions import GpmpcError
from gpmpc.parallel import THREADS


def main() -> None:
    """Runs the command line."""
    flags = {*FLAGS} & {*sys.argv[1:]}
    arguments = [word for word in sys.argv[1:] if word not in FLAGS]
    output = "output"
    if "--json" in flags:
        output = "error"
    if "--quiet" in flags:
        output = "nowhere"
    with redirected_output(output):
        result = _run(arguments, as_json="--json" in flags, debug="--debug" in flags)
    if "--json" in flags:
        from gpmpc.studies._document import json_text

        print(json_text(result.data), end="")
    if result.code:
        sys.exit(result.code)


def _run(words: Sequence[str], as_json: bool, debug: bool) -> Result:
    """Runs a command; a mistake ends with one line, or with its traceback if asked."""
    name, *words = _with_command(words)
    command = COMMANDS.get(name)
    try:
        if command is None:
            raise GpmpcError(
                f"unknown command {name!r}{nearest(name, COMMANDS)}; "
                "gpmpc --help lists the commands"
            )
        arguments = _parse(name, command, words)
        arguments.as_json = as_json
        if command.has_settings:
            return _run_with_settings(name, command, arguments)
        working_folder()
        return _call(command.module, name, arguments)
    except KeyboardInterrupt:
        if _resumes(command, words):
            advice = "the same command goes on where it stopped"
            raise KeyboardInterrupt(advice) from None
        raise KeyboardInterrupt from None
    except Exception as error:
        if debug:
            raise
        from gpmpc.cli._mistakes import explain

        has_settings = command is not None and command.has_settings
        message = explain(error, name if has_settings else "")
        if message is None:
            raise
        print_error(message)
        sys.exit(2)


def _with_command(words: Sequence[str]) -> list[str]:
    """Returns the words with the command first, however help and version are asked."""
    if "-V" in words or "--version" in words:
        return ["version"]
    if not words:
        return ["help"]
    if words[0] not in ("help", "-h", "--help"):
        return [*words]
    return [*words[1:], "--help"] if len(words) > 1 else ["help"]


def _parse(name: str, command: Subcommand, words: Sequence[str]) -> argparse.Namespace:
    """Parses what follows a command's name.

    Raises:
        GpmpcError: An argument is missing, or an option is unknown.
    """
    arguments, unknown = command.parser(name).parse_known_intermixed_args(words)
    if unknown:
        raise GpmpcError(
            f"unknown option {unknown[0]!r}"
            f"{nearest(unknown[0], command.values_by_argument)}; "
            f"gpmpc {name} --help lists what there is"
        )
    return arguments


def _call(module: str, function: str, argument: Any) -> Result:
    """Calls a function of a module of ``gpmpc.cli``, which is imported now.

    Raises:
        GpmpcError: Code of the user's ended the process (``sys.exit``).
    """
    try:
        return getattr(import_module(f"gpmpc.cli.{module}"), function)(argument)
    except OutputEnded:
        raise
    except SystemExit as error:
        raise GpmpcError(
            f"code that the settings call ended the process (exit {error.code})"
        ) from error


def _run_with_settings(
    name: str, command: Subcommand, arguments: argparse.Namespace
) -> Result:
    """Composes the settings, and shows them or runs the command with them."""
    from omegaconf import OmegaConf

    from gpmpc.cli._settings import compose, help_text, model_file, settings_folders

    arguments.config_name = arguments.config_name or name
    arguments.overrides = [
        override for word in arguments.overrides for override in model_file(word)
    ]
    flies_many = name == "tune" or getattr(arguments, "multirun", False)
    with settings_folders(arguments.config_dir):
        if arguments.help:
            print(help_text(arguments.config_name, arguments.config_dir))
            return Result()
        if not arguments.cfg:
            find_modules_here()
        if flies_many and arguments.cfg:
            advice = "leave out -m, and give each setting one value"
            if name == "tune":
                advice = "ask gpmpc run --cfg, and give each setting one value"
            raise GpmpcError(f"--cfg: shows the settings of one run; {advice}")
        if flies_many:
            # Before the libraries load, here and in the processes started from here.
            os.environ |= dict.fromkeys(THREADS, "1")
            if name == "tune":
                return _call(command.module, name, arguments)
            return _call("_sweep", "sweep", arguments)
        config = compose(arguments.config_name, arguments.overrides)
        if arguments.cfg:
            print(OmegaConf.to_yaml(config), end="")
            return Result(OmegaConf.to_container(config))
        return _call(command.module, name, config)


def _resumes(command: Subcommand | None, words: Sequence[str]) -> bool:
    """Whether a command that was interrupted takes up its work when it is repeated."""
    if command is None:
        return False
    is_sweep = "-m" in words or "--multirun" in words
    return command.resumes or (command.has_settings and is_sweep)
