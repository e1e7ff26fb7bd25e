"""The delay of an input, estimated from a log by correlation.

What a state changes by in a step correlates with the input that acts in it. For every
delay tau the changes are regressed on the state and on the input tau steps earlier
(between two steps on both, as a ``DelayedModel`` has it),

    x[k+1] - x[k] = C (1, x[k]) + D v_k(tau) + e
    correlation^2 = 1 - |Sigma_e(tau)| / |Sigma_e without v|

and the delay with the largest correlation is the estimate: the maximum of the
likelihood for Gaussian e. The state is part of the regression because in a closed loop
the input depends on it. Errors e are correlated in time where the system is nonlinear;
so the interval comes from resampling blocks of rows that do not overlap (Carlstein,
1986), not from the likelihood. The blocks are of one length, 2 N^(1/3) of N rows; up to
a block less one row before the last is used by none, nor by the estimate.

What the input of a delay changes can be told from what the state does by itself only
where that input is no function of the state: one that is constant, that moves with
another one, or that a feedback alone makes says nothing of a delay.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc._angles import wrap
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_indices,
    check_number,
)

_log = logging.getLogger(__name__)

# Part of a square that a regression leaves, below which it leaves nothing.
_DEPENDENT = 1e-8
_RIDGE = 1e-9  # of columns of unit square: some draws of rows do not tell them apart


@dataclass(frozen=True, eq=False)
class DelayEstimate:
    """An estimated delay.

    See Also:
        ``estimate_delay``, which returns it.
    """

    steps: float  #: the delay with the largest correlation [steps]
    #: that holds the delay with the confidence asked for [steps]; where it reaches the
    #: longest that was tried, the delay may be longer
    interval: tuple[float, float]
    delays: Array  #: all that were tried (T,) [steps]
    correlations: Array  #: of each (T,), from 0 to 1


@explains_arguments
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
        inputs: u_0 .. u_{T-1} (T, m) or one more; they must move independently of the
            state now and then.
        longest: No longer delay is tried [steps]. Where the interval reaches it, a line
            of the log says so.
        resolution: Steps between two delays that are tried, from zero on; 1 for whole
            ones only.
        confidence: Of the interval, between 0 and 1.
        resamples: How often blocks of rows are drawn again for the interval; once at
            least.
        seed: Of the draws.
        angles: Indices of the states that are angles [rad], which a sensor may show
            within a turn.

    Raises:
        SettingError: A number is out of range, or an angle is no state.
        ShapeError: The two do not belong together.
        DataError: There are too few rows, or an entry is not finite; or the data cannot
            tell: no state changes, an input is constant, two of them move alike, or
            they are functions of the state (feedback alone).

    >>> import numpy as np
    >>> inputs = np.random.default_rng(0).normal(size=(200, 1))
    >>> late = np.vstack([np.zeros((3, 1)), inputs[:-2]]).cumsum(axis=0)
    >>> round(estimate_delay(late, inputs, longest=5).steps)
    2

    See Also:
        ``gpmpc.models.DelayedModel``, which holds inputs back.
    """
    x = np.asarray(states, dtype=float)
    u = np.asarray(inputs, dtype=float)
    check_number("longest", longest, least=1, whole=True)
    check_number("resolution", resolution, above=0)
    check_number("resamples", resamples, least=1, whole=True)
    check_number("seed", seed, least=0, whole=True)
    check_number("confidence", confidence)
    if not 0 < confidence < 1:
        raise SettingError("confidence", f"must lie between 0 and 1; got {confidence}")
    if x.ndim != 2 or u.ndim != 2 or len(u) not in (len(x) - 1, len(x)):
        raise ShapeError(
            "states (T + 1, n) and inputs (T, m) must be one log; "
            f"got {x.shape} and {u.shape}"
        )
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        raise DataError("states and inputs must be finite")
    n = x.shape[1]
    m = u.shape[1]
    rows = np.arange(longest, len(x) - 1)
    least = 5 * (1 + n + m)
    if len(rows) < least:
        raise DataError(
            f"a delay of up to {longest} steps needs {longest + least + 1} rows; "
            f"got {len(x)}"
        )
    x = _without_jumps(x, angles)
    u = _standardized_inputs(u)
    state_basis = _orthonormal(x[rows])
    changes = _independent_changes(x, rows, state_basis)
    delays = _delays(longest, resolution)
    grams = [
        _block_grams(state_basis, u, changes, rows, float(delay)) for delay in delays
    ]
    gram = np.stack(grams)  # (delays, blocks, d, d)
    states_end = state_basis.shape[1]
    inputs_end = states_end + m
    scores = _log_determinants(gram.sum(1), states_end, inputs_end)

    rng = np.random.default_rng(seed)
    blocks = gram.shape[1]
    draws = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=resamples)
    drawn_delays = []
    for counts in draws:
        drawn_gram = np.tensordot(gram, counts, (1, 0))
        drawn_scores = _log_determinants(drawn_gram, states_end, inputs_end)
        drawn_delays.append(delays[np.argmax(drawn_scores)])
    tails = [(1 - confidence) / 2, (1 + confidence) / 2]
    low, high = np.quantile(drawn_delays, tails, method="inverted_cdf")
    best = delays[np.argmax(scores)]
    if max(high, best) == delays[-1]:
        _log.warning(
            "estimate_delay: the interval reaches the longest delay that was tried, %g "
            "steps: the delay may be longer. Try a larger `longest`",
            delays[-1],
        )
    margin = 0.0 if resolution == 1 else resolution / 2
    return DelayEstimate(
        steps=float(best),
        interval=(
            float(max(min(low, best) - margin, 0)),
            float(max(high, best) + margin),
        ),
        delays=delays,
        correlations=np.sqrt(-np.expm1(-scores)),
    )


def _delays(longest: int, resolution: float) -> Array:
    """The delays that are tried (T,) [steps], from zero to at most ``longest``."""
    count = int(np.floor(longest / resolution + 1e-9)) + 1
    delays = np.arange(count, dtype=np.float64) * float(resolution)
    return np.round(delays, 9)


def _independent_changes(states: Array, rows: np.ndarray, state_basis: Array) -> Array:
    """The part of changes that the states do not explain, of unit square before.

    Args:
        states: All of the log (T + 1, n).
        rows: Those whose change in a step counts.
        state_basis: Orthonormal columns of the states (rows, r).

    Raises:
        DataError: No state moves, but at a constant pace.
    """
    changes = np.diff(states, axis=0)[rows]
    round_off = 1e-14 * np.abs(states).max(axis=0)
    moving = np.ptp(changes, axis=0) > round_off
    if not moving.any():
        raise DataError(
            "no state moves, but at a constant pace: the data cannot tell the delay of "
            "an input"
        )
    centred = changes[:, moving] - changes[:, moving].mean(axis=0)
    return _without(state_basis, centred / np.linalg.norm(centred, axis=0))


def _block_grams(
    state_basis: Array, inputs: Array, changes: Array, rows: np.ndarray, delay: float
) -> Array:
    """Computes [states, v, change]' [states, v, change] of each block of rows.

    Args:
        state_basis: Orthonormal columns of the states (rows, r).
        inputs: All inputs (T, m).
        changes: What the states do not explain of their changes (rows, n).
        rows: Rows of the log.
        delay: That of the inputs [steps].

    Returns:
        (blocks, d, d), d = r + m + n.
    """
    acting = _acting_inputs(inputs, rows, delay)
    regressors = _independent_inputs(state_basis, acting, delay)
    table = np.column_stack([state_basis, regressors, changes])
    length = int(np.ceil(len(rows) ** (1 / 3)) * 2)
    starts = np.arange(0, len(rows) - length + 1, length)
    # The last block ends with the log; up to length - 1 rows before it are used by
    # none.
    starts[-1] = len(rows) - length
    blocks = np.stack([table[start : start + length] for start in starts])
    return blocks.swapaxes(1, 2) @ blocks


def _without_jumps(states: Array, angles: Sequence[int]) -> Array:
    """Counts the turns of angles in states (T + 1, n) from the first row on."""
    places = list(check_indices("angles", angles, states.shape[1]))
    counted = states.copy()
    changes = wrap(np.diff(states[:, places], axis=0))
    counted[1:, places] = states[0, places] + np.cumsum(changes, axis=0)
    return counted


def _standardized_inputs(inputs: Array) -> Array:
    """Scales inputs (T, m) to mean zero and unit square.

    Raises:
        DataError: An input does not move, or two move alike.
    """
    centred = inputs - inputs.mean(axis=0)
    squares = np.square(centred).sum(axis=0)
    for j in np.flatnonzero(squares <= _round_off_of_squares(inputs)):
        raise DataError(
            f"input {j + 1} is constant: the data cannot tell its delay; "
            "let it move, or leave the column out"
        )
    standardized = centred / np.sqrt(squares)
    _check_different(standardized)
    return standardized


def _round_off_of_squares(inputs: Array) -> Array:
    """Returns what the squares of centred inputs (T, m) sum to by round-off (m,)."""
    return len(inputs) * np.square(1e-14 * np.abs(inputs).max(axis=0))


def _check_different(inputs: Array) -> None:
    """Raises ``DataError`` where one of the inputs (T, m) is a sum of others."""
    for j in range(1, inputs.shape[1]):
        before = _orthonormal(inputs[:, :j], constant=False)
        remainder = _without(before, inputs[:, j : j + 1])
        if np.square(remainder).sum() > _DEPENDENT:
            continue
        likeness = np.square(inputs[:, :j].T @ inputs[:, j])
        alike = int(np.argmax(likeness))
        problem = f"input {j + 1} is a sum of those before it"
        if likeness[alike] > 1 - _DEPENDENT:
            problem = (
                f"inputs {alike + 1} and {j + 1} move alike (equal but for scale and "
                "offset)"
            )
        raise DataError(
            f"{problem}: the data cannot tell what each of them does; leave one out"
        )


def _acting_inputs(inputs: Array, rows: np.ndarray, delay: float) -> Array:
    """Returns the inputs (rows, m) that act in each row with a delay [steps].

    They lie between those of the two whole delays around it; without a delay both are
    the row's own.
    """
    older = int(np.ceil(delay))
    newer = max(older - 1, 0)
    weight = delay - newer  # of the older input
    return weight * inputs[rows - older] + (1 - weight) * inputs[rows - newer]


def _independent_inputs(state_basis: Array, acting: Array, delay: float) -> Array:
    """Returns the part of inputs that the states do not explain, of unit square.

    Args:
        state_basis: Orthonormal columns of the states (rows, r).
        acting: The inputs that act (rows, m).
        delay: Their delay [steps], for the message.

    Raises:
        DataError: That part is nothing, or the inputs do not move.
    """
    sizes = np.square(acting - acting.mean(axis=0)).sum(axis=0)
    for j in np.flatnonzero(sizes <= _round_off_of_squares(acting)):
        raise DataError(
            f"input {j + 1} of {delay:g} steps before is constant in the rows that all "
            "delays can be compared over, though it moves elsewhere: the data cannot "
            "tell the delay; let it move for longer, or lower `longest`"
        )
    remainder = _without(state_basis, acting)
    remaining = np.square(remainder).sum(axis=0)
    for j in np.flatnonzero(remaining <= _DEPENDENT * sizes):
        raise DataError(
            f"input {j + 1} of {delay:g} steps before is a function of the state, as "
            "under feedback alone: what it does cannot be told from what the state "
            "does by itself, and the data cannot tell the delay; add an excitation "
            "that does not follow the state"
        )
    return remainder / np.sqrt(remaining)


def _orthonormal(columns: Array, constant: bool = True) -> Array:
    """Returns orthonormal columns (rows, r) of the span of others (rows, c).

    A constant is added unless it is not wanted. Offsets and scales do not count, and
    columns that depend on others add nothing.
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


def _without(basis: Array, columns: Array) -> Array:
    """Subtracts from columns (rows, c) what orthonormal ones (rows, r) explain."""
    remainder = columns - basis @ (basis.T @ columns)
    return remainder - basis @ (basis.T @ remainder)  # once more, against round-off


def _log_determinants(gram: Array, states_end: int, inputs_end: int) -> Array:
    """Computes log |Sigma_e without v| - log |Sigma_e| (T,).

    Args:
        gram: Gram matrices of (states, v, change) (T, d, d).
        states_end: Index after the columns of the states.
        inputs_end: Index after those of v.
    """
    changes = slice(inputs_end, None)
    logs = []
    for count in (states_end, inputs_end):
        of_regressors = gram[:, :count, :count] + _RIDGE * np.eye(count)
        with_changes = gram[:, :count, changes]
        of_changes = gram[:, changes, changes]
        explained = np.linalg.solve(of_regressors, with_changes)
        remainder = of_changes - with_changes.swapaxes(1, 2) @ explained
        # A state that is determined by the others (an integrated one) must not count as
        # known exactly.
        remainder = remainder + _RIDGE * np.eye(remainder.shape[-1])
        logs.append(np.linalg.slogdet(remainder)[1])
    without_inputs, with_inputs = logs
    return np.maximum(without_inputs - with_inputs, 0.0)
