"""``gpmpc run``: one flight, from its settings to its folder.

``gpmpc run -m`` flies many of them; see ``_sweep``.
"""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from gpmpc._compiling import report_compilation
from gpmpc._provenance import own_code
from gpmpc._remarks import remarks_to
from gpmpc.cli._commands import Result
from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._folders import folder_of, writing
from gpmpc.cli._mistakes import one_line
from gpmpc.cli._mlflow import track
from gpmpc.cli._overrides import choices, folder_choice
from gpmpc.cli._plain_settings import plain_settings
from gpmpc.cli._settings import config_source_options, run_command
from gpmpc.cli._terminal import OutputEnded, print_error
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.recording import McapRecorder, RecordedSystem
from gpmpc.simulation import Step
from gpmpc.studies._document import terminal
from gpmpc.studies._run_folder import (
    RECORDING,
    RunFolder,
    RunState,
    folder_name,
    of_other_code,
    run_header,
)
from gpmpc.studies._run_record import warning_of
from gpmpc.studies.flight import Experiment, metrics, run_trial, summary
from gpmpc.studies.study import one_thread

# Errors by which a user's mistake shows.
_MISTAKES = (
    SettingError,
    ShapeError,
    DataError,
    InstantiationException,
    OmegaConfBaseException,
)
_LOST = 3  # exit code of a run that is finished, and whose flight was lost
Warn = Callable[[str], None]


@dataclass(frozen=True)
class RunToFly:
    """What is flown, and where it is kept."""

    config: DictConfig
    #: the chosen option by group
    options: Mapping[str, Any]
    #: what distinguishes it from other runs of the tree, ``key=value`` each
    choices: Sequence[str]
    #: that flies it
    command: str
    folder: RunFolder
    #: of the settings, as a sweep compares them; None where it has none
    fingerprint: str | None = None


@dataclass(frozen=True)
class Outcome:
    """How one run ended."""

    #: where it is kept
    folder: Path
    #: content of its metrics.json; None where it failed
    result: dict[str, Any] | None = None
    #: whether it was finished before, and not flown now
    skipped: bool = False
    #: why it failed, in a line; None where it did not
    error: str | None = None
    #: whether the error is a mistake in the settings
    mistake: bool = False


def run(config: DictConfig) -> Result:
    """Flies, prints the results and where they are kept."""
    console = Console()
    with (
        console.status("flying"),
        report_compilation(),
        remarks_to(print_error),
    ):
        # What a user can get wrong is found before anything is written; the objects
        # that fly are made again in ``_fly_and_measure``, where an error is kept in the
        # folder.
        experiment_of(config)
        hydra_settings = HydraConfig.get()
        launcher = (hydra_settings.launcher or {}).get("name", "basic")
        if launcher != "basic":
            print_error(f"launcher={launcher} is for sweeps (-m); this run flies here")
        overrides = hydra_settings.overrides.task
        own_choices = choices(overrides)
        to_fly = RunToFly(
            config=config,
            options=hydra_settings.runtime.choices,
            choices=own_choices,
            command=run_command(
                config_source_options(hydra_settings),
                [*own_choices, *folder_choice(overrides)],
            ),
            folder=RunFolder(folder_of(config.folder) / folder_name(own_choices)),
        )
        outcome = run_one(to_fly, warn=_warning_printer())
    if outcome.result is None:
        return _report_failure(outcome)
    return _report_result(outcome, outcome.result, console)


def _report_failure(outcome: Outcome) -> Result:
    """Prints why a run failed; the exit code is 2 for a user's mistake, 1 else."""
    print_error(f"{outcome.error} (traceback: {outcome.folder}/error.json)")
    data = {
        "folder": str(outcome.folder),
        "skipped": outcome.skipped,
        "error": outcome.error,
        "mistake": outcome.mistake,
    }
    return Result(data, 2 if outcome.mistake else 1)


def _report_result(
    outcome: Outcome, result: dict[str, Any], console: Console
) -> Result:
    """Prints what a run measured, where it is, and what its reader must know."""
    console.print(terminal([summary(result)]))
    state = "finished before" if outcome.skipped else "written to"
    console.out(f"{state}: {outcome.folder}", highlight=False)
    other_code = of_other_code(result) if outcome.skipped else ""
    if other_code:
        console.out(
            f"these are the numbers of other code ({other_code}); remove the folder to "
            "fly it with this code",
            highlight=False,
        )
    warning = warning_of(result)
    if warning is not None:
        print_error(warning)
    data = result | {
        "folder": str(outcome.folder),
        "of_other_code": bool(other_code),
    }
    return Result(data, _LOST if result.get("lost") else 0)


def _warning_printer() -> Warn:
    """Returns a function that prints each line once, however many flights it is of."""
    printed: set[str] = set()

    def warn(line: str) -> None:
        if line not in printed:
            print_error(f"before the flight: {line}")
        printed.add(line)

    return warn


def run_one(to_fly: RunToFly, wait: bool = True, warn: Warn | None = None) -> Outcome:
    """Flies one run unless its folder is finished; an error is kept in the folder.

    So is the end of the process (``sys.exit``) that code of the user's asked for.

    One with a live view flies again; its folder is not finished from then on until it
    is again.

    Args:
        to_fly: The run.
        wait: Whether to wait for another process that works on the folder.
        warn: Called before the flight with each line of what may go wrong in it.

    Raises:
        Busy: Another process works on the folder, and ``wait`` is false.
        SettingError: The folder holds a run of other settings, or cannot be written.
    """
    config = to_fly.config
    folder = to_fly.folder
    settings = plain_settings(config, to_fly.options)
    if folder.finished and not config.live:  # in a folder that may only be read, too
        result = folder.result(settings)
        if config.tracker == "mlflow":  # a run that was flown without, or not taken
            track(folder, result)
        return Outcome(folder.path, result, skipped=True)
    if wait and folder.state is RunState.RUNNING:
        print_error(f"waiting for {folder.last_worker}, which flies {folder.path}")
    with writing(folder.path), folder.locked(wait):
        if folder.finished:
            result = folder.result(settings)
            if not config.live:
                return Outcome(folder.path, result, skipped=True)
        header = run_header(to_fly.choices, settings, to_fly.command)
        # The list is filled while the run flies. It stands under provenance, which
        # equal runs need not share: some remarks are made once a process.
        remarks: list[str] = header["provenance"]["remarks"]
        header["provenance"]["settings_fingerprint"] = to_fly.fingerprint
        try:
            yaml_text = OmegaConf.to_yaml(config, resolve=True)
            folder.begin(yaml_text)
            # The same sums in the same order, whatever the launcher.
            with one_thread(), remarks_to(remarks.append):
                result = header | _fly_and_measure(to_fly, yaml_text, warn)
            folder.finish(result)
        except (Exception, SystemExit) as error:
            # Ray, or who reads the output, ends this process: no failure of the run.
            if hasattr(error, "ray_terminate_msg") or isinstance(error, OutputEnded):
                raise
            if _was_interrupted(error):
                raise KeyboardInterrupt from error
            folder.fail(error, header)
            return Outcome(
                folder.path,
                error=one_line(error),
                mistake=isinstance(error, _MISTAKES),
            )
        if config.tracker == "mlflow":
            track(folder, result)
    return Outcome(folder.path, result)


def _was_interrupted(error: BaseException | None) -> bool:
    """Whether an error came up while a Ctrl-C was being dealt with.

    That may be in the clean-up of the settings.
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _fly_and_measure(
    to_fly: RunToFly, yaml_text: str, warn: Warn | None
) -> dict[str, Any]:
    """Trains, flies and records; returns the metrics.

    Args:
        to_fly: The run.
        yaml_text: Its settings, which are put into every recording.
        warn: Called before the flight with each line of what may go wrong in it.
    """
    began = time.monotonic()
    experiment = experiment_of(to_fly.config)
    open_recording = None
    if to_fly.config.recorder == "mcap":
        open_recording = _Recordings(experiment, to_fly, yaml_text).open_next
    measured = metrics(experiment, run_trial(experiment, open_recording, warn))
    # Times of files, which would tell it as well, get lost where a folder is copied.
    measured["times"]["run"] = time.monotonic() - began
    return measured


class _Recordings:
    """The recordings of a run: one file for each of its episodes, and one at the end.

    Args:
        experiment: What is flown.
        to_fly: Its settings.
        yaml_text: The same as text, which is put into every recording.
    """

    def __init__(self, experiment: Experiment, to_fly: RunToFly, yaml_text: str):
        self._experiment = experiment
        self._yaml_text = yaml_text
        self._command = to_fly.command
        self._origin = _origin(plain_settings(to_fly.config, to_fly.options))
        self._live = to_fly.config.live
        # Names that no recording takes are refused before anything is learned.
        self._system = RecordedSystem.of(experiment.system)
        episodes = getattr(experiment.learning, "episodes", 0)
        names = [f"episode_{k}.mcap" for k in range(1, 1 + episodes)]
        # One for each call of ``open_next``, in the order in which they are flown.
        self._paths_of_flights = iter(
            [to_fly.folder.path / name for name in (*names, RECORDING)]
        )

    @contextmanager
    def open_next(
        self, controller: Any, training: Any
    ) -> Iterator[Callable[[Step], None]]:
        """Opens the next recording, which ends with its flight, and says how that did.

        Yields:
            What is called with every step.
        """
        system = self._experiment.system
        bounds = controller.problem.inputs.by_stage(controller.horizon)
        gp_size = self._gp_size(training)
        with McapRecorder(
            next(self._paths_of_flights),
            replace(self._system, input_bounds=[side[0] for side in bounds]),
            metadata=self._metadata(training, controller),
            config=self._yaml_text,
            live=self._live,
        ) as recorder:
            if recorder.address:
                print(
                    f"live view: open {recorder.address} in Foxglove or Lichtblick",
                    file=sys.stderr,
                    flush=True,
                )
            began = time.monotonic()

            def on_step(step: Step) -> None:
                # A controller that learns nothing in flight says 0 of its GPs.
                recorder.record(replace(step, gp_size=step.gp_size or gp_size))
                if self._live:
                    # A step lasts as long as the plant's, so that a viewer can follow.
                    end_of_step = began + step.time + system.time_step
                    time.sleep(max(0.0, end_of_step - time.monotonic()))

            yield on_step

    def _gp_size(self, training: Any) -> int:
        """Returns how many transitions the model has; 0 where it has none."""
        model = self._experiment.model if training is None else training.posterior
        return len(model) if isinstance(model, Sized) else 0

    def _metadata(self, training: Any, controller: Any) -> dict[str, Any]:
        """Returns what a reader of the recording needs besides its steps."""
        experiment = self._experiment
        system = experiment.system
        noise = experiment.unplanned_noise(training, controller).tolist()
        return {
            "seed": experiment.seed,
            "command": self._command,
            "system": system.name,
            "tracked": " ".join(system.tracked),
            "angles": " ".join(system.angles),
            "noise_std": " ".join(map(str, noise)),
            **self._origin,
        }


def _origin(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what made a flight besides gpmpc: the user's own code, a model's file."""
    origin: dict[str, Any] = {"own_code": own_code(settings)}
    model_digest = settings["model"].get("sha256")
    if model_digest is not None:
        origin["model_sha256"] = model_digest
    return origin
