"""Flies an experiment: learns a model, makes the controller, closes the loop."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import Diverged, check_kind
from gpmpc.gp import Training
from gpmpc.learning import EpisodicLearning, LearningController, OnlineLearning
from gpmpc.metrics import _TrackingError, tracking_error
from gpmpc.mpc import Reference
from gpmpc.propagation import best_propagator
from gpmpc.simulation import ModelLoop, Rollout, Step, closed_loop, rehearse
from gpmpc.studies._experiment import Experiment
from gpmpc.studies._outlook import Outlook, outlook
from gpmpc.studies.study import derived_seed
from gpmpc.systems import System

#: called before each flight's first step with the controller and the training. The
#: flight flies inside of what it returns, which sees what ends it; its value is called
#: with every step
OpenRecording = Callable[
    [Any, Training | None], AbstractContextManager[Callable[[Step], None]]
]
Warn = Callable[[str], None]


@dataclass(frozen=True)
class Flown:
    """An experiment that was flown."""

    #: every step, as arrays
    rollout: Rollout
    #: the ``Controller`` that steered, with its ``problem``
    controller: Any
    #: what was learned; None where the controller knows the plant
    training: Training | None
    #: where and why the system left the finite numbers, and the rollout ends; None
    #: where it did not
    diverged: Diverged | None = None
    #: the episodes
    before: tuple["Flown", ...] = ()
    #: what was known before it began
    outlook: Outlook = field(default_factory=Outlook)


@explains_arguments
def run_trial(
    experiment: Experiment,
    open_recording: OpenRecording | None = None,
    warn: Warn | None = None,
) -> Flown:
    """Trains and flies.

    Args:
        experiment: All of it.
        open_recording: Called before each flight's first step, of episodes too, with
            the controller and the training; returns a context manager around the
            flight, whose value is called with every step.
        warn: Called before the first step with each line of what may go wrong in the
            flight.

    Raises:
        SettingError: More rows are asked for than there are, or settings that do not
            fit each other.
        ShapeError: The data have other dimensions than the system.
        DataError: The data cannot be read.
        TrainingError: An output could not be trained.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was
            nothing to fall back on.
        Diverged: The system left the finite numbers in its first step.
        RecordingError: What ``open_recording`` opened could not be written.

    See Also:
        ``Experiment``, all that it depends on; ``metrics``, its numbers;
        ``gpmpc.simulation.closed_loop``, without data and training.
    """
    check_kind("experiment", experiment, Experiment, "Experiment(...)")
    training = None
    model = experiment.model
    episodes: list[Flown] = []
    if experiment.learns and model is None:
        if isinstance(experiment.learning, EpisodicLearning):
            episodes = _fly_episodes(
                experiment, experiment.learning, open_recording, warn
            )
            best = min(episodes, key=lambda episode: rmse(experiment, episode))
            training = best.training
        else:
            training = experiment.learn(experiment.training_rows(), experiment.seed)
        model = None if training is None else training.posterior
    flown = _fly(
        experiment,
        model=model,
        training=training,
        open_recording=open_recording,
        warn=warn,
    )
    return replace(flown, before=tuple(episodes))


def _fly_episodes(
    experiment: Experiment,
    learning: EpisodicLearning,
    open_recording: OpenRecording | None,
    warn: Warn | None,
) -> list[Flown]:
    """Flies the episodes, each with what was learned from all flights before it."""
    rows = experiment.training_rows()
    episodes: list[Flown] = []
    for k in range(learning.episodes):
        training = experiment.learn(rows, experiment.seed)
        episode = replace(experiment, seed=derived_seed(experiment.seed, k))
        flown = _fly(
            episode,
            model=training.posterior,
            training=training,
            open_recording=open_recording,
            warn=warn,
        )
        rows = learning.with_flight(rows, flown.rollout)
        episodes.append(flown)
    return episodes


def _fly(
    experiment: Experiment,
    model: DynamicsModel | None,
    training: Training | None,
    open_recording: OpenRecording | None,
    warn: Warn | None,
) -> Flown:
    """Flies with a model, or on the plant's own where the controller learns none."""
    plant = experiment.plant_in_loop
    make_planner = experiment.controller
    planner = make_planner(model if experiment.learns else plant)
    controller = planner
    if isinstance(experiment.learning, OnlineLearning):
        controller = LearningController(planner, experiment.learning)
    system = _steered_system(experiment, model)
    reference = _reference(experiment, controller)
    start = _start(plant, reference)
    expected = outlook(planner, model if experiment.learns else None, reference)
    if warn is not None:
        for warning in expected.warnings:
            warn(warning)
    rehearse(system, controller, reference, start)
    recording = nullcontext()
    if open_recording is not None:
        recording = open_recording(controller, training)
    diverged = None
    try:
        with recording as on_step:
            rollout = closed_loop(
                system,
                controller,
                reference,
                start,
                experiment.steps,
                noise=experiment.noise,
                disturbances=experiment.disturbances,
                on_failure=experiment.on_failure,
                seed=experiment.seed,
                on_step=on_step,
            )
    except Diverged as error:
        if error.rollout is None:
            raise
        rollout = error.rollout
        diverged = error
    return Flown(
        rollout=rollout,
        controller=controller,
        training=training,
        diverged=diverged,
        outlook=expected,
    )


def _steered_system(
    experiment: Experiment, model: DynamicsModel | None
) -> System | ModelLoop:
    """Returns the plant, or the model rolled on itself."""
    plant = experiment.plant_in_loop
    if experiment.loop == "plant" or model is None:
        return plant
    propagator = experiment.propagator or best_propagator(model)
    return ModelLoop(model, propagator, time_step=plant.time_step)


def _reference(experiment: Experiment, controller: Any) -> Reference:
    """Returns what is followed, up to the end of the last step's plan.

    Its inputs are those at rest, which the controller falls back on where the very
    first solve fails.
    """
    states = experiment.references(experiment.steps + controller.horizon + 1)
    resting_input = np.asarray(controller.initial_input)
    return Reference(states, np.tile(resting_input, (len(states) - 1, 1)))


def _start(plant: System, reference: Reference) -> Any:
    """Returns the first state (n,); None where a simulator starts where it starts."""
    if getattr(plant.dynamics, "stateful", False):
        return None
    return reference.states[0] if plant.start is None else plant.start


def rmse(
    experiment: Experiment,
    flown: Flown,
    states: slice = slice(None),
    unit: str | None = None,
) -> float:
    """Returns the RMSE of the states of a flight; infinite where it diverged.

    It is that of the tracked states in one unit, by default the first one's.
    """
    system = experiment.system
    places = system.tracked_by_unit[system.unit if unit is None else unit]
    total = float(errors_of(experiment, flown, places, states).total)
    if flown.diverged is not None or not np.isfinite(total):
        return np.inf
    return total


def errors_of(
    experiment: Experiment,
    flown: Flown,
    places: Sequence[int],
    states: slice = slice(None),
) -> _TrackingError:
    """Returns the tracking error of some states of a flight, but of the first row."""
    rollout = flown.rollout
    return tracking_error(
        rollout.states[states],
        rollout.references[states],
        places,
        experiment.system.angle_indices,
    )
