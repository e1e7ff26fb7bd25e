"""Structures of models of logs, from the simplest one on.

A structure is a nominal model with its history and lag, grown by one addition after the
other, and GPs on groups of outputs.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._fitting import PAST
from gpmpc.logs._log import Log
from gpmpc.models._kinematics import Increments, RigidBodyKinematics
from gpmpc.models._log_model import LogModel
from gpmpc.models._parametric import AffineNominal, MultirotorNominal

LATE = 3  # rows by which motors may act late


@dataclass(frozen=True)
class Candidate:
    """A model structure and the errors of its rollouts on held-out runs."""

    name: str  #: of the structure
    errors: Array  #: mean Euclidean or geodesic error (steps, groups)
    chosen: bool = False  #: whether it is the best one


@dataclass(frozen=True)
class Addition:
    """Something that a structure may have besides."""

    key: str  #: in the memory of a search
    words: str  #: in the names of candidates
    #: adds it to a model; returns None where it makes no sense
    extend: Callable[[LogModel], LogModel | None]
    for_control: bool = True  #: whether a controller can plan with it


class GroupGP(NamedTuple):
    """A GP on a group of outputs."""

    group: str
    rows: int  # over which its targets are averaged


@dataclass(frozen=True)
class Structure:
    """A model without the values of its parameters."""

    base: str  #: the simplest structure, such as "rigid body"
    model: LogModel  #: nominal part, history and lag
    additions: tuple[Addition, ...] = ()
    gps: tuple[GroupGP, ...] = ()

    @property
    def name(self) -> str:
        """The structure in words."""
        parts = [self.base, *(addition.words for addition in self.additions)]
        if self.gps:
            gps = [f"{gp.group} (averaged over {gp.rows})" for gp in self.gps]
            parts.append(f"GP on {' and '.join(gps)}")
        return ", ".join(parts)

    @property
    def key(self) -> str:
        """The structure in the memory of a search."""
        parts = [self.base, *(addition.key for addition in self.additions)]
        parts += [f"gp:{gp.group}:{gp.rows}" for gp in self.gps]
        return "/".join(parts)

    def extended(self, addition: Addition) -> "Structure | None":
        """Returns the structure with an addition; None where that makes no sense."""
        model = addition.extend(self.model)
        if model is None:
            return None
        return replace(self, model=model, additions=(*self.additions, addition))

    def with_gp(self, gp: GroupGP) -> "Structure":
        """Returns the structure with a GP on a group; it replaces an earlier one."""
        others = [other for other in self.gps if other.group != gp.group]
        return replace(self, gps=(*others, gp))


def simplest_structure(log: Log) -> Structure:
    """Returns the simplest structure of a log's model."""
    if log.mapping.model == "rigid_body":
        nominal = MultirotorNominal(
            motors=len(log.input_names),
            voltage=_median_voltage(log),
            thrusts=all(signal.unit == "N" for signal in log.mapping.of("inputs")),
        )
        model = LogModel(
            kinematics=RigidBodyKinematics(log.space),
            nominal=nominal,
            theta=np.empty(0),
            history=(0,) * 6,
        )
        return Structure("rigid body", model)
    increments = Increments(log.space)
    model = LogModel(
        kinematics=increments,
        nominal=AffineNominal(increments, fitted=False),
        theta=np.empty(0),
        history=(0,) * log.space.error_dim,
    )
    return Structure("increments", model)


def additions(log: Log) -> tuple[Addition, ...]:
    """Returns what a structure may have besides, in the order in which it is tried."""
    if log.mapping.model == "rigid_body":
        return _RIGID_BODY_ADDITIONS
    return _INCREMENT_ADDITIONS


def _median_voltage(log: Log) -> float:
    """Returns the median of a voltage in the context [V]; zero where there is none."""
    signals = log.mapping.of("context")
    if not signals or signals[0].unit not in ("V", "mV"):
        return 0.0
    return float(np.median(np.concatenate([run.context[:, 0] for run in log])))


def _with_affine_nominal(model: LogModel) -> LogModel:
    return replace(model, nominal=AffineNominal(model.kinematics))


def _with_disturbance(model: LogModel) -> LogModel:
    return replace(model, history=(PAST,) * len(model.history))


_INCREMENT_ADDITIONS = (
    Addition("least_squares", "least squares", _with_affine_nominal),
    Addition("disturbance", "disturbance", _with_disturbance),
)


def _with_force_disturbance(model: LogModel) -> LogModel:
    return replace(model, history=(PAST,) * 3 + (0,) * 3)


def _with_motor_torque(model: LogModel) -> LogModel:
    return replace(model, nominal=replace(_multirotor(model), torque=True))


def _with_feedback(model: LogModel) -> LogModel:
    return replace(model, nominal=replace(_multirotor(model), feedback=True))


def _with_late_inputs(model: LogModel) -> LogModel | None:
    if not _multirotor(model).torque:
        return None
    return replace(model, lag=LATE)


def _with_torque_disturbance(model: LogModel) -> LogModel | None:
    if not _multirotor(model).torque:
        return None
    return replace(model, history=model.history[:3] + (PAST,) * 3)


def _multirotor(model: LogModel) -> MultirotorNominal:
    assert isinstance(model.nominal, MultirotorNominal)
    return model.nominal


_RIGID_BODY_ADDITIONS = (
    Addition("force_disturbance", "force disturbance", _with_force_disturbance),
    Addition("motor_torque", "motor torque", _with_motor_torque),
    Addition("feedback", "feedback", _with_feedback, for_control=False),
    Addition("lag", f"inputs {LATE} rows late", _with_late_inputs, for_control=False),
    Addition("torque_disturbance", "torque disturbance", _with_torque_disturbance),
)
