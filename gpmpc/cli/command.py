"""Parses the command line, composes the settings with Hydra, and turns a user's mistake into one line.

A user's mistake (an unknown setting, a missing file, a value out of range) ends with exit code 2 and one line on the
standard error; ``HYDRA_FULL_ERROR=1`` shows where it came from. Heavy libraries are imported inside the task, so help
and completion stay quick.
"""

import argparse
import difflib
import os
import re
import sys
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NoReturn

import hydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

import gpmpc
from gpmpc.cli.arguments import Parser
from gpmpc.cli.configuration import complete, config_folder, find_modules_here, settings_of
from gpmpc.cli.log import log
from gpmpc.cli.reports import plot, report
from gpmpc.cli.run import one_line, own_error, run
from gpmpc.cli.study import figures, quality, tables
from gpmpc.cli.terminal import print_error
from gpmpc.exceptions import GpmpcError

EXTRAS = {"submitit_slurm": "slurm", "submitit_local": "slurm", "ray": "ray"}  # that bring a launcher
OPTIONS: dict[str, dict[str, Any]] = {  # of Hydra, without --experimental-rerun, which runs whatever a file holds
    "--help -h": {},
    "--hydra-help": {},
    "--cfg -c": {"choices": ["job", "hydra", "all"]},
    "--resolve": {},
    "--package -p": {"metavar": "PACKAGE"},
    "--run -r": {},
    "--multirun -m": {},
    "--config-path -cp": {"metavar": "DIR"},
    "--config-name -cn": {"metavar": "NAME"},
    "--config-dir -cd": {"metavar": "DIR"},
    "--info -i": {"nargs": "?", "const": "all", "metavar": "WHAT"},
}
HELP = ("-h", "--help", "help")
SHOW_TRACEBACK = bool(os.environ.get("HYDRA_FULL_ERROR"))
USAGE = f"""gpmpc {gpmpc.__version__}: Gaussian process model predictive control

usage: gpmpc COMMAND [SETTING=VALUE ...]
       gpmpc report OUTPUTS [--compare A B] [--to DIR]
       gpmpc plot RUN [--to DIR] [--format png|pdf|svg] [--no-animation]
       gpmpc log info|recover|export|layout FILE [OUTPUT]

commands:
  run       One flight: trains a model, flies with it, records; with -m a sweep of many, resumed where it stopped
  tables    Tables 1 and 2 of Cao, Lai and Alam (2017), computed beside the printed figures
  report    A tree of runs as one table, with figures; whether two groups of runs differ
  plot      A recorded flight as figures and an animation
  figures   Figures 2 to 4 and section 5.2: the flights, in the paper's reading and with the plant in the loop
  quality   Closed-loop cost over the time of a decision, for every controller and propagation
  log       What is in a recording (info), rescue an unfinished one (recover), a table of its steps (export),
            a layout to look at it in Foxglove (layout)

gpmpc COMMAND --help lists a command's settings, --cfg job prints them resolved.
eval "$(gpmpc -sc install=bash)" completes commands and settings at TAB; zsh takes the same, fish has its own.
"""


def main() -> None:
    """Runs the subcommand that the command line names."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # let Hydra raise, so that the message can be ours
    arguments = sys.argv[1:]
    if arguments and arguments[0] in HELP:
        arguments = [arguments[1], "--help"] if len(arguments) > 1 else []
    if not arguments:
        print(USAGE)
        return
    command = arguments[0]
    if {"-V", "--version"} & {command, *arguments[1:]}:
        print(gpmpc.__version__)
        return
    if {"-sc", "--shell-completion"} & set(arguments):
        _guarded("run", complete, arguments, {name: config_name for name, (_, config_name) in COMMANDS.items()}, PLAIN)
        return
    if command in PLAIN:
        _guarded("", PLAIN[command], arguments[1:])
        return
    if command not in COMMANDS:
        known = [*COMMANDS, *PLAIN]
        _fail(f"unknown command {command!r}{_nearest(command, known)}; gpmpc --help lists the commands")
    task, config_name = COMMANDS[command]
    given = _guarded("", _options, command, arguments[1:])
    _guarded(config_name, find_modules_here)
    sys.argv = [f"gpmpc {command}", *arguments[1:]]
    # Guarded inside as well, where Hydra would add a line of its own to a task's error.
    entry = hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=config_name)(
        partial(_guarded, config_name, task)
    )
    swept = given.multirun and not (given.help or given.hydra_help or given.cfg or given.info)
    if swept:
        from gpmpc.cli.sweep import sweep

        entry = partial(sweep, given, config_folder())
    try:
        _guarded(config_name, entry)
    except KeyboardInterrupt:
        resumed = swept or command != "run"
        raise KeyboardInterrupt(*["the same command goes on where it stopped"] * resumed) from None


def _options(command: str, arguments: list[str]) -> argparse.Namespace:
    """Parses Hydra's options; one that does not exist is one line, where Hydra would print all that do."""
    parser = Parser(prog=f"gpmpc {command}", add_help=False)
    for names, settings in OPTIONS.items():
        parser.add_argument(*names.split(), **({} if settings else {"action": "store_true"}), **settings)
    parser.add_argument("overrides", nargs="*")
    given, unknown = parser.parse_known_args(arguments)
    if unknown:
        near = _nearest(unknown[0], [name for names in OPTIONS for name in names.split()])
        raise GpmpcError(f"unknown option {unknown[0]!r}{near}; gpmpc {command} --help lists the settings")
    if given.multirun and command != "run":
        raise GpmpcError("-m: only gpmpc run sweeps")
    return given


def _guarded(config_name: str, function: Callable, *arguments: Any) -> Any:
    """Calls a function; a user's mistake ends with one line, or with its traceback where that is asked for."""
    try:
        return function(*arguments)
    except (GpmpcError, HydraException, OmegaConfBaseException) as error:
        if SHOW_TRACEBACK:
            raise
        _fail(_one_line(error, config_name))
    except OSError as error:
        if SHOW_TRACEBACK:
            raise
        _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except (TypeError, ValueError, ArithmeticError) as error:  # a value that no check foresaw
        if SHOW_TRACEBACK or not config_name:
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        _fail(f"{reason}; is a setting of the wrong kind? HYDRA_FULL_ERROR=1 shows where")


def _fail(message: str) -> NoReturn:
    print_error(message)
    sys.exit(2)


def _one_line(error: Exception, config_name: str) -> str:
    """The user's mistake in one line: which setting, what was got, what was expected."""
    if own_error(error):
        return one_line(error)
    text = str(error)
    unknown = re.match(r"Could not override '([^']+)'", text)
    if unknown:
        return f"unknown setting {unknown[1]!r}{_nearest(unknown[1], settings_of(config_name))}"
    option = re.search(r"Could not find '([^'/]+)/([^']+)'\s+Available options in '[^']+':\n((?:\t.*\n)+)", text)
    if option and option[2].removeprefix("launcher/") in EXTRAS:
        extra = EXTRAS[option[2].removeprefix("launcher/")]
        return f"launcher: this one is not installed: pip install 'gpmpc[{extra}]'"
    if option:
        known = option[3].split()
        return (
            f"{option[1]}: no such option {option[2]!r}; available are {', '.join(known)}{_nearest(option[2], known)}"
        )
    if isinstance(error, OverrideParseException):
        if "=" not in error.override:
            return f"{error.override!r}: a setting is written SETTING=VALUE"
        quoted = "in single quotes where the value holds brackets, braces, commas or spaces"
        return f"{error.override!r}: cannot be read; a setting is written SETTING=VALUE, {quoted}"
    unlocated = re.match(r"Error locating target '([^']+)'", text)
    if unlocated:
        return f"_target_: no such class or function {unlocated[1]!r}"
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key}: this setting has no default; give it as {error.full_key}=VALUE"
    ambiguous = re.match(r"Ambiguous value for argument '([^=]+)=([^']+)'", text)
    if ambiguous:
        listed = f"{ambiguous[1]}: a list is written in brackets, {ambiguous[1]}=[{ambiguous[2]}]"
        return f"{listed}; a sweep takes -m" if config_name == "run" else listed
    lines = [line.strip() for line in text.splitlines() if line.strip() and "hydra.cc" not in line]
    return "; ".join(line.rstrip(".:;") for line in lines) or type(error).__name__


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


COMMANDS: dict[str, tuple[Callable[[DictConfig], None], str]] = {
    "run": (run, "run"),
    "tables": (tables, "tables"),
    "figures": (figures, "figures"),
    "quality": (quality, "quality"),
}
PLAIN: dict[str, Callable[[list[str]], None]] = {"log": log, "plot": plot, "report": report}
