"""Writes finished runs to MLflow, each result once.

A file of the run's folder says which result is there already.
"""

import math
import os
import re
from collections.abc import Mapping
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from gpmpc._files import write_whole
from gpmpc._provenance import flattened
from gpmpc.cli._mistakes import one_line
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import SettingError
from gpmpc.studies._run_folder import METRICS, RunFolder

_LONGEST_PARAMETER = 6000  # characters that MLflow takes
_WRITTEN = ".mlflow"  # holds digits of the metrics.json that is in MLflow


def check_tracker(tracker: str | None) -> None:
    """Raises ``SettingError`` where runs cannot be tracked here as it is set."""
    if tracker == "mlflow" and find_spec("mlflow") is None:
        raise SettingError("tracker", "needs MLflow: pip install mlflow")


def track(folder: RunFolder, result: Mapping[str, Any]) -> bool:
    """Writes a finished run to MLflow, unless it is there.

    Where that fails, the run stays finished, and a line says so.

    Returns:
        Whether it is there.
    """
    path = folder.path
    try:
        digits = sha256((path / METRICS).read_bytes()).hexdigest()
        written = path / _WRITTEN
        if written.exists() and written.read_text() == digits:
            return True
        write_whole(written, "", flush=False)  # where nothing may be written, is none
        log_to_mlflow(path, result)
        write_whole(written, digits, flush=False)
    except Exception as error:
        print_error(f"{path} is not in MLflow: {one_line(error)}")
        return False
    return True


def log_to_mlflow(folder: Path, result: Mapping[str, Any]) -> None:
    """Writes a run: settings as parameters, numbers as metrics, files as artifacts.

    Where it goes is said as MLflow says it, by ``MLFLOW_TRACKING_URI`` and
    ``MLFLOW_EXPERIMENT_NAME``; else into the experiment ``gpmpc`` of the default store.
    """
    import mlflow  # pyright: ignore[reportMissingImports]

    environment = os.environ
    if not {"MLFLOW_EXPERIMENT_NAME", "MLFLOW_EXPERIMENT_ID"} & environment.keys():
        mlflow.set_experiment("gpmpc")
    with mlflow.start_run(run_name=folder.name):
        mlflow.log_params(_parameters(result))
        mlflow.log_metrics(_metrics(result))
        mlflow.log_artifacts(str(folder))


def _parameters(result: Mapping[str, Any]) -> dict[str, str]:
    settings = flattened(result["settings"])
    return {
        _name(key): str(value)[:_LONGEST_PARAMETER] for key, value in settings.items()
    }


def _metrics(result: Mapping[str, Any]) -> dict[str, float]:
    """Returns the finite numbers of a result by name."""
    others = ("settings", "provenance", "choices")
    measured = {key: value for key, value in result.items() if key not in others}
    metrics = {}
    for key, value in flattened(measured).items():
        if isinstance(value, int | float) and math.isfinite(value):
            metrics[_name(key)] = float(value)
    return metrics


def _name(key: str) -> str:
    """Returns a key in letters that MLflow takes."""
    return re.sub(r"[^\w\-. /]", "_", key, flags=re.ASCII)
