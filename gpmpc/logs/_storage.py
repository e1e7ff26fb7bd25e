"""Files of what was learned from a log, and of models that are to be flown.

``gpmpc.models`` stores the model; the record of the identification, which stands beside
it in the file, is stored here.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel
from gpmpc._files import existing_file, new_file
from gpmpc._trust import trusted_packages
from gpmpc.exceptions import DataError, SettingError, check_kind
from gpmpc.gp import load_metadata
from gpmpc.gp._storage import consistent, read_model, write_model
from gpmpc.logs._comparison import Comparison
from gpmpc.logs._fitting import NominalFit
from gpmpc.logs._learning import IdentifiedModel
from gpmpc.logs._structures import Candidate
from gpmpc.models import LogDynamics, load_model
from gpmpc.models._namings import order_by_name
from gpmpc.models._older_files import signals_of_metadata
from gpmpc.models._past import first_signals, measured_dim
from gpmpc.models._stored_log_model import (
    LOG_MODEL,
    NamedLogModel,
    check_shape,
    log_model_of_parts,
    log_model_parts,
)
from gpmpc.models._stored_values import texts
from gpmpc.signals import UNKNOWN, Signals, signals_of
from gpmpc.systems import System

_log = logging.getLogger(__name__)


@explains_arguments
def save_learned(learned: IdentifiedModel, path: str | Path) -> None:
    """Writes what was learned from a log, in one piece or not at all.

    Raises:
        SettingError: ``learned`` is of another kind, or its nominal model is: a file
            holds those of gpmpc and, by the name of its code, a user's system.
        DataError: The folder does not exist.

    See Also:
        ``load_learned``, which reads the file.
    """
    check_kind("learned", learned, IdentifiedModel, "what learn returns")
    path = new_file(path)
    named = NamedLogModel(
        model=learned.model,
        noise=learned.noise,
        state_names=learned.state_names,
        input_names=learned.input_names,
        context_names=learned.context_names,
        time_step=learned.time_step,
        namings=learned.namings,
    )
    header, tensors = log_model_parts(path, named)
    # The runs' names stand behind those of states, inputs and context.
    header["names"] = [*header["names"], learned.runs]
    header["candidates"] = [
        [candidate.name, candidate.errors.tolist(), candidate.chosen]
        for candidate in learned.candidates
    ]
    header["judged_steps"] = learned.judged_steps
    header["folds"] = learned.folds
    header["reasons"] = learned.reasons
    header["comparisons"] = [
        [one.name, one.ratio.tolist(), one.low.tolist(), one.high.tolist()]
        for one in learned.comparisons
    ]
    tensors["standard_errors"] = torch.from_numpy(learned.fit.standard_errors)
    tensors["ranges"] = torch.from_numpy(learned.ranges)
    write_model(path, LOG_MODEL, header, tensors)


@explains_arguments
def load_learned(path: str | Path, trusted: Sequence[str] = ()) -> IdentifiedModel:
    """Reads a file of ``save_learned``.

    Args:
        path: The file.
        trusted: Names of packages whose code the file may name, such as that of a
            nominal system.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format,
            or names code that is not trusted.

    See Also:
        ``save_learned``, which writes the file; ``load_flyable`` for any model.
    """
    packages = trusted_packages("trusted", trusted)
    path = existing_file(path, "what gpmpc learn saved")
    header, tensors = read_model(path, LOG_MODEL)
    with consistent(path, f"not a readable {LOG_MODEL}"):
        return _learned_of_parts(path, header, tensors, packages)


def _learned_of_parts(
    path: Path,
    header: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    trusted: Sequence[str],
) -> IdentifiedModel:
    """Makes what was learned of a file's header and tensors."""
    named = log_model_of_parts(path, header, tensors, trusted)
    model = named.model
    *_, runs = header["names"]
    standard_errors = tensors["standard_errors"].numpy()
    if standard_errors.shape not in ((0,), model.theta.shape):  # the nameless have none
        raise DataError(f"standard_errors are no theta's; got {standard_errors.shape}")
    ranges = tensors["ranges"].numpy()
    columns = model.kinematics.space.dim + len(named.input_names)
    check_shape("ranges", ranges, (2, columns))
    candidates = []
    for name, errors, chosen in header["candidates"]:
        numbers = np.array(errors, dtype=float)
        candidates.append(Candidate(str(name), numbers, bool(chosen)))
    return IdentifiedModel(
        model=model,
        noise=named.noise,
        fit=NominalFit(model, standard_errors),
        candidates=tuple(candidates),
        ranges=ranges,
        runs=texts("runs", runs),
        state_names=named.state_names,
        input_names=named.input_names,
        context_names=named.context_names,
        time_step=named.time_step,
        judged_steps=tuple(header.get("judged_steps", (10, 50))),  # of older files
        folds=str(header.get("folds", "")),
        comparisons=tuple(
            Comparison(str(name), np.array(ratio), np.array(low), np.array(high))
            for name, ratio, low, high in header.get("comparisons", ())
        ),
        reasons=_reasons_of(header),
        namings=named.namings,
    )


def _reasons_of(header: Mapping[str, Any]) -> tuple[str, ...]:
    """Returns why the model of a file should not be used; older files do not say."""
    return texts("reasons", header.get("reasons", []))


@dataclass(frozen=True)
class SavedModel:
    """A model from a file, with the names that the file has for its signals.

    See Also:
        ``load_flyable``, which returns it.
    """

    path: str  #: of the file
    model: DynamicsModel  #: trained
    signals: Signals = UNKNOWN  #: names and time step, where the file has them

    def check(self, system: System) -> None:
        """Raises ``SettingError`` unless signals and time step are a system's."""
        model = self.model
        signals = self._signals_for(system)
        measured = measured_dim(model)
        self._check_size("states", measured, signals.state_names, system)
        self._check_size("inputs", model.input_dim, signals.input_names, system)
        first_signals(signals, measured).check(
            self.path, system.signals, system.name, "model"
        )

    def model_for(self, system: System) -> DynamicsModel:
        """Returns the model, whose states and inputs are called as a system's.

        Raises:
            SettingError: Its signals and time step are not the system's.
        """
        self.check(system)
        signals = self._signals_for(system)
        if isinstance(self.model, LogDynamics) and signals != self.signals:
            return replace(self.model, signals=signals)
        return self.model

    def _signals_for(self, system: System) -> Signals:
        """Returns the signals, called as a system's where a log may call them so."""
        if not isinstance(self.model, LogDynamics):
            return self.signals
        namings = self.model.namings
        signals = self.signals
        if _are_called(system.state_names, namings.states):
            signals = replace(signals, state_names=system.state_names)
        if _are_called(system.input_names, namings.inputs):
            signals = replace(signals, input_names=system.input_names)
        return signals

    def _check_size(
        self, key: str, dim: int, names: Sequence[str], system: System
    ) -> None:
        """Raises ``SettingError`` unless a system has as many states or inputs."""
        expected = system.state_names if key == "states" else system.input_names
        if dim != len(expected):
            content = f"the {key} {', '.join(names) or dim}"
            rule = f"{system.name} has {', '.join(expected)}"
            raise SettingError("model", f"{self.path} has {content}; {rule}")


def _are_called(own: Sequence[str], namings: Sequence[Sequence[str]]) -> bool:
    """Returns whether names are one of the ways to call entries, in their order."""
    return order_by_name(own, namings) == list(range(len(own)))


@explains_arguments
def load_flyable(path: str | Path, trusted: Sequence[str] | None = None) -> SavedModel:
    """Reads a model of any file, of ``gpmpc learn`` or of ``save_model``.

    Warns of a model that should not be used, as the command that learned it said.

    Args:
        path: The file.
        trusted: Names of packages whose code the file may name; see ``load_model``.

    Raises:
        DataError: The file is missing, damaged or of another kind, or names code that
            is not trusted.
        SettingError: What is in it cannot be flown, or ``trusted`` is no list of names
            of packages.

    See Also:
        ``load_learned``; ``gpmpc.models.load_model``.
    """
    packages = trusted_packages("model.trusted", trusted)
    header = load_metadata(path)
    model = load_model(path, packages)
    with consistent(Path(path), "its reasons against the model are no texts"):
        for reason in _reasons_of(header):
            _log.warning("%s: do not use this model: %s", path, reason)
    signals = signals_of(model)
    if signals == UNKNOWN:
        with consistent(Path(path), "its metadata do not describe a model"):
            signals = signals_of_metadata(header.get("metadata"))
    return SavedModel(str(path), model, signals)
