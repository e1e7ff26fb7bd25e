"""The commands: what each is for, its settings in ``conf/``, its arguments, and the function that does it."""

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from gpmpc.exceptions import GpmpcError


class Result(NamedTuple):
    """What a command returns."""

    data: Any = None  # plain data, which ``--json`` prints
    code: int = 0  # the exit code


class Parser(argparse.ArgumentParser):
    """A parser that raises an error of this package instead of printing the usage and exiting."""

    def __init__(self, *arguments: Any, **settings: Any):
        self.values: dict[str, list[str] | None] = {}  # by option or name: choices, empty for any; None for a flag
        super().__init__(*arguments, **settings)

    def add_argument(self, *names: Any, **settings: Any) -> Any:
        flag = settings.get("action") in ("store_true", "help")
        self.values |= dict.fromkeys(names, None if flag else [*settings.get("choices", ())])
        return super().add_argument(*names, **settings)

    def error(self, message: str) -> NoReturn:
        raise GpmpcError(f"{message}; {self.prog} --help shows how")


_Argument = tuple[tuple[str, ...], dict[str, Any]]


def _argument(*names: str, **settings: Any) -> _Argument:
    """Returns what ``add_argument`` takes."""
    return names, settings


_FLAG: dict[str, Any] = {"action": "store_true"}
_FOLDER: dict[str, Any] = {"type": Path, "metavar": "DIR"}
_OF_SETTINGS = [_argument("-h", "--help", **_FLAG), _argument("--cfg", **_FLAG)]
_OF_SETTINGS += [_argument("--config-name"), _argument("--config-dir"), _argument("overrides", nargs="*")]


class Command(NamedTuple):
    """One command."""

    summary: str  # for the list of all
    #: module of ``gpmpc.cli`` and function in it, from the composed settings or the parsed arguments to a ``Result``;
    #: imported when it runs, and with it the heavy libraries, so help and completion stay quick
    task: str
    settings: str = ""  # name of its file in ``conf/``; empty where it has arguments only
    arguments: Sequence[_Argument] = ()

    def parser(self, name: str) -> Parser:
        """Returns the parser of what follows the command's name."""
        description = f"gpmpc {name}: {self.summary[0].lower()}{self.summary[1:]}."
        parser = Parser(prog=f"gpmpc {name}", description=description, add_help=not self.settings)
        for names, settings in (*self.arguments, *(_OF_SETTINGS if self.settings else ())):
            parser.add_argument(*names, **settings)
        return parser


def call(task: str, given: Any) -> Result:
    """Calls a command's task."""
    module, function = task.split(".")
    return getattr(import_module(f"gpmpc.cli.{module}"), function)(given)


_RUN = "a run's folder, one with runs below it, or a recording (.mcap)"
_LOG = (
    "info: channels, times, how the solves ended; recover: what is whole in an unfinished file, as a new one; "
    "export: the steps as a table, a row each; layout: for Foxglove or Lichtblick, fitting the recording; "
    "inspect: rates, gaps, repeated values, noise, delays and excitation of any log, on one page"
)
_OUTPUT = "where it goes; FILE with .recovered.mcap, .csv (or .parquet), .layout.json, .inspection.html"
_FOR_CONTROL = "a model to plan with: without the feedback of the controller that flew, without delayed inputs"
_SHELL = 'for its profile: eval "$(gpmpc completion bash)"'
_GROUPS = "choices that make two groups, such as controller=lqr controller=convex: a paired test over the seeds"
COMMANDS = {
    "run": Command(
        "Trains a model, flies with it, records; with -m a sweep of many flights",
        "_run.run",
        "run",
        [_argument("--multirun", "-m", **_FLAG)],
    ),
    "tune": Command(
        "Searches settings for the least closed-loop cost",
        "_tune.tune",
        "tune",  # where it is said what these mean
        [_argument(name, type=int, default=n) for name, n in (("--trials", 40), ("--batch", 4), ("--seeds", 1))],
    ),
    "tables": Command(
        "Computes Tables 1 and 2 of Cao, Lai and Alam (2017) beside the printed ones", "_study.study", "tables"
    ),
    "figures": Command(
        "Flies figures 2 to 4 and section 5.2, and the same with the plant in the loop", "_study.study", "figures"
    ),
    "quality": Command(
        "Measures closed-loop cost over the time of a decision, for every controller", "_study.study", "quality"
    ),
    "new": Command(
        "Writes a project of your own: a system, its settings, a script and a test",
        "_new.new",
        arguments=[
            _argument("name", metavar="NAME", help="of the system: letters, digits and _, a letter first"),
            _argument("--to", **_FOLDER, help="an empty folder, or one to be made (NAME)"),
        ],
    ),
    "report": Command(
        "Tabulates all runs below a folder, with figures; compares two groups of them",
        "_report.report",
        arguments=[
            _argument("tree", type=Path, metavar="OUTPUTS", help="a folder with runs anywhere below it"),
            _argument("--to", **_FOLDER, help="where the documents go (OUTPUTS/report)"),
            _argument("--compare", nargs=2, metavar=("A", "B"), help=_GROUPS),
        ],
    ),
    "plot": Command(
        "Draws recorded flights as figures and an animation",
        "_flights.plot",
        arguments=[
            _argument("run", type=Path, metavar="RUN", help=_RUN),
            _argument("--to", **_FOLDER, help="where the figures go (RUN/figures)"),
            _argument("--format", choices=("png", "pdf", "svg"), default="png", help="of the figures (png)"),
            _argument("--no-animation", **_FLAG, help="figures only: they take a second"),
            _argument("--film", **_FLAG, help="a system of MuJoCo: the animation as MuJoCo renders it"),
        ],
    ),
    "calibrate": Command(
        "Predicts recorded flights with a run's model: its errors, and whether its intervals hold",
        "_calibrate.calibrate",
        arguments=[
            _argument("run", type=Path, metavar="RUN", help="a run's folder or recording; its model is learned again"),
            _argument("flights", type=Path, nargs="*", metavar="FLIGHT", help=f"what is predicted (RUN): {_RUN}"),
            _argument("--steps", type=int, default=50, help="length of the longest prediction (50)"),
            _argument("--to", **_FOLDER, help="where all goes (RUN/calibration)"),
        ],
    ),
    "learn": Command(
        "Learns a model from logs, judges it on held-out runs, and writes it with a report and a card",
        "_learn.learn",
        arguments=[
            _argument("mapping", type=Path, help="a YAML file that says what the columns mean"),
            _argument("files", type=Path, nargs="+", metavar="FILE", help="logs: CSV, Parquet, npz, MCAP, ULog"),
            _argument("--held-out", nargs="+", metavar="RUN", default=[], help="runs to judge it on (a fifth of all)"),
            _argument(
                "--to",
                **_FOLDER,
                default=Path("learned"),
                help="folder for the model, its report and its card (learned)",
            ),
            _argument("--points", type=int, default=300, help="training rows of a GP, at most (300)"),
            _argument("--steps", type=int, default=50, help="longest prediction it is judged by (50)"),
            _argument("--seed", type=int, default=0, help="seed of all random choices (0)"),
            _argument("--for-control", **_FLAG, help=_FOR_CONTROL),
            _argument("--partial", **_FLAG, help="read unfinished files as far as they are whole"),
        ],
    ),
    "log": Command(
        "Shows, rescues or exports a recording, writes its Foxglove layout, inspects logs",
        "_log.log",
        arguments=[
            _argument("action", choices=["info", "recover", "export", "layout", "inspect"], help=_LOG),
            _argument("file", type=Path, help="an MCAP file, finished or not; inspect: any log"),
            _argument("output", type=Path, nargs="?", help=_OUTPUT),
            _argument("--mapping", type=Path, help="inspect: a YAML file that says what the columns mean"),
        ],
    ),
    "warmup": Command("Compiles the numerical kernels now, instead of at the first flight", "_study.warmup"),
    "completion": Command(
        "Prints a script that completes commands, settings and files at TAB",
        "_completion.completion",
        arguments=[
            _argument("shell", nargs="?", choices=["bash", "zsh", "fish"], help=_SHELL),
            _argument("--line", metavar="LINE", help="print what may come next after this beginning of a line"),
        ],
    ),
    "version": Command("Prints the versions of what computes, and the processor", "_command.version"),
    "help": Command(
        "Explains a command", "_command.show_usage", arguments=[_argument("name", metavar="COMMAND", nargs="?")]
    ),
}
