"""Models of logs with numbers that a test chooses: nothing is read or learned."""

import numpy as np
import torch

from gpmpc.logs import IdentifiedModel
from gpmpc.logs._fitting import NominalFit
from gpmpc.logs._structures import Candidate
from gpmpc.models import LogDynamics, LogModel, MultirotorNominal, RigidBodyKinematics
from gpmpc.models._kinematics import Increments
from gpmpc.models._log_dynamics import TIME_CONSTANTS, OutputNoise, TubeNoise
from gpmpc.models._log_model import OutputGP
from gpmpc.models._memory import Memory
from gpmpc.models._parametric import AffineNominal
from gpmpc.models._state_space import StateGroup, StateSpace
from tests.gp.small_models import posterior

F = torch.float64


def affine_dynamics(names, theta, time_step, noise=0.0, rows_back=0, inputs=1, **parts):
    """A model whose states change by an affine function of states and inputs.

    Args:
        names: Of the states.
        theta: Of each state a row: its slopes by states and inputs, and a constant.
        time_step: [s]
        noise: Variance of what is measured of a state.
        rows_back: How many rows before the last one the ``weights`` are for.
        inputs: How many there are.
        parts: Of the ``LogModel``.
    """
    kinematics = Increments(StateSpace(tuple(StateGroup(n, (n,)) for n in names)))
    if rows_back:
        parts["memory"] = Memory(rows=rows_back)
    model = LogModel(
        kinematics=kinematics,
        nominal=AffineNominal(kinematics),
        theta=np.array(theta).ravel(),
        history=(0,) * len(names),
        **parts,
    )
    none = np.zeros((len(TIME_CONSTANTS), len(names)))
    variances = OutputNoise(none, np.full(len(names), noise))
    return LogDynamics(model, inputs, time_step, variances)


def learned(kinematics, nominal, inputs, parameters, features):
    """What a log could have taught, with a GP on the last output."""
    space = kinematics.space
    outputs = len(kinematics.output_names)
    gp = posterior(n=1, m=features - 1, predicts="value")
    gp = type(gp).from_hyperparameters(
        gp.features,
        gp.targets,
        torch.ones(1, features, dtype=F),
        torch.ones(1, dtype=F),
        torch.ones(1, dtype=F),
        0,
        "value",
    )
    theta = np.full(parameters, 0.1)
    model = LogModel(
        kinematics, nominal, theta, (20,) * outputs, 0, (OutputGP((outputs - 1,), gp),)
    )
    names = tuple(f"u{i}" for i in range(inputs))
    return IdentifiedModel(
        model=model,
        noise=OutputNoise(
            np.full((len(TIME_CONSTANTS), outputs), 0.1),
            np.full(space.error_dim, 0.01),
            (1, 10),
            np.full((2, space.error_dim), 1.1),
            tube=TubeNoise(np.full(outputs, 0.2), np.full(space.error_dim, 0.03)),
        ),
        fit=NominalFit(model, np.full(parameters, 0.2)),
        candidates=(Candidate("one", np.ones((2, 2)), True),),
        ranges=np.zeros((2, space.dim + inputs)),
        runs=("run 1",),
        state_names=space.names,
        input_names=names,
        context_names=(),
        time_step=0.02,
    )


def of_a_pendulum_log():
    groups = (
        StateGroup("angle", ("angle",), "rad", "angle"),
        StateGroup("rate", ("rate",)),
    )
    kinematics = Increments(StateSpace(groups))
    return learned(kinematics, AffineNominal(kinematics), 1, 2 * 5, 4)


def of_a_quadrotor_log():
    space = StateSpace(
        (
            StateGroup("position", ("x", "y", "z")),
            StateGroup("attitude", ("qx", "qy", "qz", "qw"), kind="quaternion"),
            StateGroup("velocity", ("vx", "vy", "vz")),
            StateGroup("rate", ("p", "q", "r")),
        )
    )
    return learned(
        RigidBodyKinematics(space), MultirotorNominal(4, torque=True), 4, 18, 12
    )
