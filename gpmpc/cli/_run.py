"""``gpmpc run``: one flight, from its settings to its folder; ``gpmpc run -m`` (``sweep``) flies many of them."""

import math
import os
import re
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from gpmpc._compiling import report_compilation
from gpmpc._provenance import flattened
from gpmpc.cli._command import Result
from gpmpc.cli._recorded_settings import checked_settings
from gpmpc.cli._settings import folder_of, one_line, writing
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import DataError, SettingError, ShapeError, check_number
from gpmpc.logs import SavedModel
from gpmpc.recording import McapRecorder, RecordedSystem
from gpmpc.simulation import Noise
from gpmpc.studies._document import plain_text, terminal
from gpmpc.studies._run_folder import (
    RECORDING,
    RunFolder,
    folder_name,
    of_other_code,
    record,
)
from gpmpc.studies.flight import Experiment, metrics, run_trial, summary
from gpmpc.studies.study import one_thread
from gpmpc.systems import System

ASIDE = (
    "launcher",
    "folder",
    "live",
    "tracker",
)  # settings that a result does not depend on
_GROUPS = (
    "data",
    "trajectory",
    "system",
    "model",
    "controller",
    "propagation",
    "solver",
    "learning",
)
_MISTAKES = (
    SettingError,
    ShapeError,
    DataError,
    InstantiationException,
    OmegaConfBaseException,
)
_CHOICES = {
    "recorder": ("mcap", "none"),
    "tracker": ("mlflow", "none"),
    "live": (True, False),
}
_LOST = 3  # exit code of a run that is finished, and whose flight was lost
_LONGEST = 6000  # characters of a parameter that MLflow takes


def run(config: DictConfig) -> Result:
    """Flies, prints the results and where they are kept; the task behind ``conf/run.yaml``."""
    console = Console()
    with console.status("flying"), report_compilation():
        experiment_of(
            config
        )  # what a user can get wrong is found before anything is written
        outcome = run_one(config, warn=_warning_printer())
    if "error" in outcome:
        print_error(f"{outcome['error']} (traceback: {outcome['folder']}/error.json)")
        return Result(outcome, 2 if outcome["mistake"] else 1)
    console.print(terminal([summary(outcome["result"])]))
    state = "finished before" if outcome["skipped"] else "written to"
    console.out(f"{state}: {outcome['folder']}", highlight=False)
    other_code = of_other_code(outcome["result"]) if outcome["skipped"] else ""
    if other_code:
        console.out(
            f"these are the numbers of other code ({other_code}); remove the folder to "
            "fly it with this code",
            highlight=False,
        )
    warning = warning_of(outcome["result"])
    if warning is not None:
        print_error(warning)
    data = outcome["result"] | {
        "folder": outcome["folder"],
        "of_other_code": bool(other_code),
    }
    return Result(data, _LOST if outcome["result"].get("lost") else 0)


def warning_of(result: Mapping[str, Any]) -> str | None:
    """Returns in a line that a flight was lost, or suspicious at its end, and why."""
    lost = result.get("lost")
    judgement = result.get("judgement")
    if lost:
        return plain_text(f"lost: {_since(lost)}")
    if isinstance(judgement, Mapping) and judgement.get("level") == "suspicious":
        return plain_text(f"suspicious: {_since(judgement)}")
    return None


def _since(told: Any) -> str:
    """Returns from which step on, and why, as far as a result tells."""
    if not isinstance(told, Mapping):
        return str(told)
    return f"from step {told.get('step')} on: {told.get('reason')}"


def _warning_printer() -> Callable[[str], None]:
    """Returns what prints each line once, however many flights it is of."""
    printed: set[str] = set()

    def warn(line: str) -> None:
        if line not in printed:
            print_error(f"before the flight: {line}")
        printed.add(line)

    return warn


def run_one(
    config: DictConfig,
    wait: bool = True,
    warn: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Flies one run; an error is kept in its folder and returned as ``error``.

    ``warn`` is called before the flight with each line of what may go wrong in it.
    """
    overrides = choices(HydraConfig.get().overrides.task)
    folder = RunFolder(folder_of(config.folder) / folder_name(overrides))
    outcome = {"folder": str(folder.path), "skipped": False}
    with writing(folder.path), folder.locked(wait):
        settings = plain_settings(config, HydraConfig.get().runtime.choices)
        if folder.finished and not config.live:
            return outcome | {"skipped": True, "result": folder.result(settings)}
        about = record(overrides, settings, shlex.join(["gpmpc", "run", *overrides]))
        try:
            folder.begin(OmegaConf.to_yaml(config, resolve=True))
            with one_thread():  # the same sums in the same order, whatever the launcher
                flown = _fly(experiment_of(config), folder, config, about, warn)
            result = about | flown
            folder.finish(result)
        except Exception as error:
            if _was_interrupted(error):
                raise KeyboardInterrupt from error
            folder.fail(error, about)
            return outcome | {
                "error": one_line(error),
                "mistake": isinstance(error, _MISTAKES),
            }
        if config.tracker == "mlflow":
            try:
                log_to_mlflow(folder.path, result)
            except Exception as error:  # the run stays finished
                print_error(f"{folder.path} is not in MLflow: {one_line(error)}")
    return outcome | {"result": result}


def _was_interrupted(error: BaseException | None) -> bool:
    """Whether an error came up while a Ctrl-C was being dealt with, as in the settings' own clean-up."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _fly(
    experiment: Experiment,
    folder: RunFolder,
    config: DictConfig,
    about: dict[str, Any],
    warn: Callable[[str], None] | None,
) -> dict[str, Any]:
    """Trains, flies and records; returns the metrics."""
    if config.recorder != "mcap":
        return metrics(experiment, run_trial(experiment, warn=warn))
    system = experiment.system
    text = OmegaConf.to_yaml(config, resolve=True)
    known = {
        "seed": experiment.seed,
        "command": about["provenance"]["command"],
        "system": system.name,
    }
    known |= {"tracked": " ".join(system.tracked), "angles": " ".join(system.angles)}
    episodes = range(1, 1 + getattr(experiment.learning, "episodes", 0))
    paths = iter(
        [
            folder.path / name
            for name in [*(f"episode_{k}.mcap" for k in episodes), RECORDING]
        ]
    )
    with ExitStack() as stack:

        def prepare(controller: Any, training: Any) -> Callable[[Any], None]:
            bounds = [
                side[0]
                for side in controller.problem.inputs.by_stage(controller.horizon)
            ]
            noise = {
                "noise_std": " ".join(
                    map(str, experiment.unplanned_noise(training).tolist())
                )
            }
            recorded = RecordedSystem.of(system, bounds)
            settings = {"config": text, "live": config.live}
            recorder = McapRecorder(
                next(paths), recorded, metadata=known | noise, **settings
            )
            stack.enter_context(recorder)
            if recorder.address:
                print(
                    f"live view: open {recorder.address} in Foxglove or Lichtblick",
                    file=sys.stderr,
                    flush=True,
                )
            gp_size = 0 if training is None else len(training.posterior)
            began = time.monotonic()

            def on_step(step: Any) -> None:
                recorder.record(replace(step, gp_size=step.gp_size or gp_size))
                if config.live:  # every step lasts as long as the plant's, so that a viewer can follow
                    time.sleep(
                        max(
                            0.0, began + step.time + system.time_step - time.monotonic()
                        )
                    )

            return on_step

        flown = run_trial(experiment, prepare, warn)
    return metrics(experiment, flown)


def experiment_of(config: DictConfig) -> Experiment:
    """Makes the objects that a user's settings describe; they may call anything."""
    return _made(_merged(DictConfig(plain_data(config))))


def experiment_of_file(settings: dict[str, Any], trusted: Sequence[str]) -> Experiment:
    """Makes the objects that settings out of a file describe.

    Args:
        settings: Plain data (``read_settings``).
        trusted: Packages whose code they may call, besides what ``gpmpc._trust`` lists.

    Raises:
        DataError: They call something else.
    """
    merged = plain_data(_merged(DictConfig(settings)))
    return _made(DictConfig(checked_settings(merged, trusted)))


def _merged(config: DictConfig) -> DictConfig:
    """Checks settings and completes their parts, each as it will be called.

    A nominal system and a plant are whole systems, the controller has its propagator and
    its solver.
    """
    _check(config)
    with open_dict(config):
        known = config.nominal
        if known and "_target_" not in known:
            config.nominal = OmegaConf.merge(config.system, known)
        differing = {
            key: value
            for key, value in (config.plant or {}).items()
            if value != config.system.get(key)
        }
        config.plant = OmegaConf.merge(config.system, differing) if differing else None
        for group, part in (("propagation", "propagator"), ("solver", "solver")):
            if config.get(group) and part not in config.controller:
                raise SettingError(
                    group, "this controller has none to choose; leave it out"
                )
            if config.get(group):
                config.controller[part] = config[group]
    return config


def _made(config: DictConfig) -> Experiment:
    """Makes the objects of merged settings."""
    system = _system_of(config.system)
    known = config.nominal
    if known:
        system = replace(system, nominal=_system_of(known))
    with open_dict(config):
        size = config.data.pop("size")
        _fill(config.controller, initial_input=system.initial_input)
        problem = config.controller.problem
        if problem.cost.get("Q") is None or problem.cost.get("R") is None:
            raise SettingError(
                "controller.problem.cost",
                f"has no weights Q and R; {system.name} is to bring them",
            )
        _fill(problem.cost, angles=system.angle_indices)
        _fill(problem.inputs, lower=system.input_lower, upper=system.input_upper)
    ((name, trajectory),) = config.trajectory.items()
    parts = {
        key: instantiate(config[key], _convert_="all")
        for key in ("data", "controller", "disturbances")
    }
    trained = instantiate(config.model, _convert_="all")
    saved = isinstance(trained, SavedModel)
    if saved:
        trained.check(system)
    if known and getattr(trained, "predicts", None) != "difference":
        raise SettingError(
            "nominal", "needs model=difference_gp, which learns what it misses"
        )
    return Experiment(
        **parts,
        trajectory=instantiate(trajectory, _convert_="all"),
        train=trained,
        model=trained.model if saved else None,
        system=system,
        plant=_system_of(config.plant) if config.plant else None,
        name=name,
        size=size,
        propagator=getattr(parts["controller"], "keywords", {}).get("propagator"),
        noise=Noise(**config.noise) if any(config.noise.values()) else None,
        learning=instantiate(config.learning, _convert_="all")
        if config.get("learning")
        else None,
        **{key: config[key] for key in ("steps", "seed", "loop", "on_failure")},
    )


def _check(config: DictConfig) -> None:
    """Raises where a setting that no object takes is none of its choices, or a group has none."""
    folder_of(config.folder)
    check_number("horizon", config.horizon, least=1, whole=True)
    if not OmegaConf.is_list(config.disturbances):
        raise SettingError(
            "disturbances", f"must be a list; got {config.disturbances!r}"
        )
    for key, choices in _CHOICES.items():
        if config[key] not in (*choices, None):
            raise SettingError(
                key, f"must be {' or '.join(map(repr, choices))}; got {config[key]!r}"
            )
    if config.tracker == "mlflow" and find_spec("mlflow") is None:
        raise SettingError("tracker", "needs MLflow: pip install mlflow")
    if config.live and config.recorder != "mcap":
        raise SettingError(
            "live", f"needs recorder=mcap; got recorder={config.recorder}"
        )
    for group in ("data", "trajectory", "system", "model", "controller"):
        if not config.get(group):
            raise SettingError(group, "choose one")
    if len(config.trajectory) != 1:
        raise SettingError(
            "trajectory", f"choose one; got {', '.join(config.trajectory)}"
        )


def _fill(config: DictConfig, **values: Any) -> None:
    """Sets what is null to lists of numbers."""
    for key, numbers in values.items():
        if config.get(key) is None:
            config[key] = list(numbers)


def _system_of(settings: Any) -> System:
    """Makes the system that the settings ``system`` describe."""
    system = instantiate(settings, _convert_="all")
    if not isinstance(system, System):
        what = "_target_ must name a function that returns a gpmpc.systems.System"
        raise SettingError("system", f"{what}; got {type(system).__name__}")
    return system


def plain_settings(config: DictConfig, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Returns all that a result depends on, as plain data: the settings, and the chosen option by group."""
    settings = plain_data(config)
    if path := settings["model"].get("path"):
        settings["model"]["sha256"] = sha256(Path(path).read_bytes()).hexdigest()
    options = {group: chosen.get(group) for group in _GROUPS}
    return {key: value for key, value in settings.items() if key not in ASIDE} | {
        "options": options
    }


def plain_data(config: DictConfig) -> dict[str, Any]:
    """Returns settings with everything resolved."""
    found: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return found


def choices(overrides: Sequence[str]) -> list[str]:
    """Returns what distinguishes a run, ``key=value`` each in Hydra's own spelling; of a key given twice, the last."""
    found = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if key not in ASIDE and not key.lstrip("+~").startswith(("hydra.", "hydra/")):
            found[key] = (
                key
                if override.is_delete()
                else f"{key}={override.get_value_element_as_str()}"
            )
    return sorted(found.values())


def log_to_mlflow(folder: Path, result: Mapping[str, Any]) -> None:
    """Writes a finished run to MLflow: settings as parameters, numbers as metrics, files as artifacts.

    Where it goes is said as MLflow says it, by ``MLFLOW_TRACKING_URI`` and ``MLFLOW_EXPERIMENT_NAME``; else into the
    experiment ``gpmpc`` of the default store.
    """
    import mlflow  # pyright: ignore[reportMissingImports]

    def name(key: str) -> str:  # in letters that MLflow takes
        return re.sub(r"[^\w\-. /]", "_", key, flags=re.ASCII)

    found = flattened(
        {
            key: value
            for key, value in result.items()
            if key not in ("settings", "provenance", "choices")
        }
    )
    numbers = {
        key: float(value)
        for key, value in found.items()
        if isinstance(value, int | float)
    }
    settings = {
        name(key): str(value)[:_LONGEST]
        for key, value in flattened(result["settings"]).items()
    }
    if (
        "MLFLOW_EXPERIMENT_NAME" not in os.environ
        and "MLFLOW_EXPERIMENT_ID" not in os.environ
    ):
        mlflow.set_experiment("gpmpc")
    with mlflow.start_run(run_name=folder.name):
        mlflow.log_params(settings)
        mlflow.log_metrics(
            {name(key): value for key, value in numbers.items() if math.isfinite(value)}
        )
        mlflow.log_artifacts(str(folder))
