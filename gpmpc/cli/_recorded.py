"""Finds recorded flights, and makes what the settings in them describe."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpmpc._files import folders_below
from gpmpc._provenance import is_of_this_code
from gpmpc._trust import trusted_packages
from gpmpc.cli._folders import find_modules_here
from gpmpc.cli._mistakes import one_line
from gpmpc.cli._plain_settings import model_fingerprint
from gpmpc.cli._recorded_settings import read_settings
from gpmpc.exceptions import DataError
from gpmpc.recording import Run
from gpmpc.studies._run_folder import RECORDING

if TYPE_CHECKING:
    from gpmpc.studies.flight import Experiment

_OWN_CODE = "own_code."  # begins the keys of fingerprints of the user's code
_NO_SETTINGS = "holds no settings, which gpmpc run puts into its recordings"


def recordings(run: Path) -> list[Path]:
    """Returns the recordings of a run's folder, of one above it, or of a file.

    Those of episodes, ``episode_1.mcap`` and so on, are named as files.
    """
    if not run.is_dir():
        return [run]
    if (run / RECORDING).exists():
        return [run / RECORDING]
    paths = sorted(
        Path(folder, RECORDING)
        for folder, files in folders_below(run)
        if RECORDING in files
    )
    if not paths:
        raise DataError(f"{run}: holds no {RECORDING}, nor does a folder below it")
    return paths


def experiment_of_run(run: Run, trust: Sequence[str]) -> "Experiment":
    """Makes what the settings in a recording describe.

    They may call code of the packages in ``trust``, besides gpmpc's own.

    Raises:
        DataError: The recording holds no settings, or such that describe another
            flight, none, or call other code.
    """
    trusted = trusted_packages("--trust", trust)
    if not run.config.strip():
        raise DataError(f"{run.path}: {_NO_SETTINGS}")
    from gpmpc.cli._experiment import experiment_of_file  # loads torch

    with errors_of_settings(run):
        settings = read_settings(run.config)
        if not {"system", "controller", "folder"} <= settings.keys():
            raise DataError(_NO_SETTINGS)
        if trusted:  # else nothing in the working folder may be imported
            find_modules_here()
        experiment = experiment_of_file(settings, trusted)
        system = experiment.system
        described = (system.state_names, system.input_names)
        if described != (run.state_names, run.input_names):
            raise DataError("its settings describe another system than it recorded")
    return experiment


def changes_since(run: Run) -> list[str]:
    """Returns what has changed since a flight: the code, the file of its model.

    Each is the beginning of a sentence. A recording that does not tell, as those of
    older versions, is one of other code.

    Args:
        run: Whose settings are known to be harmless: they made an experiment.
    """
    about: Mapping[str, Any] = run.metadata.get("run", {})
    settings = read_settings(run.config)
    changes = []
    of_user = {
        key.removeprefix(_OWN_CODE): digits
        for key, digits in about.items()
        if key.startswith(_OWN_CODE)
    }
    if not is_of_this_code({**about, "own_code": of_user}, settings):
        changes.append(f"{run.path} was flown by other code")
    digest = about.get("model_sha256")
    path = settings.get("model", {}).get("path")
    if digest is not None and model_fingerprint(path) != digest:
        changes.append(f"{path} has changed since {run.path} was flown")
    return changes


@contextmanager
def errors_of_settings(run: Run) -> Iterator[None]:
    """Turns whatever settings that nobody has checked raise into one error."""
    try:
        yield
    except Exception as error:
        raise DataError(f"{run.path}: {one_line(error)}") from error
