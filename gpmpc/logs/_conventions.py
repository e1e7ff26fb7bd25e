"""Checks that the states of a rigid body are what their mapping says.

Three relations are judged in windows of a fifth of a second:

1. the mean velocity is the change of the position over the time;
2. the mean angular rate is the turn of the attitude over the time;
3. a vehicle that is carried along its own axis z (a multirotor, a boat, a banking
   aeroplane) accelerates to where it tilts: a_xy / (a_z + g) = t_xy / t_z, with t the
   body's axis z in world axes. Only gravity tells up from down.

Where the claim of the mapping fits badly, other interpretations of the same columns are
tried: the order of a quaternion, its inverse, axes, signs, columns that changed places,
units, lags. The one that fits with the fewest changes is named. Where the third
relation fits no interpretation, such as that of a car, it says nothing.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gpmpc.exceptions import DataError
from gpmpc.logs._axis_fits import FEWEST, SHORTEST_LAG
from gpmpc.logs._findings import Finding
from gpmpc.logs._frames import NAMES, Claim, other_convention
from gpmpc.logs._interpretation_advice import mistakes_of
from gpmpc.logs._interpretations import (
    DOUBTFUL,
    Interpretation,
    InterpretationSearch,
)
from gpmpc.logs._log import LogRun
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._mapping_advice import advise_turned_body
from gpmpc.logs._motion_windows import LONGEST_LAG, cut_motion_windows
from gpmpc.logs._relations import BETTER_RATIO, TILT_FITS, MotionRelations, fits_tilt
from gpmpc.models._kinematics import GRAVITY

_RIGID_BODY = [("vector", 3), ("quaternion", 3), ("vector", 3), ("vector", 3)]
FITS = 0.75  # misfit below which an axis may fit
BAD_MISFIT = 0.8  # misfit from which an axis fits badly
UNRELATED = 0.5  # correlation below which signals have nothing to do with each other
SCORE_MARGIN = 0.25  # of the score within which interpretations cannot be told apart
GAIN = 0.3  # least gain of a score for which an interpretation is believed
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
    """Refuses states that another interpretation explains, or that nothing explains."""
    run = runs[0].name
    windows = cut_motion_windows(runs, step, claim)
    if windows is None:
        text = (
            "too few rows without a gap to tell whether axes, signs, units and orders "
            "are those of the mapping"
        )
        return [Finding("unchecked", run, sum(map(len, runs)), text)]
    relations = MotionRelations(windows, claim)
    search = InterpretationSearch(relations)
    claimed = search.claimed()
    if not _is_doubtful(relations, claimed):
        return _unusual(relations, claimed, run)
    candidates = sorted(search.candidates(), key=lambda candidate: candidate.score)
    best = candidates[0] if candidates else claimed
    if _is_better(best, claimed):
        text = "; and ".join(mistakes_of(best, search))
        if _is_short_lag(best):
            late = Finding("late", run, 1, text)
            return [late, *_unusual(relations, claimed, run)]
        alternative = _equal_alternative(candidates, search)
        numbers = _correlations(relations)
        raise DataError(f"{where}{text}{alternative} ({numbers})")
    unexplained = _unexplained(relations, claimed)
    if unexplained:
        raise DataError(
            f"{where}{unexplained}, and contradicts the mapping: no single change of "
            "order, axes, signs, units or lag explains it "
            f"({_correlations(relations)})"
        )
    return _unusual(relations, claimed, run)


def _is_short_lag(best: Interpretation) -> bool:
    """Tells whether all that is wrong is a lag too short to refuse."""
    fits = best.velocity, best.rate
    is_short = all(abs(fit.lag) < LEAST_REFUSED_LAG for fit in fits)
    return is_short and best.cost == sum(fit.lag != 0 for fit in fits)


def _equal_alternative(
    candidates: Sequence[Interpretation], search: InterpretationSearch
) -> str:
    """Describes another interpretation that fits as well as the best; mostly empty."""
    best = mistakes_of(candidates[0], search)
    for candidate in candidates[1:]:
        if candidate.score > candidates[0].score + SCORE_MARGIN:
            break
        mistakes = mistakes_of(candidate, search)
        if mistakes != best and len(mistakes) <= len(best):
            return f"; or else: {'; and '.join(mistakes)}"
    return ""


def _is_doubtful(relations: MotionRelations, claimed: Interpretation) -> bool:
    """Tells whether it is worth while to look for another interpretation."""
    if max(claimed.velocity.misfits.max(), claimed.rate.misfits.max()) > DOUBTFUL:
        return True
    if claimed.tilt is not None and not fits_tilt(claimed.tilt):
        return True
    return max(abs(lag) for lag in relations.claimed_lags()) >= SHORTEST_LAG


def _is_better(best: Interpretation, claimed: Interpretation) -> bool:
    """Tells whether an interpretation explains what the claim does not."""
    if claimed.score - best.score < GAIN:
        return False
    for fit, claim in ((best.velocity, claimed.velocity), (best.rate, claimed.rate)):
        is_better = (fit.misfits < FITS) & (fit.misfits < BETTER_RATIO * claim.misfits)
        if (is_better & (claim.misfits > DOUBTFUL)).any():
            return True
    if claimed.tilt is None or best.tilt is None or not fits_tilt(best.tilt):
        return False
    is_better = best.tilt < TILT_FITS * claimed.tilt
    return bool((is_better & (claimed.tilt > TILT_FITS)).any())


def _unusual(
    relations: MotionRelations, claimed: Interpretation, run: str
) -> list[Finding]:
    """Returns findings of what is unusual, and no contradiction."""
    findings = []
    if claimed.lift < GRAVITY[2] / 2:
        text = _upside_down(relations.claim, claimed.lift)
        findings.append(Finding("upside down", run, 1, text))
    lag = relations.tilt_lag(claimed.tilt)
    if lag:
        claim = relations.claim
        motion = f"{claim.position.name} and {claim.velocity.name}"
        turning = f"{claim.attitude.name} and {claim.rate.name}"
        late, early = (motion, turning) if lag > 0 else (turning, motion)
        text = (
            f"{late} come about {abs(lag):.1f} s after {early}: do their clocks agree?"
        )
        findings.append(Finding("late", run, 1, text))
    return findings


def _upside_down(claim: Claim, lift: float) -> str:
    axes = other_convention(claim.axes[claim.rate.name])
    _, body = NAMES[axes]
    return (
        f"the force that carries the body points along its own underside "
        f"({lift:.1f} m/s2): it flies on its back, or {claim.attitude.name} is that "
        f"of a body in {body} axes, and so are its rates: write "
        f"{advise_turned_body(claim.attitude)}, and axes: {axes} for "
        f"{claim.rate.name}"
    )


def _unexplained(relations: MotionRelations, claimed: Interpretation) -> str:
    """Names a signal that its derivative has nothing to do with; mostly none.

    Both are no noise.
    """
    fits = (claimed.velocity, claimed.rate)
    for relation, fit in zip(relations.claimed_relations, fits, strict=True):
        correlations = relation.correlations
        unrelated = (fit.misfits > BAD_MISFIT) & (np.abs(correlations) < UNRELATED)
        for axis in np.flatnonzero(unrelated & relation.moves & relation.is_smooth):
            return (
                f"{relation.measured.name} in {'xyz'[axis]} has nothing to do with "
                f"the derivative of {relation.derived.name}"
            )
    return ""


def _correlations(relations: MotionRelations) -> str:
    """Lists the correlations of what the mapping says, in words."""
    texts = []
    for relation in relations.claimed_relations:
        numbers = ", ".join(f"{number:.2f}" for number in relation.correlations)
        texts.append(f"{relation.measured.name} {numbers}")
    return (
        "correlations with the derivatives, as the mapping reads x, y, z: "
        f"{'; '.join(texts)}"
    )
