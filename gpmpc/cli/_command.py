"""The commands: what each is for, its arguments and its function; a user's mistake is one line and exit code 2."""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from omegaconf import OmegaConf

import gpmpc
from gpmpc.cli._settings import (
    compose,
    explain,
    find_modules_here,
    help_text,
    model_file,
    nearest,
    settings,
)
from gpmpc.cli._terminal import print_error, redirected_output
from gpmpc.exceptions import GpmpcError
from gpmpc.parallel import THREADS

FLAGS = ("--json", "--quiet", "--debug")
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


class Result(NamedTuple):
    """What a command returns."""

    data: Any = None  # plain data, which ``--json`` prints
    code: int = 0  # the exit code


class _Parser(argparse.ArgumentParser):
    """A parser that raises an error of this package instead of printing the usage and exiting."""

    def error(self, message: str) -> NoReturn:
        raise GpmpcError(f"{message}; {self.prog} --help shows how")


class Command(NamedTuple):
    """One command."""

    summary: str  # for the list of all
    #: of ``gpmpc.cli``; its function of the command's name takes the composed settings or parsed arguments. Imported
    #: when it runs, and with it the heavy libraries, so help and completion stay quick
    module: str
    arguments: Sequence[
        tuple[tuple[str, ...], dict[str, Any]]
    ] = ()  # what ``add_argument`` takes
    settings: bool = False  # whether it has a file in ``conf/``

    def parser(self, name: str) -> argparse.ArgumentParser:
        """Returns the parser of what follows the command's name."""
        description = f"gpmpc {name}: {self.summary[0].lower()}{self.summary[1:]}."
        parser = _Parser(
            prog=f"gpmpc {name}", description=description, add_help=not self.settings
        )
        for names, how in self.arguments:
            parser.add_argument(*names, **how)
        return parser

    @property
    def values(self) -> dict[str, list[str] | None]:
        """The choices of every option and argument by name: empty for any value, None for a flag."""
        found: dict[str, list[str] | None] = {"-h": None, "--help": None}
        for names, how in self.arguments:
            found |= dict.fromkeys(
                names,
                None
                if how.get("action") == "store_true"
                else [*how.get("choices", ())],
            )
        return found


def call(module: str, function: str, given: Any) -> Result:
    """Calls a function of a module of ``gpmpc.cli``."""
    return getattr(import_module(f"gpmpc.cli.{module}"), function)(given)


def version(given: argparse.Namespace) -> Result:
    """Prints what a report of a bug needs: versions, the BLAS library, the processor."""
    from gpmpc._provenance import environment

    data = environment()
    print("\n".join(f"{name:10}{value}" for name, value in data.items()))
    return Result(data)


def help(given: argparse.Namespace) -> Result:
    """Lists the commands."""
    lines = "\n".join(
        f"  {name:12}{command.summary}" for name, command in COMMANDS.items()
    )
    print(_USAGE.format(version=gpmpc.__version__, commands=lines), end="")
    return Result()


def main() -> None:
    """Runs the command line."""
    flags = {*FLAGS} & {*sys.argv[1:]}
    arguments = [each for each in sys.argv[1:] if each not in FLAGS]
    with redirected_output(
        "error" if "--json" in flags else "nowhere" if "--quiet" in flags else "output"
    ):
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
        given, unknown = command.parser(name).parse_known_intermixed_args(rest)
        if unknown:
            hint = f"{nearest(unknown[0], command.values)}; gpmpc {name} --help lists what there is"
            raise GpmpcError(f"unknown option {unknown[0]!r}{hint}")
        return (
            _with_settings(name, command, given)
            if command.settings
            else call(command.module, name, given)
        )
    except KeyboardInterrupt:
        resumed = (
            command is not None
            and command.settings
            and (name != "run" or {"-m", "--multirun"} & {*rest})
        )
        raise KeyboardInterrupt(
            *["the same command goes on where it stopped"] * bool(resumed)
        ) from None
    except Exception as error:
        message = (
            None
            if debug
            else explain(error, name if command and command.settings else "")
        )
        if message is None:
            raise
        print_error(message)
        sys.exit(2)


def _with_settings(name: str, command: Command, given: argparse.Namespace) -> Result:
    """Composes the settings, and shows them or runs the command with them."""
    given.config_name, swept = (
        given.config_name or name,
        name == "tune" or getattr(given, "multirun", False),
    )
    given.overrides = [
        choice for word in given.overrides for choice in model_file(word)
    ]
    with settings(given.config_dir):
        if given.help:
            print(help_text(name))
            return Result()
        if not given.cfg:
            find_modules_here()
        if swept and given.cfg:
            raise GpmpcError(
                "--cfg: shows the settings of one run; leave out -m, and give each setting one value"
            )
        if (
            swept
        ):  # before the libraries load, here and in the processes started from here
            os.environ |= dict.fromkeys(THREADS, "1")
            return (
                call(command.module, name, given)
                if name == "tune"
                else call("_sweep", "sweep", given)
            )
        config = compose(given.config_name, given.overrides)
        if given.cfg:
            print(OmegaConf.to_yaml(config), end="")
            return Result(OmegaConf.to_container(config))
        return call(command.module, name, config)


def _argument(*names: str, **settings: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Returns what ``add_argument`` takes."""
    return names, settings


def _folder(where: str) -> tuple[tuple[str, ...], dict[str, Any]]:
    return _argument("--to", type=Path, metavar="DIR", help=where)


_FLAG: dict[str, Any] = {"action": "store_true"}
_OF_SETTINGS = [_argument("-h", "--help", **_FLAG), _argument("--cfg", **_FLAG)]
_OF_SETTINGS += [
    _argument("--config-name"),
    _argument("--config-dir"),
    _argument("overrides", nargs="*"),
]
_RECORDED = "a run's folder, one with runs below it, or a recording (.mcap)"
_LOG = (
    "info: channels, times, how the solves ended; recover: what is whole in an unfinished file, as a new one; "
    "export: the steps as a table, a row each; layout: for Foxglove or Lichtblick, fitting the recording; "
    "inspect: rates, gaps, repeated values, noise, delays and excitation of any log, on one page"
)
_OUTPUT = "where it goes; FILE with .recovered.mcap, .csv (or .parquet), .layout.json, .inspection.html"
_FOR_CONTROL = "a model to plan with: without the feedback of the controller that flew, without delayed inputs"
_SHELL = 'for its profile: eval "$(gpmpc completion bash)"'
_GROUPS = "choices that make two groups, such as controller=lqr controller=convex: a paired test over the seeds"
_TUNE = [
    _argument(name, type=int, default=n)
    for name, n in (("--trials", 40), ("--batch", 4), ("--seeds", 1))
]
_TUNE += _OF_SETTINGS
_NEW = [
    _argument(
        "name",
        metavar="NAME",
        help="of the system: letters, digits and _, a letter first",
    ),
    _folder("an empty folder, or one to be made (NAME)"),
]
_REPORT = [
    _argument(
        "tree",
        type=Path,
        metavar="OUTPUTS",
        help="a folder with runs anywhere below it",
    ),
    _folder("where the documents go (OUTPUTS/report)"),
    _argument("--compare", nargs=2, metavar=("A", "B"), help=_GROUPS),
]
_TRUST = _argument(
    "--trust",
    action="append",
    default=[],
    metavar="PACKAGE",
    help="a package of yours whose code the recording's settings may call; repeatable",
)
_PLOT = [
    _argument("run", type=Path, metavar="RUN", help=_RECORDED),
    _folder("where the figures go (RUN/figures)"),
    _argument(
        "--format",
        choices=("png", "pdf", "svg"),
        default="png",
        help="of the figures (png)",
    ),
    _argument("--no-animation", **_FLAG, help="figures only: they take a second"),
    _argument(
        "--film", **_FLAG, help="a system of MuJoCo: the animation as MuJoCo renders it"
    ),
    _TRUST,
]
_CALIBRATE = [
    _argument(
        "run",
        type=Path,
        metavar="RUN",
        help="a run's folder or recording; its model is learned again",
    ),
    _argument(
        "flights",
        type=Path,
        nargs="*",
        metavar="FLIGHT",
        help=f"what is predicted (RUN): {_RECORDED}",
    ),
    _argument(
        "--steps", type=int, default=50, help="length of the longest prediction (50)"
    ),
    _folder("where all goes (RUN/calibration)"),
    _TRUST,
]
_LEARN = [
    _argument("mapping", type=Path, help="a YAML file that says what the columns mean"),
    _argument(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="logs: CSV, Parquet, npz, MCAP, ULog",
    ),
    _argument(
        "--held-out",
        nargs="+",
        metavar="RUN",
        default=[],
        help="runs to judge it on (a fifth of all)",
    ),
    _folder("folder for the model, its report and its card (learned)"),
    _argument(
        "--points", type=int, default=300, help="training rows of a GP, at most (300)"
    ),
    _argument(
        "--steps", type=int, default=50, help="longest prediction it is judged by (50)"
    ),
    _argument("--seed", type=int, default=0, help="seed of all random choices (0)"),
    _argument("--for-control", **_FLAG, help=_FOR_CONTROL),
    _argument(
        "--partial", **_FLAG, help="read unfinished files as far as they are whole"
    ),
]
_LOGGED = [
    _argument(
        "action", choices=["info", "recover", "export", "layout", "inspect"], help=_LOG
    ),
    _argument(
        "file", type=Path, help="an MCAP file, finished or not; inspect: any log"
    ),
    _argument("output", type=Path, nargs="?", help=_OUTPUT),
    _argument(
        "--mapping",
        type=Path,
        help="inspect: a YAML file that says what the columns mean",
    ),
]
_COMPLETION = [
    _argument("shell", nargs="?", choices=["bash", "zsh", "fish"], help=_SHELL),
    _argument(
        "--line",
        metavar="LINE",
        help="print what may come next after this beginning of a line",
    ),
]
_RUN = [_argument("--multirun", "-m", **_FLAG), *_OF_SETTINGS]
_HELP = [_argument("name", metavar="COMMAND", nargs="?")]
COMMANDS = {
    "run": Command(
        "Trains a model, flies with it, records; with -m a sweep of many flights",
        "_run",
        _RUN,
        True,
    ),
    "tune": Command(
        "Searches settings for the least closed-loop cost", "_tune", _TUNE, True
    ),
    "tables": Command(
        "Computes Tables 1 and 2 of Cao, Lai and Alam (2017)",
        "_study",
        _OF_SETTINGS,
        True,
    ),
    "figures": Command(
        "Flies figures 2 to 4 and section 5.2, also with the plant in the loop",
        "_study",
        _OF_SETTINGS,
        True,
    ),
    "quality": Command(
        "Measures closed-loop cost over the time of a decision",
        "_study",
        _OF_SETTINGS,
        True,
    ),
    "new": Command(
        "Writes a project of your own: a system, its settings, a script and a test",
        "_new",
        _NEW,
    ),
    "report": Command(
        "Tabulates all runs below a folder; compares two groups of them",
        "_flights",
        _REPORT,
    ),
    "plot": Command(
        "Draws recorded flights as figures and an animation", "_flights", _PLOT
    ),
    "calibrate": Command(
        "Predicts recorded flights with a run's model, and judges it",
        "_flights",
        _CALIBRATE,
    ),
    "learn": Command(
        "Learns a model from logs and judges it on held-out runs", "_learn", _LEARN
    ),
    "log": Command(
        "Shows, rescues or exports a recording, writes its layout, inspects logs",
        "_log",
        _LOGGED,
    ),
    "warmup": Command(
        "Compiles the numerical kernels now, instead of at the first flight", "_study"
    ),
    "completion": Command(
        "Prints a script that completes a line at TAB", "_completion", _COMPLETION
    ),
    "version": Command(
        "Prints the versions of what computes, and the processor", "_command"
    ),
    "help": Command("Explains a command", "_command", _HELP),
}
