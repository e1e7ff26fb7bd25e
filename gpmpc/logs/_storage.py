"""Saves what was learned from a log to one model file (``gpmpc.gp._storage``), loads it, and flies it.

What was learned from a log moves states by its kinematics: x[k+1] = step(x[k], y(x[k], u[k])). As a ``DynamicsModel``
its derivatives are central differences, all stages in one batch; the disturbance from the past is left to the
controller's own estimate.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import full_turns
from gpmpc._dynamics import DynamicsModel, Linearized, check_query, to_array
from gpmpc._files import existing_file, new_file
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import load_metadata
from gpmpc.gp._storage import (
    posterior_of_parts,
    posterior_parts,
    read_model,
    write_model,
)
from gpmpc.logs._fitting import NominalFit, OutputNoise
from gpmpc.logs._kinematics import (
    Array,
    Increments,
    RigidBody,
    StateGroup,
    StateSpace,
)
from gpmpc.logs._learning import Candidate, Learned
from gpmpc.logs._rollouts import AffineNominal, LogModel, MultirotorNominal, OutputGP
from gpmpc.models import load_model
from gpmpc.signals import UNKNOWN, Signals, signals_of
from gpmpc.systems import System

KIND = "LogModel"
_TEXTS = ("state_names", "input_names", "context_names", "runs")
_NOISE = ("outputs", "measurement")
DIFFERENCE = 1e-5  # of central differences, relative to entries above one


def save_learned(learned: Learned, path: str | Path) -> None:
    """Writes what was learned, in one piece or not at all.

    Raises:
        SettingError: The nominal model is a user's own, which a file of numbers cannot hold.
        DataError: The folder does not exist.
    """
    path, model, nominal = new_file(path), learned.model, learned.model.nominal
    if not isinstance(nominal, MultirotorNominal | AffineNominal):
        raise SettingError(
            "nominal",
            f"only models of gpmpc.logs can be saved; got {type(nominal).__name__}",
        )
    arrays = {
        "theta": model.theta,
        "standard_errors": learned.fit.standard_errors,
        "ranges": learned.ranges,
    }
    arrays |= {f"noise/{key}": getattr(learned.noise, key) for key in _NOISE}
    tensors, gps = {key: torch.from_numpy(value) for key, value in arrays.items()}, []
    for i, gp in enumerate(model.gps):
        described, own = posterior_parts(path, gp.posterior)
        gps.append([gp.outputs, described])
        tensors |= {f"gp{i}/{key}": value for key, value in own.items()}
    header = {
        "groups": [asdict(group) for group in model.kinematics.space.groups],
        "kinematics": type(model.kinematics).__name__,
        "nominal": [
            type(nominal).__name__,
            {k: v for k, v in vars(nominal).items() if isinstance(v, int | float)},
        ],
        "history": model.history,
        "lag": model.lag,
        "gps": gps,
        "candidates": [
            [c.name, c.errors.tolist(), c.chosen] for c in learned.candidates
        ],
        "names": [getattr(learned, key) for key in _TEXTS],
        "time_step": learned.time_step,
    }
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
    space = StateSpace(
        tuple(
            StateGroup(**g | {"entries": tuple(g["entries"])}) for g in header["groups"]
        )
    )
    kinematics = (
        RigidBody(space) if header["kinematics"] == "RigidBody" else Increments(space)
    )
    name, settings = header["nominal"]
    if name == "MultirotorNominal":
        nominal = MultirotorNominal(**settings)
    else:  # older files have a Still
        nominal = AffineNominal(kinematics, settings.get("fitted", name != "Still"))
    gps = []
    for i, (outputs, described) in enumerate(header["gps"]):
        own = {
            key.removeprefix(f"gp{i}/"): value
            for key, value in tensors.items()
            if key.startswith(f"gp{i}/")
        }
        gps.append(OutputGP(tuple(outputs), posterior_of_parts(path, described, own)))
    arrays = {key: value.numpy() for key, value in tensors.items()}
    model = LogModel(
        kinematics,
        nominal,
        arrays["theta"],
        tuple(header["history"]),
        header["lag"],
        tuple(gps),
    )
    return Learned(
        model=model,
        noise=OutputNoise(*(arrays[f"noise/{key}"] for key in _NOISE)),
        fit=NominalFit(model, arrays["standard_errors"]),
        candidates=tuple(
            Candidate(name, np.array(errors), chosen)
            for name, errors, chosen in header["candidates"]
        ),
        ranges=arrays["ranges"],
        time_step=header["time_step"],
        **{
            key: tuple(names)
            for key, names in zip(_TEXTS, header["names"], strict=True)
        },
    )


@dataclass(frozen=True)
class LogDynamics:
    """A model of a log as one of the next state.

    Raises:
        SettingError: Its inputs act late, or it has a term of the controller that flew.
    """

    model: LogModel  #: without context
    input_dim: int  #: number of inputs, m
    time_step: float  #: [s]
    noise: OutputNoise | None = None  #: of its outputs; none by default
    signals: Signals = UNKNOWN  #: names and time step, where they are known
    dtype, device = torch.float64, torch.device("cpu")

    def __post_init__(self) -> None:
        late = (
            f"has inputs that act {self.model.lag} rows late" if self.model.lag else ""
        )
        if late or getattr(self.model.nominal, "feedback", False):
            what = late or "holds the feedback of the controller that flew"
            raise SettingError(
                "model",
                f"{what}, which no controller can plan with: gpmpc learn --for-control",
            )

    @property
    def state_dim(self) -> int:
        """Number of states, n; four of an attitude."""
        return self.model.kinematics.space.dim

    output_dim = state_dim

    @property
    def angles(self) -> tuple[int, ...]:
        """Indices of the states that are angles."""
        return self.model.kinematics.space.angles

    @property
    def noise_covariance(self) -> Tensor:
        """Of the next state, where all states are zero and nothing is turned (n, n)."""
        return self._noise

    @cached_property
    def _noise(self) -> Tensor:
        space, noise, n = self.model.kinematics.space, self.noise, self.state_dim
        if noise is None:
            return torch.zeros(n, n, dtype=torch.float64)
        x = np.zeros((1, n))
        for group, at in zip(space.groups, space.columns, strict=True):
            x[0, at.stop - 1] = group.kind == "quaternion"
        h = DIFFERENCE * np.eye(space.error_dim)
        B = self._by_outputs(x, np.zeros((1, noise.outputs.shape[1])))[0]
        D = (space.displace(x, h) - space.displace(x, -h)).T / (2 * DIFFERENCE)
        N = B * noise.outputs.sum(axis=0) @ B.T + D * noise.measurement @ D.T
        return torch.from_numpy((N + N.T) / 2)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution: mean (*batch, n), covariance (*batch, n, n)."""
        check_query(self, state, input)
        n, batch = self.state_dim, state.shape[:-1]
        x, u = (
            to_array(state).reshape(-1, n),
            to_array(input).reshape(-1, self.input_dim),
        )
        mean, covariance = self._mean(x, u), self._covariance(x, u)
        mean, covariance = (
            torch.from_numpy(a).reshape(*batch, *a.shape[1:])
            for a in (mean, covariance)
        )
        return Gaussian(mean, covariance)

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises at K points (K, n), (K, m) by central differences, all of them at once."""
        n, z = self.state_dim, np.concatenate([states, inputs], axis=1)
        h = DIFFERENCE * np.maximum(np.abs(z), 1.0)
        moved = (
            z + np.concatenate([np.eye(z.shape[1]), -np.eye(z.shape[1])])[:, None] * h
        )
        values = self._mean(
            *np.split(moved.reshape(-1, z.shape[1]), [n], axis=1)
        ).reshape(2, -1, *states.shape)
        J = np.moveaxis((values[0] - values[1]) / (2 * h.T[..., None]), 0, -1)
        A, B = (np.ascontiguousarray(part) for part in np.split(J, [n], axis=2))
        return Linearized(
            self._mean(states, inputs),
            A,
            B,
            self._covariance(states, inputs) if covariance else None,
        )

    def _mean(self, x: Array, u: Array) -> Array:
        model = self.model
        after = model.kinematics.step(
            x, model.outputs(x, u, np.empty((len(x), 0))), self.time_step
        )
        # Kinematics wrap angles; a plan counts their turns.
        return after + full_turns(x - after, self.angles)

    def _covariance(self, x: Array, u: Array) -> Array:
        model, nothing, K = self.model, np.empty((len(x), 0)), len(x)
        if not model.gps:
            return np.zeros((K, self.state_dim, self.state_dim))
        z, y = (
            np.ascontiguousarray(model.kinematics.features(x, u, nothing)),
            model.outputs(x, u, nothing),
        )
        V = np.zeros((K, y.shape[1], y.shape[1]))
        for gp in model.gps:
            learned: Any = gp.posterior.linearize(z, nothing, True).covariance
            V[np.ix_(range(K), gp.outputs, gp.outputs)] += learned
        B = self._by_outputs(x, y)
        return B @ V @ B.mT

    def _by_outputs(self, x: Array, y: Array) -> Array:
        """Derivatives of the next states by the outputs (K, n, o)."""
        step, dt = self.model.kinematics.step, self.time_step
        columns = [
            step(x, y + h, dt) - step(x, y - h, dt)
            for h in DIFFERENCE * np.eye(y.shape[1])
        ]
        return np.stack(columns, axis=-1) / (2 * DIFFERENCE)


@dataclass(frozen=True)
class SavedModel:
    """A model from a file, with what the file says of it."""

    path: str  #: of the file
    model: DynamicsModel  #: trained
    signals: Signals = UNKNOWN  #: names and time step, where the file has them

    def check(self, system: System) -> None:
        """Raises ``SettingError`` unless states, inputs and time step are a system's."""
        for key, dim, own, wanted in (
            (
                "states",
                self.model.state_dim,
                self.signals.state_names,
                system.state_names,
            ),
            (
                "inputs",
                self.model.input_dim,
                self.signals.input_names,
                system.input_names,
            ),
        ):
            if dim != len(wanted):
                found = f"the {key} {', '.join(own) or dim}"
                has = f"{system.name} has {', '.join(wanted)}"
                raise SettingError("model", f"{self.path} has {found}; {has}")
        self.signals.check(self.path, system.signals, system.name, "model")


def load_flyable(path: str | Path) -> SavedModel:
    """Reads a file of ``gpmpc learn`` or of ``save_model``.

    Raises:
        DataError: The file is missing, damaged or of another kind.
        SettingError: What is in it cannot be flown.
    """
    header = load_metadata(path)
    if header.get("kind") == KIND:
        learned = load_learned(path)
        if learned.context_names:
            context = ", ".join(learned.context_names)
            raise SettingError(
                "model",
                f"{path} needs a context ({context}), which is not known in flight",
            )
        signals = Signals(learned.state_names, learned.input_names, learned.time_step)
        flown = LogDynamics(
            learned.model,
            len(learned.input_names),
            learned.time_step,
            learned.noise,
            signals,
        )
        return SavedModel(str(path), flown, signals)
    model = load_model(path)
    signals = signals_of(model)
    said = header.get("metadata")  # where names stood before models carried them
    if signals == UNKNOWN and isinstance(said, dict):
        signals = Signals(
            said.get("states") or (), said.get("inputs") or (), said.get("time_step")
        )
    return SavedModel(str(path), model, signals)
