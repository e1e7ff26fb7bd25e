"""Models of dynamics: the protocol, and models of a known part and a learned one.

``train(rows, system=...)`` makes the model that a system's description allows.
``ResidualModel`` is made by hand of a nominal model and GPs. ``DelayedModel``,
``DisturbedModel`` and ``NoisyModel`` wrap any model; ``load_model`` reads what
``save_model`` wrote.

All models with a GP are one family: a nominal model, and GPs on what it leaves,

    y[k] = nominal(x[k], u[k]) + d(phi(x[k], u[k])),     x[k+1] = step(x[k], y[k]).

They differ in what y is. Of a ``ResidualModel`` it is the next state itself, and
derivatives are exact. Of a ``LogModel``, made for measured flights, it is outputs such
as accelerations, which kinematics turn into a movement; ``LogDynamics`` makes a
``DynamicsModel`` of it. All are rolled out by the recursion ``iterate`` of
``_roll_out`` or its compiled form. Wrappers add a delay or disturbances as states, and
are linear but for the model inside; or they add noise.

Nominal models are of three kinds: of a ``ResidualModel`` a function of tensors, from
state and input to next state (``_nominal``); of a ``LogModel`` a ``ParametricNominal``,
from parameters and arrays to outputs; and ``System.nominal`` is a ``System``, of which
``train`` makes the first kind.

A new structure has one of these places:

- a nominal model with parameters that are fitted, such as those of a ``System``: a
  ``ParametricNominal`` in ``_parametric``, which ``gpmpc.logs`` fits and compares;
- a model with a past, such as ARX: a state with earlier values in ``_lags``, or rows of
  ``Windows`` before the start, as ``LogModel.history`` and ``LogModel.lag`` read them;
  loops keep what its state holds beside what is measured by ``_past``;
- other movements of states by outputs: kinematics in ``_kinematics``;
- further states that are linear: a ``LinearWrapper``.
"""

from gpmpc._dynamics import DynamicsModel, Linearized, linearize, linearize_by_autograd
from gpmpc.models._casadi_function import CasadiFunction
from gpmpc.models._delayed import DelayedModel
from gpmpc.models._disturbed import DisturbedModel
from gpmpc.models._features import Features
from gpmpc.models._kinematics import RigidBodyKinematics
from gpmpc.models._lags import Lags
from gpmpc.models._log_dynamics import LogDynamics
from gpmpc.models._log_model import LogModel
from gpmpc.models._noisy import NoisyModel
from gpmpc.models._nominal import Affine, KnownModel
from gpmpc.models._parametric import MultirotorNominal
from gpmpc.models._residual import ResidualModel
from gpmpc.models._roll_out import RollOut
from gpmpc.models._storage import load_model, save_model
from gpmpc.models._training import train

__all__ = [
    "Affine",
    "CasadiFunction",
    "DelayedModel",
    "DisturbedModel",
    "DynamicsModel",
    "Features",
    "KnownModel",
    "Lags",
    "Linearized",
    "LogDynamics",
    "LogModel",
    "MultirotorNominal",
    "NoisyModel",
    "ResidualModel",
    "RigidBodyKinematics",
    "RollOut",
    "linearize",
    "linearize_by_autograd",
    "load_model",
    "save_model",
    "train",
]
