"""Says which mistakes an interpretation supposes, and what to write instead."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._attitude_interpretations import AttitudeInterpretation
from gpmpc.logs._axis_fits import AxisFit
from gpmpc.logs._frames import FRD, NAMES, NED, Claim, other_convention
from gpmpc.logs._interpretations import (
    ANGLES,
    LENGTHS,
    RATES,
    SPEEDS,
    Interpretation,
    InterpretationSearch,
    unit_and_axes,
    unit_factor,
)
from gpmpc.logs._mapping import Signal
from gpmpc.logs._mapping_advice import advise_columns
from gpmpc.logs._relations import MotionRelations, Relation
from gpmpc.logs._units import is_known


class _Units(NamedTuple):
    """Units that may be the right ones, with their factors."""

    measured: dict[str, float]
    derived: dict[str, float]


def mistakes_of(best: Interpretation, search: InterpretationSearch) -> list[str]:
    """Describes the mistakes that an interpretation supposes, and what to write.

    Args:
        best: The interpretation.
        search: That has found it.

    Returns:
        A sentence a mistake.
    """
    claim = search.claim
    if search.is_other_frame(best):
        axes = other_convention(claim.default_axes)
        claimed_world, claimed_body = NAMES[claim.default_axes]
        world, body = NAMES[axes]
        return [
            f"gravity says that all states are in {world} axes of the world and "
            f"{body} axes of the body, not in {claimed_world} and {claimed_body}: "
            f"write frame: {axes}"
        ]
    _, of_rate = search.relations.claimed_relations
    sentences = [best.attitude.advice] if best.attitude.advice else []
    sentences += _position_mistakes(best, search)
    sentences += _fit_mistakes(
        relations=search.relations,
        relation=of_rate,
        fit=best.rate,
        frame=best.rate_frame,
        units=_Units(measured=RATES, derived=ANGLES),
        attitude=best.attitude,
    )
    return sentences


def _position_mistakes(best: Interpretation, search: InterpretationSearch) -> list[str]:
    """Describes what is wrong with position and velocity."""
    claim = search.claim
    of_velocity, _ = search.relations.claimed_relations
    fit = best.velocity
    unit, axes = unit_and_axes(best.position)
    sentences = []
    if unit != 1 and (fit.factors == 1).all():
        true_unit = unit_factor(claim.position) / unit
        sentences.append(
            f"{claim.position.name} and {claim.velocity.name} are {unit:.3g} times "
            f"what gravity says; are their units right? write "
            f"{_unit_advice(claim.position, LENGTHS, true_unit)} and "
            f"{_unit_advice(claim.velocity, SPEEDS, true_unit)}"
        )
    if not np.array_equal(axes, np.eye(3)):
        sentences.append(_axes_mistake(claim, claim.position, "world", axes))
        if best.velocity_frame == "world":
            fit = replace(fit, matrix=fit.matrix @ axes)
    units = _Units(measured=SPEEDS, derived=LENGTHS)
    if np.allclose(fit.factors * unit, 1):
        # Gravity says that the velocity's is right.
        units = _Units(measured={}, derived=LENGTHS)
    return sentences + _fit_mistakes(
        relations=search.relations,
        relation=of_velocity,
        fit=fit,
        frame=best.velocity_frame,
        units=units,
        attitude=best.attitude,
    )


def _fit_mistakes(
    relations: MotionRelations,
    relation: Relation,
    fit: AxisFit,
    frame: str,
    units: _Units,
    attitude: AttitudeInterpretation,
) -> list[str]:
    """Describes what a velocity or rate is of the derivative that it should be."""
    signal = relation.measured
    derived = relation.derived
    sentences = []
    if frame != relation.frame:
        correlation = relations.correlation_in(relation, attitude, frame)
        sentences.append(
            f"{signal.name} is the derivative of {derived.name} in {frame} axes "
            f"(correlation {correlation:.2f}), not in {relation.frame} axes, as the "
            f"mapping says: write frame: {frame} for {signal.name}"
        )
    if not np.array_equal(fit.matrix, np.eye(3)):
        sentences.append(_axes_mistake(relations.claim, signal, frame, fit.matrix))
    if (fit.factors != 1).any():
        sentences.append(_unit_mistake(signal, derived, fit.factors, units))
    if fit.lag:
        late, early = (signal, derived) if fit.lag > 0 else (derived, signal)
        sentences.append(
            f"{late.name} comes {abs(fit.lag):.2g} s after {early.name}: "
            f"write delay: {abs(fit.lag):.2g} for {late.name}"
        )
    return sentences


def _axes_mistake(claim: Claim, signal: Signal, frame: str, matrix: Array) -> str:
    """Describes the axes of a vector that are a matrix (3, 3) times the true ones."""
    claimed = claim.axes[signal.name]
    axes = other_convention(claimed)
    place = 0 if frame == "world" else 1
    if np.array_equal(matrix, NED if frame == "world" else FRD):
        return (
            f"{signal.name} is in {NAMES[axes][place]} axes, not in "
            f"{NAMES[claimed][place]}: write axes: {axes} for {signal.name}"
        )
    to_enu = claim.to_enu(signal, frame)
    inverse = (to_enu @ matrix @ to_enu).T  # from the file's axes to the true ones
    order = np.abs(inverse).argmax(axis=1).tolist()
    signs = inverse.sum(axis=1)
    flipped = sorted("xyz"[order[axis]] for axis in range(3) if signs[axis] < 0)
    mistakes = []
    if order != [0, 1, 2]:
        swapped = ["xyz"[axis] for axis in range(3) if order[axis] != axis]
        mistakes.append(f"{' and '.join(swapped)} of {signal.name} have changed places")
    if len(flipped) == 3:
        mistakes.append(f"{signal.name} has the opposite sign")
    elif flipped:
        verb = "has" if len(flipped) == 1 else "have"
        mistakes.append(
            f"{' and '.join(flipped)} of {signal.name} {verb} the opposite sign"
        )
    advice = advise_columns(signal, order, signs)
    return f"{' and '.join(mistakes)}: write {advice}"


def _unit_mistake(
    signal: Signal, derived: Signal, factors: Array, units: _Units
) -> str:
    """Describes which unit is another than the mapping says."""
    axes = np.flatnonzero(factors != 1)
    factor = float(factors[axes[0]])
    hint = "degrees for radians make a factor of 57"
    if len(axes) == 1:
        scale = np.where(factors == 1, 1.0, 1 / factors)
        return (
            f"{'xyz'[axes[0]]} of {signal.name} is {factor:.3g} times the derivative "
            f"of {derived.name}; is its unit right? ({hint}) write "
            f"{advise_columns(signal, (0, 1, 2), scale)}"
        )
    remedies = [
        _unit_advice(signal, units.measured, unit_factor(signal) / factor),
        _unit_advice(derived, units.derived, unit_factor(derived) * factor),
    ]
    remedies = [remedy for remedy in remedies if remedy]
    advice = f" write {' or '.join(remedies)}" if remedies else ""
    return (
        f"{signal.name} is {factor:.3g} times the derivative of {derived.name}; is its "
        f"unit right? ({hint}){advice}"
    )


def _unit_advice(signal: Signal, units: dict[str, float], factor: float) -> str:
    """Says what to write where a signal's unit is a factor; empty where none is."""
    names = [name for name, unit in units.items() if abs(unit / factor - 1) < 0.02]
    if not names:
        return ""
    if factor == 1 or is_known(names[0]):
        return f"unit: {names[0]} for {signal.name}"
    scale = units[names[0]] / unit_factor(signal)
    columns = range(len(signal.columns))
    return f"{advise_columns(signal, columns, [scale] * len(columns))} ({names[0]})"
