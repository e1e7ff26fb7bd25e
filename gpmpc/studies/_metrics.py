"""Measures a flight: errors, broken bounds, failures, loss and times, as plain data."""

from collections import Counter
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.gp import Training
from gpmpc.metrics import find_loss, time_quantiles, violation_rate
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc.problem import Box, Halfspaces, Inequality, Problem
from gpmpc.simulation import Rollout
from gpmpc.studies._experiment import Experiment
from gpmpc.studies._trial import Flown, errors_of, rmse

#: parts of the time of a decision
DECISION_STAGES = ("model", "build", "solve", "total")


@explains_arguments
def metrics(experiment: Experiment, flown: Flown) -> dict[str, Any]:
    """Returns the results of a flight as plain data.

    Everything that differs between equal runs is under ``times``. ``judgement`` is what
    the steps said while it flew (``gpmpc.mpc.FlightJudge``). ``lost`` says since when
    and why a flight does not follow its reference: by ``find_loss``, by its judgement,
    or since it diverged. One that diverged has no RMSE: None.
    ``rmse`` in total, ``error_at_end`` and ``episodes`` are of the tracked states in
    ``unit``; ``further_units`` has those of others.
    """
    rollout = flown.rollout
    return {
        "steps": len(rollout.inputs),
        "unit": experiment.system.unit,
        "rmse": _rmse_by_axis(experiment, flown),
        "error_at_end": _error_at_end(experiment, flown),
        "further_units": _further_units(experiment, flown),
        "judgement": _judgement(flown),
        "lost": _loss(experiment, flown),
        "outlook": asdict(flown.outlook) | {"warnings": [*flown.outlook.warnings]},
        "violations": _violations(experiment, flown),
        "failures": _failures(rollout),
        "far_from_data": len(rollout.far_from_data),
        "suboptimal": _suboptimal(rollout),
        "iterations": _iterations(rollout),
        "training": _training(flown.training),
        "episodes": [
            _finite_or_none(rmse(experiment, episode)) for episode in flown.before
        ],
        "times": _times(flown),
    }


def _further_units(experiment: Experiment, flown: Flown) -> dict[str, Any]:
    """Returns names, RMSE and error at the end of tracked states of further units."""
    system = experiment.system
    further = list(system.tracked_by_unit)[1:]
    return {
        unit: {
            "states": [system.state_names[i] for i in system.tracked_by_unit[unit]],
            "rmse": _finite_or_none(rmse(experiment, flown, unit=unit)),
            "error_at_end": _error_at_end(experiment, flown, unit),
        }
        for unit in further
    }


def _rmse_by_axis(experiment: Experiment, flown: Flown) -> dict[str, float | None]:
    """Returns the RMSE of every tracked state, of all units, and of the first unit's.

    The latter is called ``total``. All are None where the flight diverged.
    """
    tracked = experiment.system.tracked
    total = rmse(experiment, flown)
    if not np.isfinite(total):
        return dict.fromkeys((*tracked, "total"))
    by_axis = errors_of(
        experiment, flown, experiment.system.tracked_indices
    ).axes.tolist()
    return dict(zip(tracked, by_axis, strict=True)) | {"total": total}


def _error_at_end(
    experiment: Experiment, flown: Flown, unit: str | None = None
) -> float | None:
    """Returns how far the last state is from its reference; None if it diverged."""
    if not np.isfinite(rmse(experiment, flown)):
        return None
    return rmse(experiment, flown, states=slice(-2, None), unit=unit)


def _failures(rollout: Rollout) -> dict[str, int]:
    """Counts the solves that failed, by status."""
    return dict(Counter(status.name for _, status in rollout.failures))


def _suboptimal(rollout: Rollout) -> dict[str, int]:
    """Counts the plans that were applied before they were optimal, by status."""
    return dict(Counter(rollout.statuses[k].name for k in rollout.suboptimal))


def _iterations(rollout: Rollout) -> dict[str, float | int]:
    return {
        "mean": float(rollout.iterations.mean()),
        "largest": int(rollout.iterations.max()),
    }


def _training(training: Training | None) -> dict[str, Any] | None:
    """Returns size, evaluations and objective of a training; None where none was."""
    if training is None:
        return None
    return {
        "size": len(training.posterior),
        "evaluations": training.evaluations,
        "objective": [float(value) for value in training.objective],
    }


def _times(flown: Flown) -> dict[str, Any]:
    """Returns the time of the training and quantiles of those of the decisions [s]."""
    training = flown.training
    times: dict[str, Any] = {"training": None if training is None else training.seconds}
    timings = flown.rollout.timings
    # Where nobody was asked, such as while a sensor is silent, nobody took time.
    decided = [timing for timing in timings if timing.total > 0] or timings
    for stage in DECISION_STAGES:
        seconds = [getattr(timing, stage) for timing in decided]
        times[stage] = time_quantiles(np.array(seconds))
    return times


def _finite_or_none(number: float) -> float | None:
    return number if np.isfinite(number) else None


def _judgement(flown: Flown) -> dict[str, Any]:
    """Returns level, reason, first step and counts of the judgements of the steps."""
    judgement = flown.rollout.judgement
    diverged = flown.diverged
    if diverged is not None and judgement.level != "lost":
        judgement = judgement._replace(
            level="lost", reason=_on_one_line(diverged), step=diverged.step
        )
    return judgement._asdict()


def _loss(experiment: Experiment, flown: Flown) -> dict[str, Any] | None:
    """Returns step, time [s] and reason of a loss; None where it was not lost."""
    system = experiment.system
    rollout = flown.rollout
    losses: list[tuple[int, str]] = []  # step and reason
    for unit, places in system.tracked_by_unit.items():
        far_away = find_loss(
            rollout.states,
            rollout.references,
            axes=places,
            least=system.lost_from(unit),
            angles=system.angle_indices,
        )
        if far_away is not None:
            reason = (
                f"{far_away.distance:.3g} {unit} from its reference, "
                f"more than {far_away.limit:.3g} {unit}"
            )
            losses.append((far_away.step, reason))
    judgement = rollout.judgement
    if judgement.level == "lost" and judgement.step is not None:
        losses.append((judgement.step, judgement.reason))
    if flown.diverged is not None:
        losses.append((flown.diverged.step, _on_one_line(flown.diverged)))
    if not losses:
        return None
    losses.sort(key=lambda loss: loss[0])
    first_step = losses[0][0]
    return {
        "step": first_step,
        "time": round(first_step * rollout.time_step, 9),
        "reason": "; ".join(reason for _, reason in losses),
    }


def _on_one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _violations(experiment: Experiment, flown: Flown) -> dict[str, dict[str, Any]]:
    """Returns how often each kind of constraint was broken, by name, as plain data.

    Of bounds it says by how much at most, for each entry that broke its own, with the
    unit; entries of other constraints have neither name nor unit.
    """
    system = experiment.system
    rates = _violation_rates(
        flown.controller.problem, flown.controller.horizon, flown.rollout
    )
    names_by_kind = {"inputs": system.input_names, "states": system.state_names}
    content = {}
    for kind, rate in rates.items():
        names = names_by_kind.get(kind, ())
        labels = [f"{name} [{system.units[name]}]" for name in names]
        worst = zip(labels, rate.worst_by_entry, strict=False)
        content[kind] = asdict(rate) | {
            "worst_by_entry": {
                label: distance for label, distance in worst if distance
            },
            "rate": rate.rate,
        }
    return content


def _violation_rates(
    problem: Problem, horizon: int, rollout: Rollout
) -> dict[str, Any]:
    """Returns how often bounds of inputs and constraints of states were broken.

    Of inputs those count that were decided: what an actuator's noise adds to them is no
    decision. Of states the flown ones count, with the sides that a first predicted
    state has: a constraint of later stages alone asks nothing of them. By name: all
    boxes are one, "states"; of another kind each constraint is counted for itself.
    """
    lower, upper = problem.inputs.by_stage(horizon)
    first_stage_lower = lower[0]
    first_stage_upper = upper[0]
    commands = rollout.inputs if rollout.commands is None else rollout.commands
    rates = {"inputs": violation_rate(commands, first_stage_lower, first_stage_upper)}
    states = rollout.states[1:]
    constraints = [
        constraint
        for constraint in problem.constraints
        if constraint.stages is None or 1 in constraint.stages
    ]
    boxes = [
        constraint.by_stage(horizon)
        for constraint in constraints
        if isinstance(constraint, Box)
    ]
    if boxes:
        tightest_lower = np.max([lower[0] for lower, _ in boxes], axis=0)
        tightest_upper = np.min([upper[0] for _, upper in boxes], axis=0)
        rates["states"] = violation_rate(states, tightest_lower, tightest_upper)
    halfspaces = [each for each in constraints if isinstance(each, Halfspaces)]
    inequalities = [each for each in constraints if isinstance(each, Inequality)]
    for name, constraint in [
        *_numbered("half-spaces", halfspaces),
        *_numbered("inequality", inequalities),
    ]:
        excess = _excess(constraint, states, rollout.inputs)
        unbounded = np.full(excess.shape[1], -np.inf)
        rates[name] = violation_rate(excess, unbounded, np.zeros(len(unbounded)))
    return rates


def _numbered(kind: str, constraints: list[Any]) -> list[tuple[str, Any]]:
    """Returns constraints of one kind with their names; one alone has no number."""
    if len(constraints) == 1:
        return [(kind, constraints[0])]
    return [
        (f"{kind} {number}", constraint)
        for number, constraint in enumerate(constraints, start=1)
    ]


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
    # Some state has no finite value: which of them have one is found one by one.
    excess = np.full((len(states), constraint.count), np.nan)
    for k in range(len(states)):
        one = slice(k, k + 1)
        with suppress(FunctionNotFinite):
            values = constraint.expand(states[one], inputs[one], parameters=None)[0]
            excess[k] = values[0]
    return excess
