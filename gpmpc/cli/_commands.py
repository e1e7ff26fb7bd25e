"""Lists the commands: what each is for, its arguments, and the module that runs it.

To add a command NAME, add an entry to ``COMMANDS`` and a module ``_NAME.py`` with a
function ``NAME``. It takes the parsed arguments, or the composed settings of
``conf/NAME.yaml`` where it has some, and returns a ``Result``.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from gpmpc.exceptions import GpmpcError

#: options that every command takes
FLAGS = ("--json", "--quiet", "--debug")


class Result(NamedTuple):
    """What a command returns."""

    #: plain data, which ``--json`` prints
    data: Any = None
    #: the exit code
    code: int = 0


@dataclass(frozen=True)
class Argument:
    """An argument or an option of a command, as ``add_argument`` takes it."""

    names: tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)


class Parser(argparse.ArgumentParser):
    """A parser that raises an error of this package instead of exiting."""

    def error(self, message: str) -> NoReturn:
        raise GpmpcError(f"{message}; {self.prog} --help shows how")


@dataclass(frozen=True)
class Subcommand:
    """One command of ``gpmpc``."""

    #: for the list of all
    summary: str
    #: module of ``gpmpc.cli`` with the function of the command's name. It is imported
    #: when the command runs, and with it the heavy libraries: help and completion stay
    #: quick
    module: str
    arguments: Sequence[Argument] = ()
    #: whether it has a file in ``conf/``, whose settings follow its name
    has_settings: bool = False
    #: whether it takes up its work when it is repeated after an interruption; what
    #: flies many runs does, too
    resumes: bool = False

    def parser(self, name: str) -> Parser:
        """Returns the parser of what follows the command's name."""
        summary = self.summary[0].lower() + self.summary[1:]
        parser = Parser(
            prog=f"gpmpc {name}",
            description=f"gpmpc {name}: {summary}.",
            add_help=not self.has_settings,
        )
        for argument in self.arguments:
            parser.add_argument(*argument.names, **argument.options)
        return parser

    @property
    def values_by_argument(self) -> dict[str, list[str] | None]:
        """Values of every argument and option by name.

        Empty where any value goes, None for a flag, which takes none.
        """
        values_by_name: dict[str, list[str] | None] = {"-h": None, "--help": None}
        for argument in self.arguments:
            values = None
            if argument.options.get("action") != "store_true":
                values = [*argument.options.get("choices", ())]
            values_by_name |= dict.fromkeys(argument.names, values)
        return values_by_name


def _argument(*names: str, **options: Any) -> Argument:
    return Argument(names, options)


def _flag(*names: str, **options: Any) -> Argument:
    return Argument(names, {"action": "store_true", **options})


def _folder(help: str) -> Argument:
    return _argument("--to", type=Path, metavar="DIR", help=help)


# What follows a command with settings is listed by ``gpmpc COMMAND --help`` from conf/.
_SETTINGS = [
    _flag("-h", "--help"),
    _flag("--cfg"),
    _argument("--config-name"),
    _argument("--config-dir"),
    _argument("overrides", nargs="*"),
]
_RECORDED = "a run's folder, one with runs below it, or a recording (.mcap)"
_TRUST = _argument(
    "--trust",
    action="append",
    default=[],
    metavar="PACKAGE",
    help="allow the recording's settings to call code of this package; repeatable",
)

COMMANDS = {
    "run": Subcommand(
        "Trains a model, flies with it, records; -m: a sweep of many flights",
        module="_run",
        arguments=[_flag("--multirun", "-m"), *_SETTINGS],
        has_settings=True,
    ),
    "tune": Subcommand(
        "Searches settings for the least closed-loop cost",
        module="_tune",
        arguments=[
            _argument("--trials", type=int, default=40),
            _argument("--batch", type=int, default=4),
            _argument("--seeds", type=int, default=1),
            *_SETTINGS,
        ],
        has_settings=True,
        resumes=True,
    ),
    "tables": Subcommand(
        "Computes Tables 1 and 2 of Cao, Lai and Alam (2017)",
        module="_study",
        arguments=_SETTINGS,
        has_settings=True,
        resumes=True,
    ),
    "figures": Subcommand(
        "Flies figures 2 to 4 and section 5.2 of that paper; also on the plant",
        module="_study",
        arguments=_SETTINGS,
        has_settings=True,
        resumes=True,
    ),
    "quality": Subcommand(
        "Measures the closed-loop cost and the decision time of all controllers",
        module="_study",
        arguments=_SETTINGS,
        has_settings=True,
        resumes=True,
    ),
    "new": Subcommand(
        "Writes a project of your own: a system, its settings, a script and a test",
        module="_new",
        arguments=[
            _argument(
                "name",
                metavar="NAME",
                help="name of the system: letters, digits and _, a letter first",
            ),
            _folder("folder of the project; new or empty (NAME)"),
        ],
    ),
    "status": Subcommand(
        "Shows the progress of a sweep, and why runs failed",
        module="_status",
        arguments=[
            _argument(
                "tree",
                type=Path,
                metavar="FOLDER",
                help="folder of a sweep, or one with sweeps below it",
            ),
        ],
    ),
    "report": Subcommand(
        "Tabulates all runs below a folder, or compares two groups of them",
        module="_report",
        arguments=[
            _argument(
                "tree",
                type=Path,
                metavar="OUTPUTS",
                help="folder with runs anywhere below it",
            ),
            _folder("folder of the report (OUTPUTS/report)"),
            _argument(
                "--compare",
                nargs=2,
                metavar=("A", "B"),
                help="compare two groups by a paired test over the seeds, such as "
                "controller=lqr controller=convex",
            ),
        ],
    ),
    "plot": Subcommand(
        "Draws recorded flights as figures and an animation",
        module="_plot",
        arguments=[
            _argument("run", type=Path, metavar="RUN", help=_RECORDED),
            _folder("folder of the figures (RUN/figures)"),
            _argument(
                "--format",
                choices=("png", "pdf", "svg"),
                default="png",
                help="format of the figures (png)",
            ),
            _flag("--no-animation", help="draw the figures only, in a second"),
            _flag(
                "--film",
                help="let MuJoCo render the animation; for systems of MuJoCo",
            ),
            _TRUST,
        ],
    ),
    "calibrate": Subcommand(
        "Judges a run's model by its predictions of recorded flights",
        module="_calibrate",
        arguments=[
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
                help=f"flights to predict (RUN): {_RECORDED}",
            ),
            _argument(
                "--steps",
                type=int,
                default=50,
                help="steps of the longest prediction (50)",
            ),
            _folder("folder of the results (RUN/calibration)"),
            _TRUST,
        ],
    ),
    "export": Subcommand(
        "Writes the controller of a recorded run as C",
        module="_export",
        arguments=[
            _argument("language", choices=["c"], help="c: C99, for any compiler"),
            _argument(
                "run",
                type=Path,
                metavar="RUN",
                help="a run's folder or recording; its model is learned again",
            ),
            _folder("folder of the code (RUN/c)"),
            _argument(
                "--precision",
                choices=["double", "float"],
                default="double",
                help="type of all numbers (double)",
            ),
            _argument(
                "--budget",
                metavar="LIMITS",
                help="limits of the code, such as flash=64kB,ram=32kB,instructions=2M; "
                "keeps as many training points as fit, and prints what fewer cost",
            ),
            _argument(
                "--chip",
                choices=["cortex-m4f", "cortex-m7", "host"],
                help="chip that the budget is measured for (cortex-m4f where "
                "arm-none-eabi-gcc is installed, else host)",
            ),
            _argument(
                "--points",
                type=int,
                metavar="N",
                help="number of training points to keep, those that explain most (all)",
            ),
            _argument(
                "--name",
                default="gpmpc",
                help="name of header and source, and prefix of their functions: outer "
                "gives outer_step; two controllers in one program need two (gpmpc)",
            ),
            _TRUST,
        ],
    ),
    "learn": Subcommand(
        "Learns a model from logs and judges it on held-out runs",
        module="_learn",
        resumes=True,
        arguments=[
            _argument(
                "mapping",
                type=Path,
                help="YAML file that says what the columns mean",
            ),
            _argument(
                "files",
                type=Path,
                nargs="+",
                metavar="FILE",
                help="logs: CSV and other text, Parquet, npz, .mat, MCAP, ULog, bags",
            ),
            _argument(
                "--held-out",
                nargs="+",
                metavar="RUN",
                default=[],
                help="runs to judge the model on (a fifth of the runs that are long "
                "enough; of a single run its end)",
            ),
            _folder("folder for the model, its report and its card (learned)"),
            _argument(
                "--points",
                type=int,
                default=300,
                help="most training rows of a GP (300)",
            ),
            _argument(
                "--steps",
                type=int,
                default=50,
                help="steps of the longest prediction that the model is judged by (50)",
            ),
            _argument(
                "--seed", type=int, default=0, help="seed of all random choices (0)"
            ),
            _flag(
                "--for-control",
                help="learn a model to plan with: without the feedback of the "
                "controller that flew, memory of past rows and corrections by them",
            ),
            _flag("--partial", help="read what is whole of unfinished files"),
        ],
    ),
    "log": Subcommand(
        "Shows, recovers or exports a recording, writes its layout, inspects logs",
        module="_log",
        arguments=[
            _argument(
                "action",
                choices=["info", "recover", "export", "layout", "inspect"],
                help="info: print channels, times and how the solves ended; recover: "
                "copy what is whole of an unfinished file; export: write a table with "
                "a row per step; layout: write a layout for Foxglove or Lichtblick; "
                "inspect: write a page on any log (rates, gaps, repeats, noise, "
                "delays, excitation)",
            ),
            _argument(
                "file",
                type=Path,
                help="MCAP file, finished or not; inspect: any log",
            ),
            _argument(
                "output",
                type=Path,
                nargs="?",
                help="file to write; .csv or .parquet of export (FILE with "
                ".recovered.mcap, .csv, .layout.json or .inspection.html)",
            ),
            _argument(
                "--mapping",
                type=Path,
                help="inspect: YAML file that says what the columns mean",
            ),
            _argument(
                "--time",
                default="",
                metavar="COLUMN",
                help="inspect, without a mapping: column of the times [s], by name or "
                "number",
            ),
            _argument(
                "--time-step",
                type=float,
                metavar="SECONDS",
                help="inspect, without a mapping: constant step of rows without times",
            ),
        ],
    ),
    "warmup": Subcommand(
        "Compiles the numerical kernels now, instead of at the first flight",
        module="_warmup",
    ),
    "completion": Subcommand(
        "Prints a shell script that completes commands at TAB",
        module="_completion",
        arguments=[
            _argument(
                "shell",
                nargs="?",
                choices=["bash", "zsh", "fish"],
                help='shell; put into its profile: eval "$(gpmpc completion bash)"',
            ),
            _argument(
                "--line",
                metavar="LINE",
                help="print the completions of this beginning of a line",
            ),
        ],
    ),
    "version": Subcommand(
        "Prints versions, the BLAS library and the processor", module="_version"
    ),
    "help": Subcommand(
        "Explains a command",
        module="_help",
        arguments=[_argument("name", metavar="COMMAND", nargs="?")],
    ),
}
