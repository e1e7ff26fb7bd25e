"""Runs a command: options common to all, help, and one line with exit code 2 for a user's mistake."""

import argparse
import os
import sys

from omegaconf import OmegaConf

import gpmpc
from gpmpc.cli._commands import COMMANDS, Command, Result, call
from gpmpc.cli._settings import compose, explain, help_text, model_file, nearest, settings
from gpmpc.cli._terminal import print_error, redirected_output
from gpmpc.exceptions import GpmpcError
from gpmpc.parallel import THREADS

_FLAGS = ("--json", "--quiet", "--debug")
_USAGE = """gpmpc {version}: Gaussian process model predictive control

usage: gpmpc COMMAND [SETTING=VALUE ...] [OPTIONS]

commands:
{commands}

gpmpc COMMAND --help lists what a command takes, gpmpc run --cfg prints its settings. Every command takes
  --json    print the result as JSON on the standard output, everything else on the standard error
  --quiet   print nothing but errors
  --debug   show the traceback of an error

eval "$(gpmpc completion bash)" completes at TAB; zsh likewise; fish: gpmpc completion fish | source
"""


def version(given: argparse.Namespace) -> Result:
    """Prints what a report of a bug needs: versions, the BLAS library, the processor."""
    from gpmpc._provenance import environment

    data = environment()
    print("\n".join(f"{name:10}{value}" for name, value in data.items()))
    return Result(data)


def show_usage(given: argparse.Namespace) -> Result:
    """Lists the commands."""
    lines = "\n".join(f"  {name:12}{command.summary}" for name, command in COMMANDS.items())
    print(_USAGE.format(version=gpmpc.__version__, commands=lines), end="")
    return Result()


def main() -> None:
    """Runs the command line."""
    flags, arguments = {*_FLAGS} & {*sys.argv[1:]}, [each for each in sys.argv[1:] if each not in _FLAGS]
    with redirected_output("error" if "--json" in flags else "nowhere" if "--quiet" in flags else "output"):
        result = _run(arguments, debug="--debug" in flags)
    if "--json" in flags:
        from gpmpc.studies._document import json_text

        print(json_text(result.data), end="")
    if result.code:
        sys.exit(result.code)


def _run(arguments: list[str], debug: bool) -> Result:
    """Runs a command; a user's mistake ends with one line, or with its traceback where that is asked for."""
    if {"-V", "--version"} & {*arguments}:
        arguments = ["version"]
    if arguments and arguments[0] in ("help", "-h", "--help"):
        arguments = [*arguments[1:], "--help"] if len(arguments) > 1 else []
    name, *rest = arguments or ["help"]
    command = COMMANDS.get(name)
    try:
        if command is None:
            known = f"unknown command {name!r}{nearest(name, COMMANDS)}; gpmpc --help lists the commands"
            raise GpmpcError(known)
        parser = command.parser(name)
        given, unknown = parser.parse_known_intermixed_args(rest)
        if unknown:
            hint = f"; gpmpc {name} --help lists what there is"
            raise GpmpcError(f"unknown option {unknown[0]!r}{nearest(unknown[0], parser.values)}{hint}")
        return _with_settings(name, command, given) if command.settings else call(command.task, given)
    except KeyboardInterrupt:
        resumed = command is not None and command.settings and (name != "run" or "-m" in rest or "--multirun" in rest)
        raise KeyboardInterrupt(*["the same command goes on where it stopped"] * bool(resumed)) from None
    except Exception as error:
        message = None if debug else explain(error, command.settings if command else "")
        if message is None:
            raise
        print_error(message)
        sys.exit(2)


def _with_settings(name: str, command: Command, given: argparse.Namespace) -> Result:
    """Composes the settings, and shows them or runs the command with them."""
    config_name, swept = given.config_name or command.settings, name == "tune" or getattr(given, "multirun", False)
    given.overrides = [choice for word in given.overrides for choice in model_file(word)]
    with settings(given.config_dir):
        if given.help:
            print(help_text(command.settings))
            return Result()
        if swept and given.cfg:
            raise GpmpcError("--cfg: shows the settings of one run; leave out -m, and give each setting one value")
        if swept:  # before the libraries load, here and in the processes started from here
            os.environ |= dict.fromkeys(THREADS, "1")
            given.config_name = config_name
            return call(command.task if name == "tune" else "_sweep.sweep", given)
        config = compose(config_name, given.overrides)
        if given.cfg:
            print(OmegaConf.to_yaml(config), end="")
            return Result(OmegaConf.to_container(config))
        return call(command.task, config)
