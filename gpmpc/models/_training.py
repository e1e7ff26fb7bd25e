"""Training of a model of a system, with all that the system's description says of it.

What is known is not learned: angles are periodic, positions are integrated from their
rates, a nominal model is right but for what it misses. One place for Python and the
command line.
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, ShapeError, check_choice, check_kind
from gpmpc.gp import Trainer, Training, Transitions, standardize
from gpmpc.gp._transitions import check_rows_on_host
from gpmpc.models._features import Features
from gpmpc.models._kinematic_rates import (
    KinematicResidual,
    kinematic_residual,
    positions_by_rate,
)
from gpmpc.models._residual import train_residual
from gpmpc.models._residual_data import Nominal
from gpmpc.systems import System

_log = logging.getLogger(__name__)

KinematicsChoice = Literal["integrated", "learned"]
KINEMATICS = ("integrated", "learned")


@explains_arguments
def train(
    transitions: Transitions,
    system: System | None = None,
    *,
    trainer: Callable[..., Training] | None = None,
    kinematics: KinematicsChoice = "integrated",
    seed: int = 0,
    **settings: Any,
) -> Training:
    """Trains a model of dynamics on transitions, by what a system's description says.

    With a ``system`` the GPs learn what a step changes, in standardised units: its
    ``angles`` enter as sine and cosine and may wrap in the data, states that have
    ``rates`` are integrated from these, of its ``nominal`` model they learn what that
    one misses, and the model carries its names and time step.

    Without one the states are numbers, and one GP for each learns the next state
    (``Trainer``).

    Args:
        transitions: The data.
        system: What they were recorded of. Its dynamics are not used.
        trainer: A ``Trainer`` or ``SparseTrainer``; by default a ``Trainer`` of
            ``settings`` with ``scaling=standardize``. One that was told to predict
            ``"next_state"`` learns the states as they stand, without angles, rates and
            nominal model.
        kinematics: ``"integrated"``, or ``"learned"`` like all other states.
        seed: Of the training's random numbers.
        settings: Of a ``Trainer``, such as ``restarts=1``.

    Returns:
        The training, whose ``posterior`` is the model.

    Raises:
        SettingError: Trainer and settings are both given, a setting is unknown or out
            of range, names or time step of data and system differ, or the data are not
            in host memory.
        ShapeError: Data and system have other dimensions.
        TrainingError: An output could not be trained.

    >>> from gpmpc.datasets import RandomData
    >>> from gpmpc.systems import pendulum
    >>> data = RandomData(samples=30).transitions(pendulum())
    >>> model = train(data, system=pendulum()).posterior
    >>> model.signals.state_names, model.angles
    (('angle', 'rate'), [0])
    """
    check_rows_on_host(transitions)
    check_choice("kinematics", kinematics, KINEMATICS)
    if trainer is not None and settings:
        raise SettingError(
            ", ".join(settings), "are settings of a Trainer: give them to `trainer`"
        )
    if trainer is not None:
        _check_trainer(trainer)
    if system is None:
        trainer = trainer or Trainer(**settings)
        return trainer(transitions, seed=seed)
    example = "a System, such as System(Pendulum(), time_step=0.05)"
    check_kind("system", system, System, example)
    transitions = _named(transitions, system)
    if trainer is None:
        settings.setdefault("scaling", standardize)
        trainer = Trainer(**settings)
    if getattr(trainer, "predicts", "next_state") is None:
        trainer = replace(cast(Any, trainer), predicts="difference")
    return _train_on_system(transitions, system, trainer, kinematics, seed)


def _check_trainer(trainer: Any) -> None:
    """Raises ``SettingError`` unless it is an object that trains."""
    if isinstance(trainer, type) or not callable(trainer):
        got = trainer.__name__ if isinstance(trainer, type) else repr(trainer)
        raise SettingError("trainer", f"must be Trainer(...); got {got}")


def _named(transitions: Transitions, system: System) -> Transitions:
    """Returns the transitions with the names and the time step of their system."""
    n = len(system.state_names)
    m = len(system.input_names)
    got = (transitions.state_dim, transitions.input_dim)
    if got != (n, m):
        raise ShapeError(
            f"data of {system.name} must have its {n} states and {m} inputs; "
            f"got {got[0]} and {got[1]}"
        )
    transitions.signals.check("the data", system.signals, system.name)
    return replace(transitions, signals=system.signals)


def _train_on_system(
    transitions: Transitions,
    system: System,
    trainer: Any,
    kinematics: KinematicsChoice,
    seed: int,
) -> Training:
    """Trains on transitions of a system; see ``train``."""
    predicts_difference = getattr(trainer, "predicts", None) == "difference"
    integrates = kinematics == "integrated" and bool(system.rates)
    has_structure = integrates or system.angles or system.nominal is not None
    learns_residual = predicts_difference and bool(has_structure)
    if getattr(trainer, "prior_lengthscale", 1.0) is None:
        lengthscales = _prior_lengthscales(system, learns_residual)
        trainer = replace(trainer, prior_lengthscale=lengthscales)
    if not learns_residual:
        if system.nominal is not None:
            _log.warning(
                "training: the nominal model of %s is not used, since the trainer "
                "does not predict differences; predicts='difference' learns what it "
                "misses",
                system.name,
            )
        return trainer(transitions, seed=seed)
    nominal = _nominal_of(system)
    if not integrates:
        return train_residual(
            trainer=trainer,
            transitions=transitions,
            angles=system.angle_indices,
            nominal=nominal,
            seed=seed,
        )
    kinematic = _kinematics_of(system, transitions, nominal)
    return train_residual(
        trainer=trainer,
        transitions=transitions,
        angles=system.angle_indices,
        nominal=kinematic.nominal,
        seed=seed,
        B=kinematic.B,
        further_noise=kinematic.noise,
    )


def _nominal_of(system: System) -> Nominal | None:
    """Returns what is known of a system before anything is learned."""
    if system.nominal is None:
        return None
    from gpmpc.gp.casadi_ import successor_function  # loads CasADi
    from gpmpc.models._casadi_function import CasadiFunction

    return CasadiFunction(successor_function(system.nominal))


def _kinematics_of(
    system: System, transitions: Transitions, nominal: Nominal | None
) -> KinematicResidual:
    """Finds how the positions of a system follow from their rates."""
    n = transitions.state_dim
    m = transitions.input_dim
    return kinematic_residual(
        rates=positions_by_rate(system.rates, system.state_names),
        features=Features(
            states=list(range(n)),
            inputs=list(range(m)),
            angles=system.angle_indices,
            state_dim=n,
            input_dim=m,
        ),
        nominal=nominal,
        states=transitions.states,
        inputs=transitions.inputs,
        next_states=transitions.next_states,
        time_step=system.time_step,
    )


def _prior_lengthscales(system: System, sine_and_cosine: bool) -> list[float]:
    """Returns the lengthscales that a GP supposes of constant columns.

    One unit, or a tenth of the range of the limits, whichever is less: from one limit
    to the other predictions forget what they know. More would do harm where limits are
    wide: on its way back to the prior a mean has a slope that nobody has seen, and a
    controller follows it.

    Args:
        system: Whose states and inputs the GP sees.
        sine_and_cosine: Whether it sees angles as sine and cosine, each of one unit.
    """
    unlimited = np.full(len(system.state_names), np.inf)
    lower, upper = system.region or (-unlimited, unlimited)
    ranges = np.subtract((*upper, *system.input_upper), (*lower, *system.input_lower))
    lengthscales = []
    for i, width in enumerate(ranges.tolist()):
        if sine_and_cosine and i in system.angle_indices:
            lengthscales += [1.0, 1.0]
        elif width > 0:
            lengthscales.append(min(1.0, width / 10))
        else:
            lengthscales.append(1.0)
    return lengthscales
