"""Problem: one flight with a learned model has a dozen ingredients, and a result has to follow from them alone.

    data -> a random subset -> training -> controller -> closed loop -> metrics

``Experiment`` holds the ingredients as objects, ``fly`` does the work, ``metrics`` says in plain data what came of it.
Neither knows files or settings. Flown is the translational subsystem along a trajectory, or the rotational one on its
own, at its own rate, along the attitudes that the trajectory asks for (``gpmpc.datasets.attitudes``). The seed is that
of the subset, of the training's random starts and of the noise: the same seed gives the same numbers, and the subsets
of one seed are nested, so that sizes can be compared in pairs.
"""

import inspect
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from gpmpc.datasets import DataSource, rotational_states_along
from gpmpc.exceptions import Diverged, SettingError, ShapeError, check_number
from gpmpc.gp import Training, Transitions
from gpmpc.metrics import NEAR, ViolationRate, find_loss, time_quantiles, tracking_error, violation_rate
from gpmpc.mpc.controller import Controller, Reference
from gpmpc.mpc.supervision import OnFailure, check_policy
from gpmpc.propagation import MomentMatching, Propagator
from gpmpc.simulation import Disturbance, ModelLoop, Noise, PlantSimulator, Rollout, Step, closed_loop, rehearse
from gpmpc.systems import Coupled, Map, Plant, Rotational, Translational
from gpmpc.trajectories import Trajectory, states_along

NAMES = {"translational": Translational.state_names, "rotational": Rotational.state_names}
UNITS = {"translational": "m", "rotational": "rad"}  # of the positions and angles that errors are stated in
STAGES = ("model", "build", "solve", "total")  # of a decision's time


@dataclass(frozen=True)
class Experiment:
    """One flight of one subsystem, with everything that it depends on.

    Attributes:
        data: Where transitions come from.
        trajectory: What is followed, from its beginning.
        plant: What flies, and what a controller on the true model believes in.
        train: From transitions and a ``seed`` to a ``Training``.
        controller: From a model, or from a ``plant`` where its first argument is called so, to a ``Controller``.
        subsystem: Which of the two is learned and flown.
        name: Of the trajectory, which data from files are filed under.
        size: Rows drawn for the training; None takes all.
        steps: Of the flight.
        seed: Of all random numbers.
        loop: What stands at the other end: the plant, or the learned model rolled on itself.
        propagator: The controller's own, if it has one. A model loop carries its belief on with it, or by moment
            matching.
        noise: On the plant.
        disturbances: Of the plant.
        on_failure: What is applied where a solve fails.

    Raises:
        SettingError: A number out of range, an unknown policy or loop, a disturbance that does not fit the plant.
        ShapeError: Noise that does not fit the plant.
    """

    data: DataSource
    trajectory: Trajectory
    plant: Plant
    train: Callable[..., Training]
    controller: Callable[..., Controller]
    subsystem: Literal["translational", "rotational"] = "translational"
    name: str = "elliptical"
    size: int | None = None
    steps: int = 100
    seed: int = 0
    loop: Literal["plant", "model"] = "plant"
    propagator: Propagator | None = None
    noise: Noise | None = None
    disturbances: Sequence[Disturbance] = ()
    on_failure: OnFailure = "previous_plan"

    def __post_init__(self) -> None:
        if self.size is not None:
            check_number("data.size", self.size, least=1, whole=True)
        check_number("steps", self.steps, least=1, whole=True)
        check_number("seed", self.seed, least=0, whole=True)
        check_policy(self.on_failure)
        if self.loop not in ("plant", "model"):
            raise SettingError("loop", f"must be 'plant' or 'model'; got {self.loop!r}")
        if self.subsystem not in NAMES:
            raise SettingError("subsystem", f"must be one of {', '.join(NAMES)}; got {self.subsystem!r}")
        expected, names = NAMES[self.subsystem], tuple(self.plant.dynamics.state_names)
        if names != expected:
            what = f"must have the states of the {self.subsystem} subsystem, {', '.join(expected)}"
            whole = "; the whole quadrotor is flown by gpmpc.simulation.cascade_loop"
            raise SettingError(
                "plant", f"{what}; got {', '.join(names)}{whole if names == Coupled.state_names else ''}"
            )
        if self.subsystem == "rotational" and isinstance(self.plant, Map):
            raise SettingError("plant", "the rotational subsystem is flown at its own rate; a Map has none")
        if self.loop == "model" and not self.learns:
            raise SettingError("loop", "a model loop needs a controller that learns a model; this one knows the plant")
        for disturbance in self.disturbances:
            if not hasattr(disturbance, "disturb_plant"):
                what = "must each name what it is, such as {_target_: gpmpc.simulation.Gust, rates: {vx: 0.5}}"
                raise SettingError("disturbances", f"{what}; got {disturbance!r}")
        if self.loop == "plant":  # noise and disturbances that do not fit it are found out before the training
            PlantSimulator(self.plant, np.zeros(len(names)), self.disturbances, self.noise, self.seed)

    @property
    def learns(self) -> bool:
        """Whether the controller works on a learned model."""
        return next(iter(inspect.signature(self.controller).parameters)) != "plant"


@dataclass(frozen=True)
class Flight:
    """What came of an experiment.

    Attributes:
        rollout: Every step, as arrays.
        controller: What steered.
        training: What was learned; None where the controller knows the plant.
        diverged: Where and why the system left the finite numbers, and the rollout ends; None where it did not.
    """

    rollout: Rollout
    controller: Controller
    training: Training | None
    diverged: Diverged | None = None


def fly(
    experiment: Experiment, prepared: Callable[[Controller, Training | None], Callable[[Step], None]] | None = None
) -> Flight:
    """Trains and flies.

    Args:
        experiment: All of it.
        prepared: Called before the first step with the controller and the training; what it returns is called with
            every step.

    Raises:
        SettingError: More rows asked for than there are, or settings that do not fit each other.
        DataError: The data cannot be read.
        TrainingError: An output could not be trained.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was nothing to fall back on.
        Diverged: The system left the finite numbers in its first step.
    """
    plant, training = experiment.plant, None
    if experiment.learns:
        training = experiment.train(training_rows(experiment), seed=experiment.seed)
        controller = experiment.controller(training.posterior)
    else:
        controller = experiment.controller(plant)
    system: Plant | ModelLoop = plant
    if experiment.loop == "model":
        propagator = experiment.propagator or MomentMatching()
        system = ModelLoop(training.posterior, propagator, time_step=plant.time_step)
    states = references(experiment, experiment.steps + controller.horizon + 1)
    resting = np.asarray(controller.initial_input)  # falls back on it where the very first solve fails
    reference = Reference(states, np.tile(resting, (len(states) - 1, 1)))
    rehearse(system, controller, reference, states[0])
    on_step = None if prepared is None else prepared(controller, training)
    try:
        rollout = closed_loop(
            system,
            controller,
            reference,
            states[0],
            experiment.steps,
            noise=experiment.noise,
            disturbances=experiment.disturbances,
            on_failure=experiment.on_failure,
            seed=experiment.seed,
            on_step=on_step,
        )
    except Diverged as error:
        if error.flown is None:
            raise
        return Flight(error.flown, controller, training, error)
    return Flight(rollout, controller, training)


def references(experiment: Experiment, count: int) -> np.ndarray:
    """The states to follow (count, n), one a step of the plant."""
    time_step = experiment.plant.time_step
    if experiment.subsystem == "rotational":
        return rotational_states_along(experiment.trajectory, count, time_step)
    return states_along(experiment.trajectory, time_step * np.arange(count))


def training_rows(experiment: Experiment) -> Transitions:
    """The rows drawn, in the order of the flight that they come from.

    Raises:
        SettingError: More rows asked for than there are.
        ShapeError: The data have other dimensions than the plant.
    """
    data = experiment.data.transitions(experiment.name, experiment.trajectory, experiment.subsystem)
    expected = len(experiment.plant.dynamics.state_names), len(experiment.plant.dynamics.input_names)
    if (data.state_dim, data.input_dim) != expected:
        raise ShapeError(f"data and plant must have the same dimensions; got {data.state_dim, data.input_dim}")
    size = len(data) if experiment.size is None else experiment.size
    if size > len(data):
        raise SettingError("data.size", f"must be at most {len(data)}, the rows of the data; got {size}")
    drawn = np.random.default_rng(experiment.seed).permutation(len(data))[:size]
    return data[np.sort(drawn).tolist()]


def metrics(experiment: Experiment, flight: Flight) -> dict[str, Any]:
    """What came of a flight, as plain data; everything that differs between equal runs is under ``times``.

    ``lost`` says since when and why a flight no longer follows its reference (``find_loss``, or it diverged). One that
    diverged has no RMSE: None.
    """
    rollout, problem = flight.rollout, flight.controller.problem
    names = experiment.plant.dynamics.state_names[::2]
    error = tracking_error(rollout.states, rollout.references)
    rmse = {name: float(value) for name, value in zip(names, error.axes, strict=True)} | {"total": error.total}
    if flight.diverged is not None or not np.isfinite(error.total):
        rmse = dict.fromkeys(rmse)
    violations = {"inputs": violation_rate(rollout.inputs, problem.input_lower, problem.input_upper)}
    if problem.state_bounds is not None:
        bounds = problem.state_bounds
        violations["states"] = violation_rate(rollout.states[1:], bounds.lower, bounds.upper)
    training = flight.training
    return {
        "steps": len(rollout.inputs),
        "unit": UNITS[experiment.subsystem],
        "rmse": rmse,
        "lost": _lost(experiment, flight),
        "violations": {name: _violations(rate) for name, rate in violations.items()},
        "failures": dict(Counter(status.name for _, status in rollout.failures)),
        "suboptimal": dict(Counter(rollout.statuses[k].name for k in rollout.suboptimal)),
        "iterations": {"mean": float(rollout.iterations.mean()), "largest": int(rollout.iterations.max())},
        "training": None
        if training is None
        else {
            "size": len(training.posterior),
            "evaluations": training.evaluations,
            "objective": [float(value) for value in training.objective],
        },
        "times": {"training": None if training is None else training.seconds}
        | {stage: asdict(time_quantiles(np.array([getattr(t, stage) for t in rollout.timings]))) for stage in STAGES},
    }


def unplanned_noise(experiment: Experiment, training: Training | None) -> np.ndarray:
    """Standard deviations (n,) of the noise of a next state that the covariances of a plan do not hold.

    It is what the model has learned of it; a controller that knows the plant knows its noise as well.
    """
    n = len(experiment.plant.dynamics.state_names)
    if getattr(experiment.propagator, "process_noise", False) or experiment.loop == "model":
        return np.zeros(n)
    if training is not None:
        return training.posterior.noise_covariance.diagonal().sqrt().numpy()
    noise = experiment.noise and experiment.noise.process
    return np.zeros(n) if noise is None else np.array(noise, dtype=float)


def _lost(experiment: Experiment, flight: Flight) -> dict[str, Any] | None:
    """Step, time [s] and reason of a flight's loss; None where it was not lost."""
    unit, steps, reasons = UNITS[experiment.subsystem], [], []
    if loss := find_loss(flight.rollout.states, flight.rollout.references, NEAR[unit]):
        steps.append(loss.step)
        reasons.append(f"{loss.distance:.3g} {unit} from its reference, more than {loss.limit:.3g} {unit}")
    if flight.diverged is not None:
        steps.append(flight.diverged.step)
        reasons.append(" ".join(str(flight.diverged).split()))
    if not steps:
        return None
    return {"step": steps[0], "time": round(steps[0] * flight.rollout.time_step, 9), "reason": "; ".join(reasons)}


def _violations(rate: ViolationRate) -> dict[str, Any]:
    return asdict(rate) | {"rate": rate.rate}
