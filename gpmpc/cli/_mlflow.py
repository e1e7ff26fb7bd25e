"""Writes finished runs to MLflow."""

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gpmpc._provenance import flattened

_LONGEST_PARAMETER = 6000  # characters that MLflow takes


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
