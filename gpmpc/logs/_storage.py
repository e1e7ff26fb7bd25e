"""Saves what was learned from a log to one file of numbers and a header (safetensors), and loads it: no pickle."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from gpmpc.exceptions import DataError, SettingError
from gpmpc.files import write_whole
from gpmpc.gp import GPPosterior
from gpmpc.logs._fitting import NominalFit
from gpmpc.logs._kinematics import Increments, Kinematics, RigidBody
from gpmpc.logs._learning import Candidate, Learned
from gpmpc.logs._noise import OutputNoise
from gpmpc.logs._nominal import AffineNominal, MultirotorNominal, Nominal, Still
from gpmpc.logs._rollouts import LogModel, OutputGP
from gpmpc.logs._state_space import StateGroup, StateSpace

FORMAT, VERSION = "gpmpc model of a log", 2
_KERNEL = ("lengthscales", "signal_variance", "noise_variance")


def save_learned(learned: Learned, path: str | Path) -> None:
    """Writes what was learned, in one piece or not at all.

    Raises:
        SettingError: The nominal model is a user's own, which a file of numbers cannot hold, or the path cannot be
            written.
    """
    model, nominal = learned.model, learned.model.nominal
    if not isinstance(nominal, MultirotorNominal | AffineNominal | Still):
        raise SettingError("nominal", f"only models of gpmpc.logs can be saved; got {type(nominal).__name__}")
    described = {k: v for k, v in vars(nominal).items() if isinstance(v, bool | int | float)}
    header = {
        "format": FORMAT,
        "version": VERSION,
        "groups": [asdict(group) for group in model.kinematics.space.groups],
        "kinematics": type(model.kinematics).__name__,
        "nominal": [type(nominal).__name__, described],
        "history": model.history,
        "lag": model.lag,
        "gps": [gp.outputs for gp in model.gps],
        "fit": [learned.fit.cost, learned.fit.start_cost, learned.fit.evaluations],
        "candidates": [[c.name, c.chosen, c.errors.tolist()] for c in learned.candidates],
        "rows": learned.rows,
        "runs": learned.runs,
        "names": [learned.state_names, learned.input_names, learned.context_names],
        "time_step": learned.time_step,
    }
    arrays = {"theta": model.theta, "standard_errors": learned.fit.standard_errors, "ranges": learned.ranges}
    arrays |= {f"noise/{key}": getattr(learned.noise, key) for key in ("outputs", "measurement", "level")}
    for i, gp in enumerate(model.gps):
        post = gp.posterior
        arrays |= {f"gp{i}/{key}": getattr(post, key).numpy() for key in ("features", "targets", *_KERNEL, "offset")}
    content = save({k: np.ascontiguousarray(v) for k, v in arrays.items()}, {"gpmpc": json.dumps(header)})
    try:
        write_whole(path, content)
    except OSError as error:
        raise SettingError("path", f"cannot write to {path}: {error.strerror}") from error


def holds_learned(path: str | Path) -> bool:
    """Whether a file is one of ``save_learned``, of whatever version."""
    try:
        with safe_open(str(path), "numpy") as file:
            return json.loads((file.metadata() or {}).get("gpmpc", "{}")).get("format") == FORMAT
    except (SafetensorError, OSError, ValueError):
        return False


def load_learned(path: str | Path) -> Learned:
    """Reads a file of ``save_learned``.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format.
    """
    try:
        with safe_open(str(path), "numpy") as file:
            header = json.loads((file.metadata() or {}).get("gpmpc", "{}"))
            if (header.get("format"), header.get("version")) != (FORMAT, VERSION):
                raise DataError(f"{path}: not a {FORMAT} of version {VERSION}")
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118, no dictionary
        return _learned(header, arrays)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: not a readable {FORMAT} ({error})") from error


def _learned(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Learned:
    groups = (StateGroup(g["name"], tuple(g["entries"]), g["unit"], g["kind"]) for g in header["groups"])
    space = StateSpace(tuple(groups))
    kinematics: Kinematics = RigidBody(space) if header["kinematics"] == "RigidBody" else Increments(space)
    name, settings = header["nominal"]
    nominal: Nominal
    if name == "MultirotorNominal":
        nominal = MultirotorNominal(**settings)
    else:
        nominal = AffineNominal(kinematics, **settings) if name == "AffineNominal" else Still(**settings)
    gps = []
    for i, outputs in enumerate(header["gps"]):
        own = {key: torch.from_numpy(arrays[f"gp{i}/{key}"]) for key in ("features", "targets", *_KERNEL, "offset")}
        lengthscales, signal, noise = (own[key] for key in _KERNEL)
        posterior = GPPosterior.from_hyperparameters(
            own["features"], own["targets"], lengthscales, signal, noise, 0, "value", own["offset"]
        )
        gps.append(OutputGP(tuple(outputs), posterior))
    states, inputs, context = (tuple(names) for names in header["names"])
    model = LogModel(kinematics, nominal, arrays["theta"], tuple(header["history"]), header["lag"], tuple(gps))
    return Learned(
        model,
        OutputNoise(arrays["noise/outputs"], arrays["noise/measurement"], arrays["noise/level"]),
        NominalFit(model, arrays["standard_errors"], *header["fit"]),
        tuple(Candidate(name, np.array(errors), chosen) for name, chosen, errors in header["candidates"]),
        arrays["ranges"],
        header["rows"],
        tuple(header["runs"]),
        states,
        inputs,
        context,
        header["time_step"],
    )
