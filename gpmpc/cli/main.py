"""Problem: one command with a handful of subcommands, settings composed by Hydra, and mistakes answered in one line.

A user's mistake (an unknown setting, a missing file, a value out of range) ends with exit code 2 and one line on the
standard error; ``HYDRA_FULL_ERROR=1`` shows where it came from. Heavy libraries are imported inside the task, so help
and completion stay quick.
"""

import difflib
import os
import re
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

import gpmpc
from gpmpc.cli.figures import figures
from gpmpc.cli.log import log
from gpmpc.cli.tables import tables
from gpmpc.exceptions import GpmpcError

USAGE = f"""gpmpc {gpmpc.__version__}: Gaussian process model predictive control

usage: gpmpc COMMAND [SETTING=VALUE ...]
       gpmpc log info|recover|export FILE [OUTPUT]

commands:
  tables    Tables 1 and 2 of Cao, Lai and Alam (2017), computed beside the printed figures
  figures   Figures 2 to 4 and section 5.2: the flights, in the paper's reading and with the plant in the loop
  log       What is in a recording (info), rescue an unfinished one (recover), a table of its steps (export)

gpmpc COMMAND --help lists a command's settings, --cfg job prints them resolved.
"""


def main() -> None:
    """Runs the subcommand that the command line names."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(USAGE)
        return
    if arguments[0] in ("-V", "--version"):
        print(gpmpc.__version__)
        return
    command = arguments[0]
    if command in PLAIN:
        _run_plain(PLAIN[command], arguments[1:])
        return
    if command not in COMMANDS:
        known = [*COMMANDS, *PLAIN]
        _fail(f"unknown command {command!r}{_nearest(command, known)}; gpmpc --help lists the commands")
    task, config_name = COMMANDS[command]
    sys.argv = [f"gpmpc {command}", *arguments[1:]]
    _run(task, config_name)


def config_folder() -> Path:
    """The configuration: beside the package's modules in a wheel, beside the package in a checkout."""
    package = Path(gpmpc.__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def _run(task: Callable[[DictConfig], None], config_name: str) -> None:
    show_traceback = bool(os.environ.get("HYDRA_FULL_ERROR"))
    os.environ["HYDRA_FULL_ERROR"] = "1"  # let Hydra raise, so that the message can be ours

    def guarded(function: Callable, *arguments: DictConfig) -> None:
        try:
            function(*arguments)
        except (GpmpcError, HydraException, OmegaConfBaseException) as error:
            if show_traceback:
                raise
            _fail(_one_line(error, config_name))
        except (TypeError, ValueError, ArithmeticError) as error:  # a value that no check foresaw
            if show_traceback:
                raise
            reason = " ".join(str(error).split()) or type(error).__name__
            _fail(f"{reason}; is a setting of the wrong kind? HYDRA_FULL_ERROR=1 shows where")

    # Twice: around composing the settings, and inside, where Hydra would add a line of its own to a task's error.
    entry = hydra.main(version_base="1.3", config_path=str(config_folder()), config_name=config_name)
    try:
        guarded(entry(partial(guarded, task)))
    except BrokenPipeError:
        _end_of_pipe()
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on where it stopped", file=sys.stderr)
        sys.exit(130)


def _run_plain(task: Callable[[list[str]], None], arguments: list[str]) -> None:
    """Runs a command that works on files and has no settings to compose."""
    try:
        task(arguments)
    except GpmpcError as error:
        if os.environ.get("HYDRA_FULL_ERROR"):
            raise
        _fail(" ".join(str(error).split()))
    except BrokenPipeError:
        _end_of_pipe()


def _end_of_pipe() -> None:
    """The reader of a pipe, such as head, has seen enough."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(1)


def _fail(message: str) -> None:
    print(f"gpmpc: {message}", file=sys.stderr)
    sys.exit(2)


def _one_line(error: Exception, config_name: str) -> str:
    """The user's mistake in one line: which setting, what was got, what was expected."""
    ours: BaseException | None = error
    while ours is not None and not isinstance(ours, GpmpcError):
        ours = ours.__cause__
    if ours is not None:
        return " ".join(str(ours).split())
    text = str(error)
    unknown = re.match(r"Could not override '([^']+)'", text)
    if unknown:
        return f"unknown setting {unknown[1]!r}{_nearest(unknown[1], _settings(config_name))}"
    option = re.search(r"Could not find '([^'/]+)/([^']+)'\s+Available options in '[^']+':\n((?:\t.*\n)+)", text)
    if option:
        return f"{option[1]}: no such option {option[2]!r}; available are {', '.join(option[3].split())}"
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key}: this setting has no default; give it as {error.full_key}=VALUE"
    ambiguous = re.match(r"Ambiguous value for argument '([^=]+)=([^']+)'", text)
    if ambiguous:
        return f"{ambiguous[1]}: a list is written in brackets, {ambiguous[1]}=[{ambiguous[2]}]"
    lines = [line.strip() for line in text.splitlines() if line.strip() and "hydra.cc" not in line]
    return "; ".join(line.rstrip(":;") for line in lines) or type(error).__name__


def _settings(config_name: str) -> list[str]:
    """Every setting of a command, dotted."""
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(config_folder())):
        config = hydra.compose(config_name)

    def keys(node: DictConfig, prefix: str = "") -> list[str]:
        found = []
        for key in node:
            found.append(prefix + str(key))
            if (
                OmegaConf.is_dict(node)
                and not OmegaConf.is_missing(node, key)
                and OmegaConf.is_dict(node._get_node(key))
            ):
                found += keys(node[key], f"{prefix}{key}.")
        return found

    return keys(config)


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


COMMANDS: dict[str, tuple[Callable[[DictConfig], None], str]] = {
    "tables": (tables, "tables"),
    "figures": (figures, "figures"),
}
PLAIN: dict[str, Callable[[list[str]], None]] = {"log": log}
