"""Saves what was learned from a log to one model file (``gpmpc.gp.storage``), and loads it."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc.exceptions import DataError, SettingError
from gpmpc.files import existing_file, new_file
from gpmpc.gp.storage import posterior_of_parts, posterior_parts, read_model, write_model
from gpmpc.logs._fitting import NominalFit
from gpmpc.logs._kinematics import Increments, Kinematics, RigidBody
from gpmpc.logs._learning import Candidate, Learned
from gpmpc.logs._noise import OutputNoise
from gpmpc.logs._nominal import AffineNominal, MultirotorNominal, Nominal, Still
from gpmpc.logs._rollouts import LogModel, OutputGP
from gpmpc.logs._state_space import StateGroup, StateSpace

KIND = "LogModel"
_NAMES = ("state_names", "input_names", "context_names", "runs")
_NOISE = ("outputs", "measurement")


def save_learned(learned: Learned, path: str | Path) -> None:
    """Writes what was learned, in one piece or not at all.

    Raises:
        SettingError: The nominal model is a user's own, which a file of numbers cannot hold.
        DataError: The folder does not exist.
    """
    path, model, nominal = new_file(path), learned.model, learned.model.nominal
    if not isinstance(nominal, MultirotorNominal | AffineNominal | Still):
        raise SettingError("nominal", f"only models of gpmpc.logs can be saved; got {type(nominal).__name__}")
    gps = [posterior_parts(path, gp.posterior) for gp in model.gps]
    header = {
        "groups": [asdict(group) for group in model.kinematics.space.groups],
        "kinematics": type(model.kinematics).__name__,
        "nominal": [type(nominal).__name__, {k: v for k, v in vars(nominal).items() if isinstance(v, int | float)}],
        "history": model.history,
        "lag": model.lag,
        "gps": [[gp.outputs, described] for gp, (described, _) in zip(model.gps, gps, strict=True)],
        "fit": [learned.fit.cost, learned.fit.start_cost, learned.fit.evaluations],
        "candidates": [[c.name, c.errors.tolist(), c.chosen] for c in learned.candidates],
        "names": [getattr(learned, key) for key in _NAMES],
        "rows": learned.rows,
        "time_step": learned.time_step,
    }
    arrays = {"theta": model.theta, "standard_errors": learned.fit.standard_errors, "ranges": learned.ranges}
    arrays |= {f"noise/{key}": getattr(learned.noise, key) for key in _NOISE}
    tensors = {key: torch.from_numpy(value) for key, value in arrays.items()}
    tensors |= {f"gp{i}/{key}": value for i, (_, own) in enumerate(gps) for key, value in own.items()}
    write_model(path, KIND, header, tensors)


def load_learned(path: str | Path) -> Learned:
    """Reads a file of ``save_learned``.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format.
    """
    path = existing_file(path, "what gpmpc learn saved")
    header, tensors = read_model(path, KIND)
    try:
        return _learned(path, header, tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: not a readable {KIND} ({error})") from error


def _learned(path: Path, header: dict[str, Any], tensors: dict[str, Tensor]) -> Learned:
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
    for i, (outputs, described) in enumerate(header["gps"]):
        own = {key.removeprefix(f"gp{i}/"): value for key, value in tensors.items() if key.startswith(f"gp{i}/")}
        gps.append(OutputGP(tuple(outputs), posterior_of_parts(path, described, own)))
    arrays = {key: value.numpy() for key, value in tensors.items()}
    model = LogModel(kinematics, nominal, arrays["theta"], tuple(header["history"]), header["lag"], tuple(gps))
    return Learned(
        model=model,
        noise=OutputNoise(*(arrays[f"noise/{key}"] for key in _NOISE)),
        fit=NominalFit(model, arrays["standard_errors"], *header["fit"]),
        candidates=tuple(Candidate(name, np.array(errors), chosen) for name, errors, chosen in header["candidates"]),
        ranges=arrays["ranges"],
        rows=header["rows"],
        time_step=header["time_step"],
        **{key: tuple(names) for key, names in zip(_NAMES, header["names"], strict=True)},
    )
