"""The delay of an input, estimated from a log by correlation, with a confidence interval.

What a state changes by in a step correlates with the input that acts in it. For every delay tau the changes are
regressed on the state and on the input tau steps earlier (between two steps on both, as a ``DelayedModel`` has it),

    x[k+1] - x[k] = C (1, x[k]) + D v_k(tau) + e,      correlation^2 = 1 - |Sigma_e(tau)| / |Sigma_e without v|

and the delay with the largest correlation is the estimate: the maximum of the likelihood for Gaussian e. The state is
part of the regression because in a closed loop the input depends on it. Errors e are correlated in time where the
system is nonlinear; so the interval comes from resampling blocks of rows, not from the likelihood (moving-block
bootstrap: Kuensch, 1989).

What the input of a delay changes can be told from what the state does by itself only where that input is no function of
the state: one that is constant, that moves with another one, or that a feedback alone makes says nothing of a delay.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc._angles import wrap
from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError, SettingError, ShapeError, check_number

_DEPENDENT = (
    1e-8  # share of a square that a regression leaves, below which it leaves nothing
)
_RIDGE = 1e-9  # of columns of unit square: some draws of rows do not tell them apart


@dataclass(frozen=True)
class DelayEstimate:
    """An estimated delay."""

    steps: float  #: the delay with the largest correlation [steps]
    interval: tuple[
        float, float
    ]  #: that holds the delay with the confidence asked for [steps]
    delays: Array  #: all that were tried (T,) [steps]
    correlations: Array  #: of each (T,), from 0 to 1


def estimate_delay(
    states: Any,
    inputs: Any,
    longest: int = 10,
    resolution: float = 0.1,
    confidence: float = 0.95,
    resamples: int = 200,
    seed: int = 0,
    angles: Sequence[int] = (),
) -> DelayEstimate:
    """Estimates by how many steps an input acts late.

    Args:
        states: x_0 .. x_T of one log at equal time steps (T + 1, n).
        inputs: u_0 .. u_{T-1} (T, m) or one more; they must move independently of the state now and then.
        longest: The longest delay that is tried [steps].
        resolution: Steps between two delays that are tried; 1 for whole ones only.
        confidence: Of the interval.
        resamples: How often blocks of rows are drawn again for the interval.
        seed: Of the draws.
        angles: Indices of the states that are angles [rad], which a sensor may show within a turn.

    Raises:
        ShapeError: The two do not belong together.
        DataError: There are too few rows, or an entry is not finite; or the data cannot tell: no state changes, an
            input is constant, two of them move alike, or they are functions of the state (feedback alone).
    """
    x = np.asarray(states, dtype=float)
    u = np.asarray(inputs, dtype=float)
    check_number("longest", longest, least=1, whole=True)
    check_number("resolution", resolution, above=0)
    if x.ndim != 2 or u.ndim != 2 or len(u) not in (len(x) - 1, len(x)):
        raise ShapeError(
            f"states (T + 1, n) and inputs (T, m) must be one log; got {x.shape} and {u.shape}"
        )
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        raise DataError("states and inputs must be finite")
    (_, n), m = x.shape, u.shape[1]
    rows = np.arange(longest, len(x) - 1)
    if len(rows) < 5 * (1 + n + m):
        raise DataError(
            f"a delay of up to {longest} steps needs {longest + 5 * (1 + n + m) + 1} rows; got {len(x)}"
        )
    x = _without_jumps(x, angles)
    u = _standardized_inputs(u)
    changes = np.diff(x, axis=0)[rows]
    moving = np.ptp(changes, axis=0) > 0
    if not moving.any():
        raise DataError(
            "no state moves, but at a constant pace: the data cannot tell the delay of an input"
        )
    known = _orthonormal(x[rows])
    changes = changes[:, moving] - changes[:, moving].mean(axis=0)
    changes = _without(known, changes / np.linalg.norm(changes, axis=0))
    delays: Array = (
        np.arange(0, longest + resolution / 2, resolution).astype(np.float64).round(9)
    )
    length = int(np.ceil(len(rows) ** (1 / 3)) * 2)
    starts = np.arange(0, len(rows) - length + 1, length)
    # [known, v, change]' [known, v, change] of each block of rows, for every delay
    grams = []
    for delay in delays:
        acting = _acting_inputs(u, rows, float(delay))
        regressors = _independent_inputs(known, acting, float(delay))
        table = np.column_stack([known, regressors, changes])
        blocks = np.stack(
            [table[s : s + length] for s in [*starts[:-1], len(rows) - length]]
        )
        grams.append(blocks.swapaxes(1, 2) @ blocks)
    gram = np.stack(grams)  # (delays, blocks, d, d)
    rng = np.random.default_rng(seed)
    sizes = known.shape[1], known.shape[1] + m
    scores = _log_determinants(gram.sum(1), *sizes)
    counts = rng.multinomial(
        gram.shape[1], np.full(gram.shape[1], 1 / gram.shape[1]), size=resamples
    )
    drawn = [
        delays[np.argmax(_log_determinants(np.tensordot(gram, c, (1, 0)), *sizes))]
        for c in counts
    ]
    low, high = np.quantile(
        drawn, [(1 - confidence) / 2, (1 + confidence) / 2], method="inverted_cdf"
    )
    best = delays[np.argmax(scores)]
    half = resolution / 2 if resolution < 1 else 0.0
    interval = float(max(min(low, best) - half, 0)), float(max(high, best) + half)
    return DelayEstimate(float(best), interval, delays, np.sqrt(-np.expm1(-scores)))


def _without_jumps(states: Array, angles: Sequence[int]) -> Array:
    """States (T + 1, n) whose angles count turns from the first row on."""
    places = list(angles)
    if any(not 0 <= i < states.shape[1] for i in places):
        raise SettingError(
            "angles",
            f"must be indices of {states.shape[1]} states from 0 on; got {places}",
        )
    counted = states.copy()
    changes = wrap(np.diff(states[:, places], axis=0))
    counted[1:, places] = states[0, places] + np.cumsum(changes, axis=0)
    return counted


def _standardized_inputs(inputs: Array) -> Array:
    """Inputs (T, m) of mean zero and unit square; ``DataError`` where one does not move, or two move alike."""
    sizes = np.abs(inputs).max(axis=0)
    centred = inputs - inputs.mean(axis=0)
    squares = np.square(centred).sum(axis=0)
    for j in range(inputs.shape[1]):
        round_off = len(inputs) * np.square(1e-14 * sizes[j])
        if squares[j] <= round_off:
            raise DataError(
                f"input {j + 1} is constant: the data cannot tell its delay; "
                "let it move, or leave the column out"
            )
    standardized = centred / np.sqrt(squares)
    _check_different(standardized)
    return standardized


def _check_different(inputs: Array) -> None:
    """Raises ``DataError`` where one of inputs (T, m), of unit square, is a sum of others."""
    for j in range(1, inputs.shape[1]):
        before = _orthonormal(inputs[:, :j], constant=False)
        left = _without(before, inputs[:, j : j + 1])
        if np.square(left).sum() > _DEPENDENT:
            continue
        likeness = np.square(inputs[:, :j].T @ inputs[:, j])
        alike = int(np.argmax(likeness))
        if likeness[alike] > 1 - _DEPENDENT:
            what = f"inputs {alike + 1} and {j + 1} move alike (equal but for scale and offset)"
        else:
            what = f"input {j + 1} is a sum of those before it"
        raise DataError(
            f"{what}: the data cannot tell what each of them does; leave one out"
        )


def _acting_inputs(inputs: Array, rows: np.ndarray, delay: float) -> Array:
    """The inputs (rows, m) that act in each row with a delay [steps]."""
    whole = int(np.ceil(delay))
    share = delay - (whole - 1)  # of the older input
    newer = inputs[rows - max(whole - 1, 0)]
    return share * inputs[rows - whole] + (1 - share) * newer


def _independent_inputs(known: Array, acting: Array, delay: float) -> Array:
    """What the state does not determine of the inputs that act (rows, m), of unit square.

    Raises ``DataError`` where that is nothing.
    """
    sizes = np.square(acting - acting.mean(axis=0)).sum(axis=0)
    left = _without(known, acting)
    shares = np.square(left).sum(axis=0)
    for j in np.flatnonzero(shares <= _DEPENDENT * sizes):
        raise DataError(
            f"input {j + 1} of {delay:g} steps before is a function of the state, as under feedback alone: "
            "what it does cannot be told from what the state does by itself, and the data cannot tell the delay; "
            "add an excitation that does not follow the state"
        )
    return left / np.sqrt(shares)


def _orthonormal(columns: Array, constant: bool = True) -> Array:
    """Orthonormal columns (rows, r) of the same span as some (rows, c), and a constant.

    Offsets and scales do not count, and columns that depend on others add nothing.
    """
    count = len(columns)
    centred = columns - columns.mean(axis=0) if constant else columns
    sizes = np.linalg.norm(centred, axis=0)
    moving = sizes > 1e-14 * np.sqrt(count) * np.abs(columns).max(axis=0)
    scaled = centred[:, moving] / sizes[moving]
    vectors, lengths, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = vectors[:, lengths > 1e-10 * lengths.max(initial=0.0)]
    if not constant:
        return basis
    return np.column_stack([np.full(count, 1 / np.sqrt(count)), basis])


def _without(known: Array, columns: Array) -> Array:
    """What orthonormal columns (rows, r) do not explain of others (rows, c)."""
    remainder = columns - known @ (known.T @ columns)
    return remainder - known @ (known.T @ remainder)  # once more, against round-off


def _log_determinants(gram: Array, known: int, regressors: int) -> Array:
    """Log |Sigma_e without v| - log |Sigma_e| of each gram matrix (T, d, d) of (known, v, change)."""
    logs = []
    for count in (known, regressors):
        of_regressors = gram[:, :count, :count] + _RIDGE * np.eye(count)
        with_changes = gram[:, :count, regressors:]
        of_changes = gram[:, regressors:, regressors:]
        explained = np.linalg.solve(of_regressors, with_changes)
        remainder = of_changes - with_changes.swapaxes(1, 2) @ explained
        # a state that is determined by the others (an integrated one) must not count as known exactly
        remainder = remainder + _RIDGE * np.eye(remainder.shape[-1])
        logs.append(np.linalg.slogdet(remainder)[1])
    return np.maximum(logs[0] - logs[1], 0.0)
