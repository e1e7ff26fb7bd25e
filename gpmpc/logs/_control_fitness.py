"""Judges whether a controller can plan with a model that was learned from a log.

A controller asks what its inputs do, and predicts little by what usually happens. So
the effects of the inputs, as they act, on the outputs are found once more, by a
regression on the rows themselves with intervals, and the derivatives of the model stand
beside them. Of an input that only follows the states, or does not move, the rows cannot
tell the effect; flights that can are named. And a feedback that is designed on the
model has to stabilise the other candidates as well, about some states of the log.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._inspection import FOLLOWS, input_dependence
from gpmpc.logs._log import Log
from gpmpc.logs._output_gps import choose_rows
from gpmpc.logs._ranges import state_widths, widths_of
from gpmpc.logs._regression import Standardization, fit_affine
from gpmpc.models._kinematics import RigidBodyKinematics
from gpmpc.models._log_model import LogModel

_SIGNIFICANT = 3.0  # standard errors by which an effect has to differ from none
_LEAST_EFFECT = 1e-3  # of an output's deviation
_BLOCK = 50  # rows whose residuals are correlated
_ROWS = 20_000  # that are looked at, at most
_STATES = 6  # about which feedbacks are tried
_DIFFERENCE = 1e-5  # of the ranges of states and inputs
_UNSTABLE = 1.002  # spectral radius
_MISSED = 0.1  # of an output's variance: what a model misses of it counts
_TOLD_BY_PAST = 0.25  # of that, which is left where the rows before tell it
_ROWS_A_REGRESSOR = 8  # fewer tell nothing
_DITHER = 0.1  # standard deviation of an excitation over the range of an input


@dataclass(frozen=True)
class Effect:
    """The effect of an input on the output that it moves most."""

    input: str  #: its name
    output: str  #: likewise
    #: of the output by the input, from the rows [unit of the output per unit of the
    #: input, in SI units]
    gain: float
    low: float  #: of the 95 % interval of the gain, in its unit
    high: float  #: likewise
    model: float  #: mean derivative of the model, in the unit of the gain


@dataclass(frozen=True)
class ControlFitness:
    """Whether a controller can plan with a model.

    See Also:
        ``learn(..., for_control=True)``, which asks for it.
    """

    effects: tuple[Effect, ...]  #: one of each input
    faults: tuple[str, ...]  #: why no controller should plan with it
    warnings: tuple[str, ...]  #: what else to know
    advice: tuple[str, ...]  #: what to fly instead, where there are faults


def judge_for_control(
    model: LogModel, log: Log, rivals: Mapping[str, LogModel]
) -> ControlFitness:
    """Judges whether a controller can plan with a model.

    Args:
        model: With its parameters and GPs.
        log: That it was fitted to.
        rivals: Other models of the log, by their names.
    """
    stride = max(len(log) // _ROWS, 1)
    acts_late = bool(model.lag or len(model.time_constants))
    start = model.past if acts_late else 0
    windows = log.windows(1, past=start, stride=stride)
    states = windows.states[:, start]
    next_states = windows.states[:, start + 1]
    acting, _ = model.acting_inputs(windows, slice(start, start + 1))
    inputs = acting[:, 0]
    context = windows.context[:, start]
    measured = model.kinematics.outputs(states, next_states, log.time_step)
    gains, errors = _gains(model, states, inputs, context, measured)
    slopes = _mean_slopes(model, states, inputs, context)
    deviation = measured.std(axis=0)
    deviation = np.where(deviation > 0, deviation, np.inf)
    names = log.different_input_names
    significance = _significance(gains, errors)
    effects = _effects(model, names, gains, errors, slopes)
    unknown = _unknown_effects(log, inputs, significance)
    faults = [*unknown.values()]
    moves = np.abs(slopes) * np.ptp(inputs, axis=0) / deviation[:, None]
    if moves.max() < _LEAST_EFFECT:
        faults.append("no output of the model depends on any input")
    advice = _excitation(log, names, inputs) if faults else ()
    faults += _hidden_motions(model, log, stride)
    significant = [effect for effect in effects if effect.input not in unknown]
    warnings = _disagreements(significant) + _unstable_loops(model, log, rivals)
    warnings += unflown_disturbance(model)
    return ControlFitness(tuple(effects), tuple(faults), tuple(warnings), advice)


def unflown_disturbance(model: LogModel) -> list[str]:
    """Says that a model was judged with a disturbance that no controller has of it."""
    rows = max(model.history)
    if not rows:
        return []
    outputs = model.kinematics.output_names
    names = [name for name, own in zip(outputs, model.history, strict=True) if own]
    gain = 2 / (rows + 1)  # of the exponential mean that is as old as that of the rows
    return [
        f"predictions that were judged begin with the mean error of {', '.join(names)} "
        f"over the last {rows} rows, which is no part of the model: a controller "
        f"estimates it with disturbance_gain={gain:.1g}, and errs more without"
    ]


def _effects(
    model: LogModel, names: Sequence[str], gains: Array, errors: Array, slopes: Array
) -> list[Effect]:
    """Returns the effect of each input on the output that it moves most.

    Args:
        model: Has the names of the outputs.
        names: Of the inputs (m,).
        gains: Of the outputs by the inputs, from the rows (o, m).
        errors: Their standard errors (o, m).
        slopes: Mean derivatives of the model (o, m).
    """
    significance = _significance(gains, errors)
    effects = []
    for j, name in enumerate(names):
        i = int(significance[:, j].argmax())
        half_width = 1.96 * errors[i, j]
        effect = Effect(
            input=name,
            output=model.kinematics.output_names[i],
            gain=float(gains[i, j]),
            low=float(gains[i, j] - half_width),
            high=float(gains[i, j] + half_width),
            model=float(slopes[i, j]),
        )
        effects.append(effect)
    return effects


def _significance(gains: Array, errors: Array) -> Array:
    """Computes by how many standard errors gains (o, m) differ from none."""
    return np.abs(gains) / np.maximum(errors, 1e-300)


def _disagreements(effects: Sequence[Effect]) -> list[str]:
    """Says of which effects the model and the rows do not agree."""
    return [
        f"the model says {effect.model:.3g} for the effect of {effect.input} on "
        f"{effect.output}, the rows {effect.low:.3g} to {effect.high:.3g}"
        for effect in effects
        if not _agree(effect.model, effect.low, effect.high)
    ]


def _agree(model: float, low: float, high: float) -> bool:
    """Returns whether a derivative is about inside an interval, and has its sign.

    The interval is of an effect that differs from none.
    """
    half = (high - low) / 2
    centre = (high + low) / 2
    has_sign = model * centre > 0
    return has_sign and abs(model - centre) <= 2 * half + 0.5 * abs(centre)


def _gains(
    model: LogModel, states: Array, inputs: Array, context: Array, measured: Array
) -> tuple[Array, Array]:
    """Regresses outputs on features; returns the inputs' gains and standard errors.

    Both are (o, m). Residuals may be correlated within blocks of rows.
    """
    features = model.kinematics.features(states, inputs, context)
    m = inputs.shape[1]
    first = features.shape[1] - context.shape[1] - m
    scales = Standardization.of(features)
    deviation = scales.deviation
    z = np.column_stack([scales(features), np.ones(len(features))])
    inverse = np.linalg.pinv(z.T @ z, rcond=1e-10)
    weights = inverse @ (z.T @ measured)  # (f + 1, o)
    residuals = measured - z @ weights
    columns = slice(first, first + m)
    gains = (weights[columns] / deviation[columns, None]).T
    influence = z @ inverse[:, columns]  # (N, m)
    scores = influence[:, None, :] * residuals[:, :, None]  # (N, o, m)
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), _BLOCK))
    errors = np.sqrt(np.square(blocks).sum(axis=0)) / deviation[columns]
    return gains, errors


def _mean_slopes(
    model: LogModel, states: Array, inputs: Array, context: Array
) -> Array:
    """Computes the mean derivatives of a model's outputs by the inputs (o, m)."""
    every = max(len(states) // 1000, 1)
    x = states[::every]
    u = inputs[::every]
    c = context[::every]
    columns = []
    for h in _DIFFERENCE * np.diag(widths_of(inputs)):
        change = model.outputs(x, u + h, c) - model.outputs(x, u - h, c)
        columns.append(change.mean(axis=0) / (2 * h.sum()))
    return np.stack(columns, axis=-1)


def _unknown_effects(log: Log, inputs: Array, significance: Array) -> dict[str, str]:
    """Returns the inputs whose effect the rows cannot tell, with the reason."""
    dependence = input_dependence(log)
    reasons = {}
    for j, name in enumerate(log.different_input_names):
        variance = float(inputs[:, j].var())
        if variance <= 1e-20 * max(float(np.square(inputs[:, j]).mean()), 1e-300):
            reasons[name] = f"{name} does not move in the log: its effect is not known"
            continue
        followed = dependence.get(name, 0.0)
        if followed > FOLLOWS:
            reasons[name] = (
                f"{name} follows the states ({followed:.1%} of its variance): what it "
                "does by itself is not known"
            )
        elif significance[:, j].max() < _SIGNIFICANT:
            reasons[name] = (
                f"no effect of {name} shows in the log: it moves too little, or it has "
                "none"
            )
    return reasons


def _hidden_motions(model: LogModel, log: Log, stride: int) -> list[str]:
    """Says of which states only the rows before tell where they go.

    A position without its velocity carries no momentum: what a model misses of its
    movement is in the movements of the two rows before. White noise of a sensor is
    told by the rows before as well, but no more than half of it.
    """
    kinematics = model.kinematics
    if isinstance(kinematics, RigidBodyKinematics):
        return []  # whose state has all velocities
    start = max(model.past, 2)  # row of the windows
    try:
        windows = log.windows(1, past=start, stride=stride)
    except DataError:
        return []
    measured, modelled = model.first_outputs(windows)
    missed = measured - modelled
    states = windows.states
    context = windows.context[:, start]
    columns = [kinematics.features(states[:, start], windows.inputs[:, start], context)]
    for row in (start - 2, start - 1):
        columns.append(
            kinematics.outputs(states[:, row], states[:, row + 1], log.time_step)
        )
    regressors = np.hstack(columns)
    rows, count = regressors.shape
    if rows < _ROWS_A_REGRESSOR * count:
        return []
    regressors -= regressors.mean(axis=0)
    weights = fit_affine(regressors, missed)
    unexplained = (missed - regressors @ weights[:-1]).var(axis=0)
    unexplained *= rows / (rows - count)  # without the bias of as many weights
    is_hidden = (missed.var(axis=0) > _MISSED * measured.var(axis=0)) & (
        unexplained < _TOLD_BY_PAST * missed.var(axis=0)
    )
    hidden = [kinematics.output_names[i] for i in np.flatnonzero(is_hidden)]
    if not hidden:
        return []
    names = ", ".join(hidden)
    return [
        f"the states do not say where they go: the rows before tell {names} better "
        "than the model. Add the velocity as a state, or a column with the "
        "difference from the row before"
    ]


def _excitation(log: Log, names: Sequence[str], inputs: Array) -> tuple[str, ...]:
    """Returns what to fly, so that the effects of the inputs can be told."""
    dither = ", ".join(f"{_DITHER * width:.2g}" for width in widths_of(inputs))
    seconds = max(60.0, 500 * log.time_step)
    return (
        f"fly again for {seconds:.0f} s with noise added to the inputs "
        f"({', '.join(names)}), a tenth of the range that each has in this log: "
        f"gpmpc run ... noise.input=[{dither}] steps={seconds / log.time_step:.0f}",
    )


def _unstable_loops(
    model: LogModel, log: Log, rivals: Mapping[str, LogModel]
) -> list[str]:
    """Tries feedbacks designed on a model on the other candidates.

    They are of linear quadratic regulators about some states of the log, in units of
    the deviations that states and inputs have in it.
    """
    windows = log.windows(1)
    states = windows.states[:, 0]
    inputs = windows.inputs[:, 0]
    features = model.kinematics.features(states, inputs, windows.context[:, 0])
    rows = choose_rows(features, _STATES)
    context = windows.context[rows, 0]
    space = model.kinematics.space
    spread = space.difference(states, states[:1]).std(axis=0)
    spread = np.where(spread > 0, spread, state_widths(space, states))
    input_spread = inputs.std(axis=0)
    input_spread = np.where(input_spread > 0, input_spread, widths_of(inputs))

    def linearize(model: LogModel) -> tuple[Array, Array]:
        A, B = _linearize(model, states[rows], inputs[rows], context, log.time_step)
        scaled_A = A * spread / spread[:, None]
        return scaled_A, B * input_spread / spread[:, None]

    A, B = linearize(model)
    sentences = []
    for name, rival in rivals.items():
        rival_A, rival_B = linearize(rival)
        tried = 0
        unstable = 0
        for k in range(len(rows)):
            K = _regulator(A[k], B[k])
            if K is None:
                continue
            tried += 1
            loop = rival_A[k] - rival_B[k] @ K
            if not np.isfinite(loop).all():
                unstable += 1
                continue
            poles = np.linalg.eigvals(loop)
            unstable += bool(np.abs(poles).max() > _UNSTABLE)
        if unstable > tried / 2:
            sentences.append(
                f"a feedback designed on the model makes the candidate {name!r} "
                f"unstable about {unstable} of {tried} states of the log"
            )
    return sentences


def _regulator(A: Array, B: Array) -> Array | None:
    """Returns the gain of u = -K x, whose weights are ones.

    There is none, None, where none stabilises.
    """
    R = np.eye(B.shape[1])
    try:
        P = solve_discrete_are(A, B, np.eye(len(A)), R)
    except (LinAlgError, ValueError):
        return None
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def _linearize(
    model: LogModel, states: Array, inputs: Array, context: Array, time_step: float
) -> tuple[Array, Array]:
    """Linearises one step about states: derivatives (K, e, e) and (K, e, m).

    They are differences over small parts of the ranges that states and inputs have.
    """
    space = model.kinematics.space
    x_steps = _DIFFERENCE * widths_of(space.difference(states, states[:1]))
    u_steps = _DIFFERENCE * widths_of(inputs)

    def predict(x: Array, u: Array) -> Array:
        return model.kinematics.step(x, model.outputs(x, u, context), time_step)

    by_state = []
    for h in np.diag(x_steps):
        forward = predict(space.displace(states, h), inputs)
        backward = predict(space.displace(states, -h), inputs)
        by_state.append(space.difference(forward, backward) / (2 * h.sum()))
    by_input = []
    for h in np.diag(u_steps):
        forward = predict(states, inputs + h)
        backward = predict(states, inputs - h)
        by_input.append(space.difference(forward, backward) / (2 * h.sum()))
    return np.stack(by_state, axis=-1), np.stack(by_input, axis=-1)
