"""Checks that the states of a rigid body are what their mapping says.

Three relations are judged in windows of a fifth of a second:

1. the mean velocity is the change of the position over the time;
2. the mean angular rate is the turn of the attitude over the time;
3. a vehicle that is carried along its own axis z (a multirotor, a boat, a banking
   aeroplane) accelerates to where it tilts: a_xy / (a_z + g) = t_xy / t_z, with t the
   body's axis z in world axes. Only gravity tells up from down.

Where the claim of the mapping fits badly, other readings of the same columns are tried:
the order of a quaternion, its inverse, axes, signs, columns that changed places, units,
lags. The one that fits with the fewest changes is named. Where the third relation fits
no reading, such as that of a car, it says nothing.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gpmpc.exceptions import DataError
from gpmpc.logs._attitude_readings import (
    AttitudeReading,
    words_of_columns,
    words_of_turned_body,
)
from gpmpc.logs._axis_fits import FEWEST, SHORTEST_LAG, AxisFit
from gpmpc.logs._frames import FRD, NAMES, NED, Claim
from gpmpc.logs._kinematics import GRAVITY, Array
from gpmpc.logs._log import Finding, LogRun
from gpmpc.logs._mapping import LogMapping, Signal
from gpmpc.logs._reading_search import (
    ANGLES,
    DOUBTFUL,
    HALF,
    LENGTHS,
    LONGEST_LAG,
    RATES,
    SPEEDS,
    TILT_FITS,
    Reading,
    ReadingSearch,
    Relation,
    cut_motion_windows,
    fits_tilt,
    unit_and_axes,
    unit_factor,
)
from gpmpc.logs._units import is_known

_RIGID_BODY = [("vector", 3), ("quaternion", 3), ("vector", 3), ("vector", 3)]
FITS = 0.75  # misfit below which an axis may fit
BAD = 0.8  # misfit from which an axis fits badly
UNRELATED = 0.5  # correlation below which signals have nothing to do with each other
NEAR = 0.25  # of the score within which two readings cannot be told apart
GAIN = 0.3  # least gain of a score for which a reading is believed
LEAST_REFUSED_LAG = 0.15  # [s]; a shorter one is a finding


def read_rigid_bodies(
    runs: Sequence[LogRun], step: float, mapping: LogMapping
) -> tuple[list[LogRun], list[Finding]]:
    """Brings states to ENU and FLU axes, velocities to world and rates to body axes.

    Returns:
        The runs, and what was noticed.

    Raises:
        DataError: The states are not those of a rigid body, or contradict the mapping.
    """
    signals = mapping.of("states")
    kinds = [(signal.group.kind, signal.group.error_dim) for signal in signals]
    if kinds != _RIGID_BODY:
        names = ", ".join(signal.name for signal in signals)
        raise DataError(
            "a rigid body's states are position (3), attitude (quaternion or Euler "
            "angles), velocity (3) and angular rate (3), in this order; the mapping "
            f"has {names}"
        )
    claim = Claim(mapping)
    findings = check_conventions(runs, step, claim)
    return [replace(run, states=claim.read(run.states)) for run in runs], findings


def check_conventions(
    runs: Sequence[LogRun], step: float, claim: Claim
) -> list[Finding]:
    """Checks every run that is long enough, and all short ones together.

    Raises:
        DataError: The states contradict the mapping; the text says what fits.
    """
    findings: list[Finding] = []
    short: list[LogRun] = []
    for run in runs:
        if len(run) * step >= 4 * LONGEST_LAG and len(run) > 4 * FEWEST:
            where = f"run {run.name}: " if len(runs) > 1 else ""
            findings += _check([run], step, claim, where)
        else:
            short.append(run)
    if short:
        findings += _check(short, step, claim, "")
    return findings


def _check(
    runs: Sequence[LogRun], step: float, claim: Claim, where: str
) -> list[Finding]:
    """Refuses what another reading explains, or what nothing explains."""
    windows = cut_motion_windows(runs, step, claim)
    if windows is None:
        return []
    search = ReadingSearch(windows, claim)
    claimed = search.claimed()
    name = runs[0].name
    if not _is_doubtful(search, claimed):
        return _noticed(search, claimed, name)
    readings = sorted(search.readings(), key=lambda reading: reading.score)
    best = readings[0] if readings else claimed
    if _is_better(best, claimed):
        text = "; and ".join(_sentences(best, search))
        if _is_short_lag(best):
            return [Finding("late", name, 1, text), *_noticed(search, claimed, name)]
        other = _near_reading(readings, search)
        raise DataError(f"{where}{text}{other} ({_numbers(search)})")
    unexplained = _unexplained(search, claimed)
    if unexplained:
        raise DataError(
            f"{where}{unexplained}, and contradicts the mapping: no single change of "
            f"order, axes, signs, units or lag explains it ({_numbers(search)})"
        )
    return _noticed(search, claimed, name)


def _is_short_lag(best: Reading) -> bool:
    """Whether all that is wrong is a lag too short to refuse."""
    fits = best.velocity, best.rate
    is_short = all(abs(fit.lag) < LEAST_REFUSED_LAG for fit in fits)
    return is_short and best.cost == sum(fit.lag != 0 for fit in fits)


def _near_reading(readings: Sequence[Reading], search: ReadingSearch) -> str:
    """Another reading that fits as well as the best, in words; mostly empty."""
    best = _sentences(readings[0], search)
    for reading in readings[1:]:
        if reading.score > readings[0].score + NEAR:
            break
        sentences = _sentences(reading, search)
        if sentences != best and len(sentences) <= len(best):
            return f"; or else: {'; and '.join(sentences)}"
    return ""


def _is_doubtful(search: ReadingSearch, claimed: Reading) -> bool:
    """Whether it is worth while to look for another reading."""
    if max(claimed.velocity.misfits.max(), claimed.rate.misfits.max()) > DOUBTFUL:
        return True
    if claimed.tilt is not None and not fits_tilt(claimed.tilt):
        return True
    return max(map(abs, search.claimed_lags())) >= SHORTEST_LAG


def _is_better(best: Reading, claimed: Reading) -> bool:
    """Whether a reading explains what the claim does not."""
    if claimed.score - best.score < GAIN:
        return False
    for fit, own in ((best.velocity, claimed.velocity), (best.rate, claimed.rate)):
        is_better = (fit.misfits < FITS) & (fit.misfits < HALF * own.misfits)
        if (is_better & (own.misfits > DOUBTFUL)).any():
            return True
    if claimed.tilt is None or best.tilt is None or not fits_tilt(best.tilt):
        return False
    is_better = best.tilt < TILT_FITS * claimed.tilt
    return bool((is_better & (claimed.tilt > TILT_FITS)).any())


def _noticed(search: ReadingSearch, claimed: Reading, run: str) -> list[Finding]:
    """What is unusual, and no contradiction."""
    claim = search.claim
    name = claim.attitude.name
    findings = []
    if claimed.lift < GRAVITY[2] / 2:
        other = "ned" if claim.axes[claim.rate.name] == "enu" else "enu"
        _, other_body = NAMES[other]
        text = (
            f"the force that carries the body points along its own underside "
            f"({claimed.lift:.1f} m/s2): it flies on its back, or {name} is that of a "
            f"body in {other_body} axes, and so are its rates: write "
            f"{words_of_turned_body(claim.attitude)}, and axes: {other} for "
            f"{claim.rate.name}"
        )
        findings.append(Finding("upside down", run, 1, text))
    lag = search.tilt_lag(claimed)
    if lag:
        place = f"{claim.position.name} and {claim.velocity.name}"
        turn = f"{name} and {claim.rate.name}"
        late, early = (place, turn) if lag > 0 else (turn, place)
        text = (
            f"{late} come about {abs(lag):.1f} s after {early}: do their clocks agree?"
        )
        findings.append(Finding("late", run, 1, text))
    return findings


def _unexplained(search: ReadingSearch, claimed: Reading) -> str:
    """Which derivative has nothing to do with its signal, though neither is noise."""
    for relation, fit in zip(
        search.relations, (claimed.velocity, claimed.rate), strict=True
    ):
        correlations = relation.correlations
        unrelated = (fit.misfits > BAD) & (np.abs(correlations) < UNRELATED)
        for axis in np.flatnonzero(unrelated & relation.moves & relation.is_smooth):
            return (
                f"{relation.measured.name} in {'xyz'[axis]} has nothing to do with "
                f"the derivative of {relation.derived.name}"
            )
    return ""


def _numbers(search: ReadingSearch) -> str:
    """The correlations of what the mapping says."""
    words = []
    for relation in search.relations:
        numbers = ", ".join(f"{number:.2f}" for number in relation.correlations)
        words.append(f"{relation.measured.name} {numbers}")
    return (
        f"correlations with the derivatives, as the mapping reads x, y, z: "
        f"{'; '.join(words)}"
    )


def _sentences(best: Reading, search: ReadingSearch) -> list[str]:
    """What is so, and what to write into the mapping, a sentence a mistake."""
    claim = search.claim
    if search.is_other_frame(best):
        other = "ned" if claim.frame == "enu" else "enu"
        (world, body), (other_world, other_body) = NAMES[claim.frame], NAMES[other]
        return [
            f"gravity says that all states are in {other_world} axes of the world and "
            f"{other_body} axes of the body, not in {world} and {body}: "
            f"write frame: {other}"
        ]
    words = [best.attitude.advice] if best.attitude.advice else []
    words += _position_words(best, search)
    words += _fit_words(
        search=search,
        relation=search.relations[1],
        fit=best.rate,
        frame=best.rate_frame,
        units=(RATES, ANGLES),
        attitude=best.attitude,
    )
    return words


def _position_words(best: Reading, search: ReadingSearch) -> list[str]:
    """What position and velocity are."""
    claim = search.claim
    relation = search.relations[0]
    fit = best.velocity
    unit, axes = unit_and_axes(best.position)
    words = []
    if unit != 1 and (fit.factors == 1).all():
        true_unit = unit_factor(claim.position) / unit
        words.append(
            f"{claim.position.name} and {claim.velocity.name} are {unit:.3g} times "
            f"what gravity says; are their units right? write "
            f"{_unit_advice(claim.position, LENGTHS, true_unit)} and "
            f"{_unit_advice(claim.velocity, SPEEDS, true_unit)}"
        )
    if not np.array_equal(axes, np.eye(3)):
        words.append(_axes_words(claim, claim.position, "world", axes))
        if best.velocity_frame == "world":
            fit = replace(fit, matrix=fit.matrix @ axes)
    units = (SPEEDS, LENGTHS)
    if np.allclose(fit.factors * unit, 1):
        units = ({}, LENGTHS)  # gravity says that the velocity's is right
    return words + _fit_words(
        search=search,
        relation=relation,
        fit=fit,
        frame=best.velocity_frame,
        units=units,
        attitude=best.attitude,
    )


def _fit_words(
    search: ReadingSearch,
    relation: Relation,
    fit: AxisFit,
    frame: str,
    units: tuple[dict[str, float], dict[str, float]],
    attitude: AttitudeReading,
) -> list[str]:
    """What a velocity or rate is of the derivative that it should be."""
    signal = relation.measured
    of = relation.derived
    words = []
    if frame != relation.frame:
        correlation = search.correlation_in(relation, attitude, frame)
        words.append(
            f"{signal.name} is the derivative of {of.name} in {frame} axes "
            f"(correlation {correlation:.2f}), not in {relation.frame} axes, as the "
            f"mapping says: write frame: {frame} for {signal.name}"
        )
    if not np.array_equal(fit.matrix, np.eye(3)):
        words.append(_axes_words(search.claim, signal, frame, fit.matrix))
    if (fit.factors != 1).any():
        words.append(_unit_words(signal, of, fit.factors, units))
    if fit.lag:
        late, early = (signal, of) if fit.lag > 0 else (of, signal)
        words.append(
            f"{late.name} comes {abs(fit.lag):.2g} s after {early.name}: "
            f"write delay: {abs(fit.lag):.2g} for {late.name}"
        )
    return words


def _axes_words(claim: Claim, signal: Signal, frame: str, matrix: Array) -> str:
    """What axes a vector is in, whose read axes are a matrix times the true ones."""
    said = claim.axes[signal.name]
    other = "ned" if said == "enu" else "enu"
    place = 0 if frame == "world" else 1
    if np.array_equal(matrix, NED if frame == "world" else FRD):
        return (
            f"{signal.name} is in {NAMES[other][place]} axes, not in "
            f"{NAMES[said][place]}: write axes: {other} for {signal.name}"
        )
    to_enu = claim.to_enu(signal, frame)
    inverse = (to_enu @ matrix @ to_enu).T  # from the file's axes to the true ones
    order = np.abs(inverse).argmax(axis=1).tolist()
    signs = inverse.sum(axis=1)
    flipped = sorted("xyz"[order[axis]] for axis in range(3) if signs[axis] < 0)
    parts = []
    if order != [0, 1, 2]:
        moved = [f"{'xyz'[axis]}" for axis in range(3) if order[axis] != axis]
        parts.append(f"{' and '.join(moved)} of {signal.name} have changed places")
    if len(flipped) == 3:
        parts.append(f"{signal.name} has the opposite sign")
    elif flipped:
        verb = "has" if len(flipped) == 1 else "have"
        parts.append(
            f"{' and '.join(flipped)} of {signal.name} {verb} the opposite sign"
        )
    advice = words_of_columns(signal, order, signs)
    return f"{' and '.join(parts)}: write {advice}"


def _unit_words(
    signal: Signal,
    of: Signal,
    factors: Array,
    units: tuple[dict[str, float], dict[str, float]],
) -> str:
    """Which unit is another than the mapping says."""
    axes = np.flatnonzero(factors != 1)
    factor = float(factors[axes[0]])
    hint = "degrees for radians make a factor of 57"
    if len(axes) == 1:
        scale = np.where(factors == 1, 1.0, 1 / factors)
        return (
            f"{'xyz'[axes[0]]} of {signal.name} is {factor:.3g} times the derivative "
            f"of {of.name}; is its unit right? ({hint}) write "
            f"{words_of_columns(signal, (0, 1, 2), scale)}"
        )
    advice = " or ".join(
        words
        for words in (
            _unit_advice(signal, units[0], unit_factor(signal) / factor),
            _unit_advice(of, units[1], unit_factor(of) * factor),
        )
        if words
    )
    return (
        f"{signal.name} is {factor:.3g} times the derivative of {of.name}; is its "
        f"unit right? ({hint}){' write ' if advice else ''}{advice}"
    )


def _unit_advice(signal: Signal, units: dict[str, float], factor: float) -> str:
    """What to write where a signal's unit is such a factor; empty where none is."""
    names = [name for name, own in units.items() if abs(own / factor - 1) < 0.02]
    if not names:
        return ""
    if factor == 1 or is_known(names[0]):
        return f"unit: {names[0]} for {signal.name}"
    scale = units[names[0]] / unit_factor(signal)
    columns = range(len(signal.columns))
    return f"{words_of_columns(signal, columns, [scale] * len(columns))} ({names[0]})"
