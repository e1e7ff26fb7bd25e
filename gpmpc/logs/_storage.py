"""Saves what was learned from a log to one model file (``gpmpc.gp._storage``), loads it, and flies it.

What was learned from a log moves states by its kinematics: x[k+1] = step(x[k], y(x[k], u[k])). As a ``DynamicsModel``
its derivatives are central differences, all stages in one batch; the disturbance from the past is left to the
controller's own estimate.
"""

from collections.abc import Sequence
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
from gpmpc._trust import trusted_packages
from gpmpc.exceptions import DataError, SettingError, check_choice, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import load_metadata
from gpmpc.gp._storage import (
    consistent,
    posterior_of_parts,
    posterior_parts,
    read_model,
    write_model,
)
from gpmpc.logs._fitting import TIME_CONSTANTS, NominalFit, OutputNoise
from gpmpc.logs._kinematics import (
    Array,
    Increments,
    Kinematics,
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
_LONGEST = 10_000  # rows that a model from a file looks back
_SLOWEST = 1e9  # time step of a model from a file [s]
_MOST = 2048  # states, inputs or context of a model from a file
DIFFERENCE = 1e-5  # of central differences, relative to entries above one


def save_learned(learned: Learned, path: str | Path) -> None:
    """Writes what was learned, in one piece or not at all.

    Raises:
        SettingError: The nominal model is a user's own, which a file of numbers cannot hold.
        DataError: The folder does not exist.
    """
    path = new_file(path)
    model = learned.model
    nominal = learned.model.nominal
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
    tensors = {key: torch.from_numpy(value) for key, value in arrays.items()}
    gps = []
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
    with consistent(path, f"not a readable {KIND}"):
        return _learned(path, header, tensors)


def _learned(path: Path, header: dict[str, Any], tensors: dict[str, Tensor]) -> Learned:
    texts = {
        key: _words(key, names)
        for key, names in zip(_TEXTS, header["names"], strict=True)
    }
    space = _space(header["groups"])
    kinematics = _kinematics(header["kinematics"], space)
    arrays = {key: value.numpy() for key, value in tensors.items()}
    features = kinematics.features(
        _resting(space),
        np.zeros((1, len(texts["input_names"]))),
        np.zeros((1, len(texts["context_names"]))),
    ).shape[1]
    model = LogModel(
        kinematics,
        _nominal(header["nominal"], kinematics, texts),
        arrays["theta"],
        tuple(header["history"]),
        header["lag"],
        tuple(
            _output_gp(path, f"gp{i}/", outputs, described, tensors, features)
            for i, (outputs, described) in enumerate(header["gps"])
        ),
    )
    learned = Learned(
        model=model,
        noise=OutputNoise(*(arrays[f"noise/{key}"] for key in _NOISE)),
        fit=NominalFit(model, arrays["standard_errors"]),
        candidates=tuple(
            Candidate(str(name), np.array(errors, dtype=float), bool(chosen))
            for name, errors, chosen in header["candidates"]
        ),
        ranges=arrays["ranges"],
        time_step=header["time_step"],
        **texts,
    )
    _check_learned(learned, features)
    return learned


def _words(key: str, names: Any) -> tuple[str, ...]:
    """A list of texts; ``DataError`` of anything else."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DataError(f"{key} must be a list of texts; got {names!r:.80}")
    return tuple(names)


def _space(described: Any) -> StateSpace:
    groups = []
    for group in described:
        entries = _words("entries", group["entries"])
        groups.append(StateGroup(**group | {"entries": entries}))
        check_choice("kind", groups[-1].kind, ("vector", "angle", "quaternion"))
        if not entries or (groups[-1].kind == "quaternion" and len(entries) != 4):
            raise DataError(f"a {groups[-1].kind} cannot have {len(entries)} entries")
    return StateSpace(tuple(groups))


def _kinematics(name: str, space: StateSpace) -> Kinematics:
    if name != "RigidBody":
        return Increments(space)
    parts = [(group.kind, len(group.entries)) for group in space.groups]
    vector = ("vector", 3)
    if parts != [vector, ("quaternion", 4), vector, vector]:
        raise DataError("a rigid body has position, attitude, velocity and rate")
    return RigidBody(space)


def _resting(space: StateSpace) -> Array:
    """A state (1, n) of zeros, in which nothing is turned."""
    x = np.zeros((1, space.dim))
    for group, at in zip(space.groups, space.columns, strict=True):
        x[0, at.stop - 1] = group.kind == "quaternion"
    return x


def _nominal(
    described: Any, kinematics: Kinematics, texts: dict[str, tuple[str, ...]]
) -> MultirotorNominal | AffineNominal:
    name, settings = described
    if name != "MultirotorNominal":  # older files have a Still
        return AffineNominal(kinematics, settings.get("fitted", name != "Still"))
    motors = settings["motors"]
    inputs = len(texts["input_names"])
    if type(motors) is not int or motors != inputs:
        raise DataError(f"a multirotor of {inputs} inputs has no {motors!r:.80} motors")
    voltage = settings.get("voltage", 0.0)
    check_number("voltage", voltage, least=0)
    if voltage and not texts["context_names"]:
        raise DataError("a multirotor whose voltage counts has it in its context")
    if not isinstance(kinematics, RigidBody):
        raise DataError("a multirotor is a rigid body")
    return MultirotorNominal(**settings)


def _output_gp(
    path: Path,
    prefix: str,
    outputs: Any,
    described: Any,
    tensors: dict[str, Tensor],
    features: int,
) -> OutputGP:
    own = {
        key.removeprefix(prefix): value
        for key, value in tensors.items()
        if key.startswith(prefix)
    }
    gp = OutputGP(tuple(outputs), posterior_of_parts(path, described, own))
    posterior = gp.posterior
    shape = posterior.state_dim, posterior.input_dim, posterior.output_dim
    if posterior.predicts != "value" or shape != (features, 0, len(gp.outputs)):
        raise DataError(f"a GP must predict {outputs!r:.80} of {features} features")
    return gp


def _check_learned(learned: Learned, features: int) -> None:
    """Raises unless everything that was read belongs together."""
    model = learned.model
    noise = learned.noise
    outputs = len(model.kinematics.output_names)
    n = model.kinematics.space.dim
    e = model.kinematics.space.error_dim
    if max(n, len(learned.input_names), len(learned.context_names)) > _MOST:
        raise DataError(f"the model has more than {_MOST} states or inputs")
    check_number("time_step", learned.time_step, above=0, unit="[s]")
    if learned.time_step > _SLOWEST:
        raise DataError(f"time_step must be {_SLOWEST:g} s at most")
    for key, rows in (("lag", model.lag), *(("history", h) for h in model.history)):
        check_number(key, rows, least=0, whole=True, unit="[rows]")
        if rows > _LONGEST:
            raise DataError(f"{key} must be {_LONGEST} rows at most; got {rows}")
    if isinstance(model.nominal, AffineNominal):
        parameters = outputs * (features + 1) if model.nominal.fitted else None
    else:
        parameters = len(model.nominal.parameter_names)
    shapes = {
        "theta": (model.theta, (parameters,)),
        "ranges": (learned.ranges, (2, n + len(learned.input_names))),
        "noise/outputs": (noise.outputs, (len(TIME_CONSTANTS), outputs)),
        "noise/measurement": (noise.measurement, (e,)),
    }
    for key, (array, shape) in shapes.items():
        if None not in shape and array.shape != shape:
            raise DataError(f"{key} must have shape {shape}; got {array.shape}")
    errors = learned.fit.standard_errors
    if errors.shape not in ((0,), model.theta.shape):  # a nameless parameter has none
        raise DataError(f"standard_errors are no theta's; got {errors.shape}")
    if not all(np.isfinite(a).all() for a in (model.theta, *vars(noise).values())):
        raise DataError("theta and noise must be finite")
    if len(learned.state_names) != n:
        raise DataError(f"must have {n} names of states; got {learned.state_names}")
    for gp in model.gps:
        in_range = all(type(i) is int and 0 <= i < outputs for i in gp.outputs)
        if not in_range or len(set(gp.outputs)) < len(gp.outputs):
            raise DataError(f"a GP must predict outputs; got {gp.outputs!r:.80}")


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
    dtype = torch.float64
    device = torch.device("cpu")

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
        space = self.model.kinematics.space
        noise = self.noise
        n = self.state_dim
        if noise is None:
            return torch.zeros(n, n, dtype=torch.float64)
        x = _resting(space)
        h = DIFFERENCE * np.eye(space.error_dim)
        B = self._by_outputs(x, np.zeros((1, noise.outputs.shape[1])))[0]
        D = (space.displace(x, h) - space.displace(x, -h)).T / (2 * DIFFERENCE)
        N = B * noise.outputs.sum(axis=0) @ B.T + D * noise.measurement @ D.T
        return torch.from_numpy((N + N.T) / 2)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution: mean (*batch, n), covariance (*batch, n, n)."""
        check_query(self, state, input)
        n = self.state_dim
        batch = state.shape[:-1]
        x = to_array(state).reshape(-1, n)
        u = to_array(input).reshape(-1, self.input_dim)
        mean = self._mean(x, u)
        covariance = self._covariance(x, u)
        mean, covariance = (
            torch.from_numpy(a).reshape(*batch, *a.shape[1:])
            for a in (mean, covariance)
        )
        return Gaussian(mean, covariance)

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises at K points (K, n), (K, m) by central differences, all of them at once."""
        n = self.state_dim
        z = np.concatenate([states, inputs], axis=1)
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
        model = self.model
        nothing = np.empty((len(x), 0))
        K = len(x)
        if not model.gps:
            return np.zeros((K, self.state_dim, self.state_dim))
        z = np.ascontiguousarray(model.kinematics.features(x, u, nothing))
        y = model.outputs(x, u, nothing)
        V = np.zeros((K, y.shape[1], y.shape[1]))
        for gp in model.gps:
            learned: Any = gp.posterior.linearize(z, nothing, True).covariance
            V[np.ix_(range(K), gp.outputs, gp.outputs)] += learned
        B = self._by_outputs(x, y)
        return B @ V @ B.mT

    def _by_outputs(self, x: Array, y: Array) -> Array:
        """Derivatives of the next states by the outputs (K, n, o)."""
        step = self.model.kinematics.step
        dt = self.time_step
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


def load_flyable(path: str | Path, trusted: Sequence[str] | None = None) -> SavedModel:
    """Reads a file of ``gpmpc learn`` or of ``save_model``.

    Args:
        path: The file.
        trusted: Names of packages whose code the file may name; see ``load_model``.

    Raises:
        DataError: The file is missing, damaged or of another kind, or names code that
            is not trusted.
        SettingError: What is in it cannot be flown, or ``trusted`` is no list of names
            of packages.
    """
    packages = trusted_packages("model.trusted", trusted)
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
    model = load_model(path, packages)
    signals = signals_of(model)
    if signals == UNKNOWN:  # names stood in the metadata before models carried them
        with consistent(Path(path), "its metadata do not describe a model"):
            metadata = header.get("metadata") or {}
            signals = Signals(
                state_names=_words("states", metadata.get("states") or []),
                input_names=_words("inputs", metadata.get("inputs") or []),
                time_step=metadata.get("time_step"),
            )
    return SavedModel(str(path), model, signals)
