"""Flies one trial of a system with a learned model, and measures it.

    data -> a random subset -> training -> controller -> closed loop -> metrics

``Experiment`` holds everything that the numbers follow from, as objects; files and settings are not among them. What is
learned follows what is flown: data come from the system, which the plant is as well unless a setting of its own makes
it another. The seed is that of the subset, of the training's random starts and of the noise: one seed gives one result,
and the subsets of one seed are nested, so that sizes can be compared in pairs.
"""

import inspect
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from gpmpc._dynamics import DynamicsModel
from gpmpc.datasets import DataSource
from gpmpc.exceptions import Diverged, SettingError, ShapeError, check_number
from gpmpc.gp import Training, Transitions
from gpmpc.gp.casadi_ import successor_function
from gpmpc.learning import EpisodicLearning, LearningController, OnlineLearning
from gpmpc.metrics import find_loss, time_quantiles, tracking_error, violation_rate
from gpmpc.models import CasadiFunction
from gpmpc.models._residual import train_residual
from gpmpc.mpc import Reference
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._policy import OnFailure, check_policy
from gpmpc.mpc.problem import Box, Halfspaces, Inequality, Problem
from gpmpc.propagation import Propagator, best_propagator
from gpmpc.simulation import (
    Disturbance,
    ModelLoop,
    Noise,
    Rollout,
    Step,
    closed_loop,
    rehearse,
)
from gpmpc.simulation._simulator import PlantSimulator
from gpmpc.studies._before import Outlook, outlook
from gpmpc.studies._document import Table
from gpmpc.studies.study import derived_seed, random_rows
from gpmpc.systems import System
from gpmpc.trajectories import Trajectory

Prepare = Callable[[Any, Training | None], Callable[[Step], None]]
_STAGES = ("model", "build", "solve", "total")  # of a decision's time


@dataclass(frozen=True)
class Experiment:
    """One flight of one system, with everything that it depends on.

    Raises:
        SettingError: A number out of range, an unknown policy or loop, a disturbance that does not fit the plant.
        ShapeError: Noise that does not fit the plant.
    """

    data: DataSource  #: where transitions come from
    trajectory: (
        Trajectory | None
    )  #: what is followed, from its beginning; None holds the system's goal
    system: System  #: whose transitions are learned; names, units and references are its own
    #: from transitions and a ``seed`` to a ``Training``, such as a ``Trainer``; one that learns differences sees the
    #: system's angles as sine and cosine, and learns what the system's nominal model misses
    train: Callable[..., Training]
    #: from a model, or from a ``plant`` where its first argument is called so, to a ``Controller``
    controller: Callable[..., Any]
    plant: System | None = (
        None  #: what flies, and the true model of a controller that takes one; the system by default
    )
    name: str = (
        "elliptical"  #: of the trajectory, which data from files are filed under
    )
    size: int | None = None  #: rows drawn for the training; None takes all
    steps: int = 100  #: of the flight
    seed: int = 0  #: of all random numbers
    #: what stands at the other end: the plant, or the learned model rolled on itself
    loop: Literal["plant", "model"] = "plant"
    #: the controller's own, if it has one. A model loop carries its belief on with it, or as ``best_propagator`` does
    propagator: Propagator | None = None
    noise: Noise | None = None  #: on the plant
    disturbances: Sequence[Disturbance] = ()  #: of the plant
    on_failure: OnFailure = "previous_plan"  #: what is applied where a solve fails
    learning: OnlineLearning | EpisodicLearning | None = (
        None  #: from the flight, while it flies or after it
    )
    model: DynamicsModel | None = (
        None  #: trained before; None trains one where the controller needs it
    )

    def __post_init__(self) -> None:
        check_number(
            "data.size", 1 if self.size is None else self.size, least=1, whole=True
        )
        check_number("steps", self.steps, least=1, whole=True)
        check_number("seed", self.seed, least=0, whole=True)
        check_policy(self.on_failure)
        if self.loop not in ("plant", "model"):
            raise SettingError("loop", f"must be 'plant' or 'model'; got {self.loop!r}")
        plant = self.flown
        system = self.system
        if system.signals != plant.signals:
            raise SettingError(
                "plant",
                f"must have the states, inputs and time step of {system.name}; got {plant.signals}",
            )
        if self.loop == "model" and not self.learns:
            raise SettingError(
                "loop",
                "a model loop needs a controller that learns a model; this one knows the plant",
            )
        if self.learning is not None and not (self.learns and self.loop == "plant"):
            raise SettingError(
                "learning",
                "needs a controller that learns a model, and a plant in the loop",
            )
        for disturbance in self.disturbances:
            if not hasattr(disturbance, "disturb_plant"):
                what = "must each name what it is, such as {_target_: gpmpc.simulation.Gust, rates: {vx: 0.5}}"
                raise SettingError("disturbances", f"{what}; got {disturbance!r}")
        if (
            self.loop == "plant"
        ):  # noise and disturbances that do not fit it are found before the training
            PlantSimulator(plant, plant.goal, self.disturbances, self.noise, self.seed)
        first = self.references(1)[0]
        if (
            problem := getattr(self.controller, "keywords", {}).get("problem")
        ) is not None:
            if (problem.state_dim, problem.input_dim) != self._dimensions:
                weighed = (
                    f"weighs {problem.state_dim} states and {problem.input_dim} inputs"
                )
                has = "{} has {} and {}".format(system.name, *self._dimensions)
                raise SettingError("controller.problem", f"{weighed}; {has}")
            start = first if plant.start is None else plant.start
            problem.check_start(
                np.asarray(start, dtype=float),
                np.asarray(plant.initial_input, dtype=float),
            )
        if self.learns and self.model is None and hasattr(self.data, "check"):
            self.data.check(system, self.trajectory)

    @property
    def flown(self) -> System:
        """The plant: the system, unless another one was given."""
        return self.plant or self.system

    @property
    def _dimensions(self) -> tuple[int, int]:
        return len(self.system.state_names), len(self.system.input_names)

    @property
    def learns(self) -> bool:
        """Whether the controller works on a learned model."""
        return next(iter(inspect.signature(self.controller).parameters)) != "plant"

    def training_rows(self) -> Transitions:
        """Returns the rows drawn, in the order of the flight that they come from.

        Raises:
            SettingError: More rows are asked for than there are.
            ShapeError: The data have other dimensions than the plant.
        """
        data = self.data.transitions(self.system, self.trajectory, self.name)
        if (data.state_dim, data.input_dim) != self._dimensions:
            raise ShapeError(
                f"data and system must have the same dimensions; got {data.state_dim, data.input_dim}"
            )
        size = len(data) if self.size is None else self.size
        return data[random_rows(len(data), size, self.seed, "data.size")]

    def learn(self, transitions: Transitions, seed: int) -> Training:
        """Trains on transitions; see ``train``.

        What a trainer supposes of columns that never move follows from the system's
        limits, where its ``prior_lengthscale`` is None.
        """
        angles = self.system.angle_indices
        known = self.system.nominal
        residual = getattr(self.train, "predicts", None) == "difference"
        residual = residual and bool(angles or known)
        train: Any = self.train
        if getattr(train, "prior_lengthscale", 1.0) is None:
            lengthscales = _prior_lengthscales(self.system, residual)
            train = replace(train, prior_lengthscale=lengthscales)
        if residual:
            nominal = (
                None if known is None else CasadiFunction(successor_function(known))
            )
            return train_residual(train, transitions, angles, nominal, seed)
        return train(transitions, seed=seed)

    def references(self, count: int) -> np.ndarray:
        """Returns the states to follow (count, n), one per time step."""
        return self.system.reference_states(self.trajectory, count)

    def unplanned_noise(self, training: Training | None) -> np.ndarray:
        """Returns standard deviations (n,) of the noise of a next state that the covariances of a plan leave out.

        It is what the model has learned of it; a controller that knows the plant knows its noise as well. A plan of
        means alone leaves out everything.
        """
        model = training.posterior if training else self.model
        none = np.zeros(self._dimensions[0])
        settings = getattr(self.controller, "keywords", {}).get("prediction")
        predicts_means_alone = getattr(settings, "covariance", "") == "none"
        holds_noise = getattr(self.propagator, "process_noise", False)
        if holds_noise and not predicts_means_alone:
            return none
        if self.loop == "model":
            return none
        if model is not None and self.learns:
            return model.noise_covariance.diagonal().sqrt().numpy()
        noise = self.noise and self.noise.process
        return none if noise is None else np.array(noise, dtype=float)


def _prior_lengthscales(system: System, turned: bool) -> list[float]:
    """Of what a GP sees of states and inputs: one unit, or a tenth of limits' range.

    Whichever is less: from one limit to the other predictions forget what they know.
    More would do harm where limits are wide. On its way back to the prior a mean has a
    slope that nobody has seen, and a controller follows it. Where angles are ``turned``
    into sine and cosine these have one unit.
    """
    unlimited = np.full(len(system.state_names), np.inf)
    lower, upper = system.region or (-unlimited, unlimited)
    ranges = np.subtract((*upper, *system.input_upper), (*lower, *system.input_lower))
    lengthscales = []
    for i, width in enumerate(ranges.tolist()):
        if turned and i in system.angle_indices:
            lengthscales += [1.0, 1.0]
        else:
            lengthscales.append(min(1.0, width / 10) if width > 0 else 1.0)
    return lengthscales


@dataclass(frozen=True)
class Flown:
    """An experiment that was flown."""

    rollout: Rollout  #: every step, as arrays
    controller: Any  #: the ``Controller`` that steered, with its ``problem``
    training: (
        Training | None
    )  #: what was learned; None where the controller knows the plant
    #: where and why the system left the finite numbers, and the rollout ends; None where it did not
    diverged: Diverged | None = None
    before: tuple["Flown", ...] = ()  #: the episodes
    outlook: Outlook = field(default_factory=Outlook)  #: what was known before it began


def run_trial(
    experiment: Experiment,
    prepare: Prepare | None = None,
    warn: Callable[[str], None] | None = None,
) -> Flown:
    """Trains and flies.

    Args:
        experiment: All of it.
        prepare: Called before the first step with the controller and the training; what it returns is called with
            every step.
        warn: Called before the first step with each line of what may go wrong in the flight.

    Raises:
        SettingError: More rows are asked for than there are, or settings that do not fit each other.
        DataError: The data cannot be read.
        TrainingError: An output could not be trained.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was nothing to fall back on.
        Diverged: The system left the finite numbers in its first step.
    """
    training = None
    model = experiment.model
    before = []
    if experiment.learns and model is None:
        data = experiment.training_rows()
        training = experiment.learn(data, experiment.seed)
        if isinstance(experiment.learning, EpisodicLearning):
            for k in range(experiment.learning.episodes):
                again = replace(experiment, seed=derived_seed(experiment.seed, k))
                before.append(_fly(again, prepare, training.posterior, training, warn))
                data = experiment.learning.with_flight(data, before[-1].rollout)
                if k + 1 < experiment.learning.episodes:
                    training = experiment.learn(data, experiment.seed)
            training = (
                min(before, key=lambda flown: _error(experiment, flown)).training
                or training
            )
        model = training.posterior
    flown = _fly(experiment, prepare, model, training, warn)
    return replace(flown, before=tuple(before))


def _error(experiment: Experiment, flown: Flown, last: int = 0) -> float:
    """RMSE of a flight, or of its last states alone; infinite where it diverged."""
    error = _tracking_error(experiment, flown, last).total
    return float(error) if flown.diverged is None and np.isfinite(error) else np.inf


def _tracking_error(experiment: Experiment, flown: Flown, last: int = 0) -> Any:
    system = experiment.system
    rollout = flown.rollout
    states = rollout.states[-last:]
    references = rollout.references[-last:]
    return tracking_error(
        states, references, system.tracked_indices, system.angle_indices
    )


def _fly(
    experiment: Experiment,
    prepare: Prepare | None,
    model: DynamicsModel | None,
    training: Training | None,
    warn: Callable[[str], None] | None,
) -> Flown:
    """Flies with a model, or on the plant's own where it is None."""
    plant = experiment.flown
    controller = experiment.controller(model if experiment.learns else plant)
    planner = controller
    if isinstance(experiment.learning, OnlineLearning):
        controller = LearningController(controller, experiment.learning)
    system: System | ModelLoop = plant
    if experiment.loop == "model" and model is not None:
        system = ModelLoop(
            model,
            experiment.propagator or best_propagator(model),
            time_step=plant.time_step,
        )
    states = experiment.references(experiment.steps + controller.horizon + 1)
    resting = np.asarray(
        controller.initial_input
    )  # falls back on it where the very first solve fails
    reference = Reference(states, np.tile(resting, (len(states) - 1, 1)))
    start = states[0] if plant.start is None else plant.start
    start = None if getattr(plant.dynamics, "stateful", False) else start
    expected = outlook(planner, model if experiment.learns else None, reference)
    if warn is not None:
        for line in expected.warnings:
            warn(line)
    rehearse(system, controller, reference, start)
    on_step = None if prepare is None else prepare(controller, training)
    how = {
        key: getattr(experiment, key)
        for key in ("noise", "disturbances", "on_failure", "seed")
    }
    try:
        rollout = closed_loop(
            system,
            controller,
            reference,
            start,
            experiment.steps,
            **how,
            on_step=on_step,
        )
    except Diverged as error:
        if error.flown is None:
            raise
        return Flown(error.flown, controller, training, error, outlook=expected)
    return Flown(rollout, controller, training, outlook=expected)


def metrics(experiment: Experiment, flown: Flown) -> dict[str, Any]:
    """Returns the results of a flight as plain data; everything that differs between equal runs is under ``times``.

    ``judgement`` is what the steps said while it flew (``gpmpc.mpc.FlightJudge``); ``lost`` says since when and why a
    flight no longer follows its reference (``find_loss``, by its judgement, or it diverged). One that diverged has no
    RMSE: None.
    """
    rollout = flown.rollout
    problem = flown.controller.problem
    training = flown.training
    system = experiment.system
    horizon = flown.controller.horizon
    total = _error(experiment, flown)
    axes = _tracking_error(experiment, flown).axes.tolist()
    rmse: dict[str, Any] = dict(zip(system.tracked, axes, strict=True)) | {
        "total": total
    }
    violations = _violation_rates(problem, horizon, rollout)
    learned = None
    if training is not None:
        objective = [float(value) for value in training.objective]
        learned = {
            "size": len(training.posterior),
            "evaluations": training.evaluations,
            "objective": objective,
        }
    return {
        "steps": len(rollout.inputs),
        "unit": system.unit,
        "rmse": rmse if np.isfinite(total) else dict.fromkeys(rmse),
        "error_at_end": _error(experiment, flown, last=2)
        if np.isfinite(total)
        else None,
        "judgement": _judgement(flown),
        "lost": _lost(experiment, flown),
        "outlook": asdict(flown.outlook) | {"warnings": [*flown.outlook.warnings]},
        "violations": {
            name: asdict(rate) | {"rate": rate.rate}
            for name, rate in violations.items()
        },
        "failures": dict(Counter(status.name for _, status in rollout.failures)),
        "far_from_data": len(rollout.far_from_data),
        "suboptimal": dict(
            Counter(rollout.statuses[k].name for k in rollout.suboptimal)
        ),
        "iterations": {
            "mean": float(rollout.iterations.mean()),
            "largest": int(rollout.iterations.max()),
        },
        "training": learned,
        "episodes": [
            error if np.isfinite(error := _error(experiment, each)) else None
            for each in flown.before
        ],
        "times": {"training": None if training is None else training.seconds}
        | {
            stage: time_quantiles(
                np.array([getattr(t, stage) for t in rollout.timings])
            )
            for stage in _STAGES
        },
    }


def _violation_rates(
    problem: Problem, horizon: int, rollout: Rollout
) -> dict[str, Any]:
    """Returns how often bounds of inputs and constraints of states were broken, by name.

    Of states the flown ones count, with the sides that a first predicted state has: a
    constraint of later stages alone asks nothing of them. All boxes are one, "states";
    of another kind each constraint is counted for itself.
    """
    lower, upper = problem.inputs.by_stage(horizon)
    rates = {"inputs": violation_rate(rollout.inputs, lower[0], upper[0])}
    states = rollout.states[1:]
    held = [
        constraint
        for constraint in problem.constraints
        if constraint.stages is None or 1 in constraint.stages
    ]
    boxes = [part.by_stage(horizon) for part in held if isinstance(part, Box)]
    if boxes:
        tightest_lower = np.max([lower[0] for lower, _ in boxes], axis=0)
        tightest_upper = np.min([upper[0] for _, upper in boxes], axis=0)
        rates["states"] = violation_rate(states, tightest_lower, tightest_upper)
    others: list[tuple[str, list[Any]]] = [
        ("half-spaces", [part for part in held if isinstance(part, Halfspaces)]),
        ("inequality", [part for part in held if isinstance(part, Inequality)]),
    ]
    for kind, constraints in others:
        for number, constraint in enumerate(constraints, start=1):
            name = kind if len(constraints) == 1 else f"{kind} {number}"
            excess = _excess(constraint, states, rollout.inputs)
            unbounded = np.full(excess.shape[1], -np.inf)
            rates[name] = violation_rate(excess, unbounded, np.zeros(len(unbounded)))
    return rates


def _excess(
    constraint: Halfspaces | Inequality, states: np.ndarray, inputs: np.ndarray
) -> np.ndarray:
    """Returns by how much each state (K, n) misses each side (K, r).

    Negative where a side is kept, NaN where a function or its gradient is not finite.
    """
    if isinstance(constraint, Halfspaces):
        return states @ constraint.F.T - np.atleast_2d(constraint.f)[0]
    with suppress(FunctionNotFinite):
        return constraint.expand(states, inputs, parameters=None)[0]
    excess = np.full((len(states), constraint.count), np.nan)
    for k in range(len(states)):  # which of them are finite, they say alone
        with suppress(FunctionNotFinite):
            excess[k] = constraint.expand(
                states[k : k + 1], inputs[k : k + 1], parameters=None
            )[0][0]
    return excess


def _judgement(flown: Flown) -> dict[str, Any]:
    """Returns level, reason, first step and counts of what the steps said of a flight."""
    judgement = flown.rollout.judgement
    if flown.diverged is not None and judgement.level != "lost":
        reason = " ".join(str(flown.diverged).split())
        judgement = judgement._replace(
            level="lost", reason=reason, step=flown.diverged.step
        )
    return judgement._asdict()


def _lost(experiment: Experiment, flown: Flown) -> dict[str, Any] | None:
    """Returns step, time [s] and reason of a flight's loss; None where it was not lost."""
    system = experiment.system
    rollout = flown.rollout
    found = []
    unit = system.unit
    axes = system.tracked_indices
    angles = system.angle_indices
    if loss := find_loss(rollout.states, rollout.references, axes, system.lost, angles):
        found.append(
            (
                loss.step,
                f"{loss.distance:.3g} {unit} from its reference, more than {loss.limit:.3g} {unit}",
            )
        )
    judgement = rollout.judgement
    if judgement.level == "lost" and judgement.step is not None:
        found.append((judgement.step, judgement.reason))
    if flown.diverged is not None:
        found.append((flown.diverged.step, " ".join(str(flown.diverged).split())))
    if not found:
        return None
    found.sort(key=lambda loss: loss[0])
    step, reasons = found[0][0], "; ".join(reason for _, reason in found)
    return {"step": step, "time": round(step * rollout.time_step, 9), "reason": reasons}


def summary(result: Mapping[str, Any]) -> Table:
    """Returns a run's metrics in words, a line each; what there is nothing to say of has none."""
    settings = result["settings"]
    times = result["times"]
    rmse = result["rmse"]
    unit = result["unit"]
    options, (system, plant, model) = (
        settings["options"],
        (settings.get(k) or {} for k in ("system", "plant", "model")),
    )
    along = "" if options["trajectory"] == "goal" else f" along {options['trajectory']}"
    training = result["training"]
    lost = result.get("lost")
    far = result.get("far_from_data")
    error = result.get("error_at_end")
    stopped = _counted(result.get("suboptimal", {}))
    axes = ", ".join(
        f"{k} {v:.3g}" for k, v in rmse.items() if v is not None and k != "total"
    )
    stages = ", ".join(
        f"{stage} {1e3 * times[stage]['median']:.3g}" for stage in _STAGES[:3]
    )
    median, most = (f"{1e3 * times['total'][key]:.3g}" for key in ("median", "p99"))
    lines = {
        "flight": f"{result['steps']} steps of {options['system']}{along} with {options['controller']}",
        "flown with": ", ".join(
            f"{k} {v} (learned: {system.get(k)})"
            for k, v in plant.items()
            if v != system.get(k)
        ),
        "model": model.get("path"),
        "learned from": training
        and f"{training['size']} rows of {options['data']} data, in {times['training']:.2f} s",
        "known before": ", ".join(
            f"{k} {v}" for k, v in (settings.get("nominal") or {}).items()
        ),
        "before the flight": "; ".join(result.get("outlook", {}).get("warnings", ())),
        "lost": lost
        and f"from step {lost['step']} ({lost['time']:g} s) on: {lost['reason']}",
        "judgement": _judged(result),
        f"RMSE [{unit}]": "none: it diverged"
        if rmse["total"] is None
        else f"{rmse['total']:.3g}  ({axes})",
        f"at the end [{unit}]": None if error is None else f"{error:.3g}",
        "episodes before": ", ".join(
            "diverged" if e is None else f"{e:.3g}" for e in result.get("episodes", ())
        ),
    }
    for name, rate in result["violations"].items():
        interval = f"{100 * rate['low']:.2g} to {100 * rate['high']:.2g} %"
        label = f"bounds of {name}" if name in ("inputs", "states") else name
        largest = f", by up to {rate['worst']:.3g}" if rate["violations"] else ""
        lines[label] = (
            f"{rate['violations']} of {rate['steps']} steps outside "
            f"(95 %: {interval}){largest}"
        )
    lines |= {
        "failed solves": _counted(result["failures"]) or "none",
        "stopped early": stopped
        and f"{stopped}: plans that were not optimal yet, applied",
        "far from the data": far
        and f"the plans of {far} steps: there the model knows little more than its prior",
        "decision [ms]": f"median {median}  ({stages}), 99 % below {most}",
    }
    return Table(("", ""), [(name, text) for name, text in lines.items() if text])


def _judged(result: Mapping[str, Any]) -> str | None:
    """Returns what the steps said of their flight, in words; None where it is told as lost, or nobody judged it."""
    judgement = result.get("judgement")
    if judgement is None or result.get("lost"):
        return None
    if judgement["level"] == "suspicious":
        return f"suspicious from step {judgement['step']} on: {judgement['reason']}"
    if judgement["suspicious"]:
        return f"healthy at the end; {judgement['suspicious']} steps were suspicious"
    return "healthy"


def _counted(statuses: Mapping[str, int]) -> str:
    return ", ".join(f"{status} {count}" for status, count in statuses.items())
