"""The commands, and what is common to all: options, help, and one line with exit code 2 for a user's mistake.

Heavy libraries are imported inside the tasks, so help and completion stay quick.
"""

import argparse
import sys

from omegaconf import OmegaConf

import gpmpc
from gpmpc.cli import _completion as completion
from gpmpc.cli import _learn as learn
from gpmpc.cli import _log as log
from gpmpc.cli import _new as new
from gpmpc.cli import _reports as reports
from gpmpc.cli import _run as run
from gpmpc.cli import _study as study
from gpmpc.cli._settings import Command, Result, compose, explain, help_text, model_file, nearest, settings
from gpmpc.cli._sweep import TUNE, sweep, tune
from gpmpc.cli._terminal import print_error, redirected_output
from gpmpc.exceptions import GpmpcError


def _version(given: argparse.Namespace) -> Result:
    """Prints what a report of a bug needs: versions, the BLAS library, the processor."""
    from gpmpc._provenance import environment

    data = environment()
    print("\n".join(f"{name:10}{value}" for name, value in data.items()))
    return Result(data)


def _show_usage(given: argparse.Namespace) -> Result:
    lines = "\n".join(f"  {name:12}{command.summary}" for name, command in COMMANDS.items())
    print(_USAGE.format(version=gpmpc.__version__, commands=lines), end="")
    return Result()


COMMANDS: dict[str, Command] = {
    "run": run.COMMAND,
    "tune": TUNE,
    "tables": study.TABLES,
    "figures": study.FIGURES,
    "quality": study.QUALITY,
    "new": new.COMMAND,
    "report": reports.REPORT,
    "plot": reports.PLOT,
    "calibrate": reports.CALIBRATE,
    "learn": learn.COMMAND,
    "log": log.COMMAND,
    "warmup": study.WARMUP,
    "completion": Command(
        "Prints a script that completes commands, settings and files at TAB",
        lambda given: completion.completion(given, COMMANDS),
        add_arguments=completion.add_arguments,
    ),
    "version": Command("Prints the versions of what computes, and the processor", _version),
    "help": Command(
        "Explains a command",
        _show_usage,
        add_arguments=lambda parser: parser.add_argument("name", metavar="COMMAND", nargs="?"),
    ),
}
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


def main() -> None:
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
        return _with_settings(name, command, given) if command.settings else command.task(given)
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
        if swept:
            return tune(given, config_name) if name == "tune" else sweep(given, config_name)
        config = compose(config_name, given.overrides)
        if given.cfg:
            print(OmegaConf.to_yaml(config), end="")
            return Result(OmegaConf.to_container(config))
        return command.task(config)
