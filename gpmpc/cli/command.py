"""The commands, and what is common to all: options, help, and one line with exit code 2 for a user's mistake.

Heavy libraries are imported inside the tasks, so help and completion stay quick.
"""

import argparse
import sys
from collections.abc import Callable
from typing import Any, NamedTuple, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

import gpmpc
from gpmpc.cli import completion, learn, log, new, reports, study, tune, warmup
from gpmpc.cli.arguments import Parser, Result
from gpmpc.cli.configuration import compose, help_text, model_file, settings
from gpmpc.cli.mistakes import explain, nearest
from gpmpc.cli.run import run
from gpmpc.cli.sweep import sweep
from gpmpc.cli.terminal import print_error, redirected_output
from gpmpc.exceptions import GpmpcError


class Command(NamedTuple):
    """One command.

    Attributes:
        summary: For the list of all.
        task: From the composed settings, or from the parsed arguments, to the result.
        settings: Name of its file in ``conf/``; empty where it has arguments only.
        add_arguments: To its parser.
    """

    summary: str
    task: Callable[[Any], Result]
    settings: str = ""
    add_arguments: Callable[[Parser], None] = lambda parser: None

    def parser(self, name: str) -> Parser:
        """Returns the parser of what follows the command's name."""
        description = f"gpmpc {name}: {self.summary[0].lower()}{self.summary[1:]}."
        parser = Parser(prog=f"gpmpc {name}", description=description, add_help=not self.settings)
        self.add_arguments(parser)
        if self.settings:
            for names in (("-h", "--help"), ("--resolve",)):
                parser.add_argument(*names, action="store_true")
            parser.add_argument("--cfg", "-c", nargs="?", const="job")
            parser.values["--cfg"] = [*SHOWN]
            for names in (("--config-name", "-cn"), ("--config-dir", "-cd")):
                parser.add_argument(*names)
            parser.add_argument("overrides", nargs="*")
        return parser


def version(given: argparse.Namespace) -> Result:
    """Prints what a report of a bug needs: versions, the BLAS library, the processor."""
    from gpmpc.provenance import environment

    data = environment()
    print("\n".join(f"{name:10}{value}" for name, value in data.items()))
    return Result(data)


def _show_usage(given: argparse.Namespace) -> Result:
    lines = "\n".join(f"  {name:12}{command.summary}" for name, command in COMMANDS.items())
    print(USAGE.format(version=gpmpc.__version__, commands=lines), end="")
    return Result()


def _add_multirun(parser: Parser) -> None:
    parser.add_argument("--multirun", "-m", action="store_true")


COMMANDS = {
    "run": Command(
        "Trains a model, flies with it, records; with -m a sweep of many flights", run, "run", _add_multirun
    ),
    "tune": Command(
        "Searches settings for the least closed-loop cost", lambda given: Result(), "tune", tune.add_arguments
    ),
    "tables": Command(
        "Computes Tables 1 and 2 of Cao, Lai and Alam (2017) beside the printed ones", study.run, "tables"
    ),
    "figures": Command(
        "Flies figures 2 to 4 and section 5.2, and the same with the plant in the loop", study.run, "figures"
    ),
    "quality": Command(
        "Measures closed-loop cost over the time of a decision, for every controller", study.run, "quality"
    ),
    "new": Command(
        "Writes a project of your own: a system, its settings, a script and a test",
        new.new,
        add_arguments=new.add_arguments,
    ),
    "report": Command(
        "Puts a tree of runs into one table with figures; compares two groups",
        reports.report,
        add_arguments=reports.add_report_arguments,
    ),
    "plot": Command(
        "Draws a recorded flight as figures and an animation", reports.plot, add_arguments=reports.add_plot_arguments
    ),
    "learn": Command(
        "Learns a model from logs, judges it on held-out runs, and writes it with a report and a card",
        learn.learn,
        add_arguments=learn.add_arguments,
    ),
    "log": Command(
        "Shows, rescues or exports a recording, or writes a Foxglove layout for it",
        log.log,
        add_arguments=log.add_arguments,
    ),
    "warmup": Command("Compiles the numerical kernels now, instead of at the first flight", warmup.warmup),
    "completion": Command(
        "Prints a script that completes commands, settings and files at TAB",
        lambda given: completion.completion(given, COMMANDS),
        add_arguments=completion.add_arguments,
    ),
    "version": Command("Prints the versions of what computes, and the processor", version),
    "help": Command("Explains a command", _show_usage),
}
SHOWN = ("job", "hydra", "all")  # parts of the settings
FLAGS = ("--json", "--quiet", "--debug")
USAGE = """gpmpc {version}: Gaussian process model predictive control

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
    """Runs the command that the command line names."""
    flags = {flag for flag in FLAGS if flag in sys.argv[1:]}
    arguments = [argument for argument in sys.argv[1:] if argument not in flags]
    with redirected_output("error" if "--json" in flags else "nowhere" if "--quiet" in flags else "output"):
        result = _run(arguments, debug="--debug" in flags)
    if "--json" in flags:
        from gpmpc.studies.document import json_text

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
            print(help_text(command.settings, []))
            return Result()
        if given.cfg not in (None, *SHOWN):  # a setting behind --cfg
            given.overrides, given.cfg = [given.cfg, *given.overrides], "job"
        if swept and given.cfg:
            raise GpmpcError("--cfg: shows the settings of one run; leave out -m, and give each setting one value")
        if swept:
            return tune.tune(given, config_name) if name == "tune" else sweep(given, config_name)
        config = compose(config_name, given.overrides)
        if given.cfg:
            parts = [config] * (given.cfg != "hydra") + [cast(Any, HydraConfig.instance().cfg)] * (given.cfg != "job")
            shown = OmegaConf.create({key: part for each in parts for key, part in each.items()})
            print(OmegaConf.to_yaml(shown, resolve=given.resolve), end="")
            return Result(OmegaConf.to_container(shown, resolve=given.resolve))
        return command.task(config)
