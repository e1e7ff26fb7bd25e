"""The delay of an input, estimated from a log by correlation, with a confidence interval.

What a state changes by in a step correlates with the input that acts in it. For every delay tau the changes are
regressed on the state and on the input tau steps earlier (between two steps on both, as a ``DelayedModel`` has it),

    x[k+1] - x[k] = C (1, x[k]) + D v_k(tau) + e,      correlation^2 = 1 - |Sigma_e(tau)| / |Sigma_e without v|

and the delay with the largest correlation is the estimate: the maximum of the likelihood for Gaussian e. The state is
part of the regression because in a closed loop the input depends on it. Errors e are correlated in time where the
system is nonlinear; so the interval comes from resampling blocks of rows, not from the likelihood (moving-block
bootstrap: Kuensch, 1989).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError, ShapeError, check_number


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

    Raises:
        ShapeError: The two do not belong together.
        DataError: There are too few rows, or an entry is not finite.
    """
    x, u = np.asarray(states, dtype=float), np.asarray(inputs, dtype=float)
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
    delays: Array = (
        np.arange(0, longest + resolution / 2, resolution).astype(np.float64).round(9)
    )
    change, known = (
        np.diff(x, axis=0)[rows],
        np.column_stack([np.ones(len(rows)), x[rows]]),
    )
    # [known, v, change]' [known, v, change] of each block of rows, for every delay
    length = int(np.ceil(len(rows) ** (1 / 3)) * 2)
    starts = np.arange(0, len(rows) - length + 1, length)
    grams = []
    for tau in delays:
        whole = int(np.ceil(tau))
        share = tau - (whole - 1)  # of the older input
        v = share * u[rows - whole] + (1 - share) * u[rows - max(whole - 1, 0)]
        table = np.column_stack([known, v, change])
        blocks = np.stack(
            [table[s : s + length] for s in [*starts[:-1], len(rows) - length]]
        )
        grams.append(blocks.swapaxes(1, 2) @ blocks)
    gram = np.stack(grams)  # (delays, blocks, d, d)
    rng, sizes = np.random.default_rng(seed), (1 + n, 1 + n + m)
    scores = _log_determinants(gram.sum(1), *sizes)
    counts = rng.multinomial(
        gram.shape[1], np.full(gram.shape[1], 1 / gram.shape[1]), size=resamples
    )
    found = [
        delays[np.argmax(_log_determinants(np.tensordot(gram, c, (1, 0)), *sizes))]
        for c in counts
    ]
    low, high = np.quantile(
        found, [(1 - confidence) / 2, (1 + confidence) / 2], method="inverted_cdf"
    )
    best, half = delays[np.argmax(scores)], resolution / 2 if resolution < 1 else 0.0
    interval = float(max(min(low, best) - half, 0)), float(max(high, best) + half)
    return DelayEstimate(float(best), interval, delays, np.sqrt(-np.expm1(-scores)))


def _log_determinants(gram: Array, known: int, regressors: int) -> Array:
    """Log |Sigma_e without v| - log |Sigma_e| of each gram matrix (T, d, d) of (known, v, change)."""
    logs = []
    for count in (known, regressors):
        rest = gram[:, regressors:, regressors:] - gram[
            :, regressors:, :count
        ] @ np.linalg.solve(gram[:, :count, :count], gram[:, :count, regressors:])
        # a state that is determined by the others (an integrated one) must not count as known exactly
        scale = gram[:, regressors:, regressors:].diagonal(axis1=1, axis2=2)
        rest = rest + 1e-9 * scale[:, :, None] * np.eye(rest.shape[-1])
        logs.append(np.linalg.slogdet(rest)[1])
    return np.maximum(logs[0] - logs[1], 0.0)
