"""Writes finished runs to an experiment tracker, beside the run's own folder."""

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gpmpc.provenance import flattened

_LONGEST = 6000  # characters of a parameter that MLflow takes


def log_to_mlflow(folder: Path, result: Mapping[str, Any]) -> None:
    """Writes a finished run to MLflow: settings as parameters, numbers as metrics, files as artifacts.

    Where it goes, and into which experiment, is said as MLflow says it: ``MLFLOW_TRACKING_URI``,
    ``MLFLOW_EXPERIMENT_NAME``; else into the experiment ``gpmpc`` of the default store.

    Args:
        folder: The run's folder; its name is the run's.
        result: What ``metrics.json`` holds: ``settings``, and metrics in nested mappings.
    """
    import mlflow  # pyright: ignore[reportMissingImports]

    found = flattened({key: value for key, value in result.items() if key not in ("settings", "provenance", "choices")})
    numbers = {key: float(value) for key, value in found.items() if isinstance(value, int | float)}
    settings = {_name(key): str(value)[:_LONGEST] for key, value in flattened(result["settings"]).items()}
    if "MLFLOW_EXPERIMENT_NAME" not in os.environ and "MLFLOW_EXPERIMENT_ID" not in os.environ:
        mlflow.set_experiment("gpmpc")
    with mlflow.start_run(run_name=folder.name):
        mlflow.log_params(settings)
        mlflow.log_metrics({_name(key): value for key, value in numbers.items() if math.isfinite(value)})
        mlflow.log_artifacts(str(folder))


def _name(key: str) -> str:
    """Returns a key in letters that MLflow takes."""
    return re.sub(r"[^\w\-. /]", "_", key, flags=re.ASCII)
