"""Positions that are integrated from their rates, as the data of a system show them.

Where a state x_i is the integral of another one, x_j, its next value follows from what
is learned of that one:

    x_i[k+1] - x_i[k] - h x_j[k] = c h (x_j[k+1] - x_j[k]),

or, where there is a nominal model f, x_i[k+1] - f_i = c h (x_j[k+1] - f_j). c is 1/2
for a rate that moves evenly within the step h, 1 for a simulator that moves a position
by the new rate (semi-implicit Euler); the data tell, by two-stage least squares, since
noise of the rates would bias plain least squares. What is then left of a position is
its noise, as a rule, and is not learned. Where a part of it is a function of state and
input (a rate of body axes, or a coarse time step), it is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gpmpc._angles import state_difference, wrap
from gpmpc.gp._data_checks import constant_columns
from gpmpc.models._features import Features
from gpmpc.models._nominal import Affine
from gpmpc.models._residual_data import Nominal, nominal_next_state

# Of the variance of what is left: from this on it is learned. An error that depends on
# the state adds up from step to step, noise only by its root: a tenth of the variance
# of one step is half of that of ten.
_LEARNABLE = 0.1
_EVEN = 0.5  # c of a rate that moves evenly within a step
_SIGNIFICANT = 3.0  # standard errors from which on c is another one, or a part is none
_ROWS_PER_TERM = 3  # of the regressions


@dataclass(frozen=True, eq=False)
class KinematicResidual:
    """What of a model is known by its rates, and what is left to learn."""

    nominal: Nominal  #: f, with positions moved by their rates
    B: Tensor  #: effect (n, k) of the k outputs that are learned
    noise: Tensor  #: variance (n,) of what is not learned: of integrated positions


def kinematic_residual(
    rates: Mapping[int, int],
    features: Features,
    nominal: Nominal | None,
    states: Tensor,
    inputs: Tensor,
    next_states: Tensor,
    time_step: float,
) -> KinematicResidual:
    """Finds how positions follow from their rates.

    Args:
        rates: The position of each rate, by index; each position has one rate.
        features: What the model sees.
        nominal: A known model; None for x[k] moved by its rates.
        states: x[k] (N, n).
        inputs: u[k] (N, m).
        next_states: x[k+1] (N, n).
        time_step: h [s].
    """
    predicted = states
    if nominal is not None:
        predicted = nominal_next_state(nominal, states, inputs, features.angles)
    change = state_difference(next_states, predicted, features.angles)
    basis = _basis(torch.cat(features(states, inputs), dim=1))
    integrals = []
    for rate, position in _from_the_highest(rates):
        position_change = change[:, position]
        if nominal is None:  # a known model has moved it by its rate already
            position_change = position_change - time_step * states[:, rate]
            if position in features.angles:  # a turn too much may be of either part
                position_change = wrap(position_change)
        rate_change = time_step * change[:, rate]
        c = _integration_coefficient(position_change, rate_change, basis)
        remainder = position_change - c * rate_change
        integrals.append(
            _Integral(rate, position, c, remainder, _is_learnable(remainder, basis))
        )
    if nominal is None:
        nominal = _integrating_model(integrals, states, inputs, time_step)
    return KinematicResidual(
        nominal=nominal,
        B=_effect_of_learned(integrals, states, time_step),
        noise=_unlearned_noise(integrals, states, time_step),
    )


class _Integral(NamedTuple):
    """How a position x_i follows from its rate x_j."""

    rate: int  #: j
    position: int  #: i
    c: float  #: weight of the new rate; 1 - c is that of the old one
    remainder: Tensor  #: what the rate does not explain of x_i[k+1] (N,)
    remainder_is_learned: bool  #: by a GP of its own; otherwise it is noise


def _integrating_model(
    integrals: Sequence[_Integral], states: Tensor, inputs: Tensor, h: float
) -> Affine:
    """Returns x[k+1] = A x[k] of positions that are moved by their rates.

    x_i[k+1] = x_i + h ((1 - c) x_j + c x_j[k+1]), where row j of A gives x_j[k+1].
    """
    n = states.shape[1]
    A = torch.eye(n, dtype=states.dtype)
    for rate, position, c, *_ in integrals:
        A[position] += h * A[rate] * c
        A[position, rate] += h * (1 - c)
    identity = Affine.identity(n, inputs.shape[1])
    return Affine(A=A, B=identity.B, c=identity.c)


def _effect_of_learned(
    integrals: Sequence[_Integral], states: Tensor, h: float
) -> Tensor:
    """Returns the effect (n, k) of what is learned: it moves x_i by c h as it does x_j.

    A position whose remainder is noise has no output of its own.
    """
    n = states.shape[1]
    effect = torch.eye(n, dtype=states.dtype)
    learned = list(range(n))
    for rate, position, c, _, remainder_is_learned in integrals:
        by_rate = c * h * effect[rate]
        if remainder_is_learned:
            effect[position] += by_rate
        else:
            effect[position] = by_rate
            learned.remove(position)
    return effect[:, learned]


def _unlearned_noise(
    integrals: Sequence[_Integral], states: Tensor, h: float
) -> Tensor:
    """Returns the variance (n,) of what no output learns.

    What is missed of a rate is missed of its position as well.
    """
    missed = torch.zeros_like(states)
    for rate, position, c, remainder, remainder_is_learned in integrals:
        # What a rate misses, of a chain of rates, moves its position too.
        missed[:, position] = c * h * missed[:, rate]
        if not remainder_is_learned:
            missed[:, position] += remainder
    return missed.square().mean(dim=0)


def _from_the_highest(rates: Mapping[int, int]) -> list[tuple[int, int]]:
    """Returns pairs (rate, position), those of accelerations before velocities."""

    def derivatives_above(position: int) -> int:
        above = [rate for rate, integral in rates.items() if integral == position]
        return 1 + derivatives_above(above[0]) if above else 0

    return sorted(rates.items(), key=lambda pair: derivatives_above(pair[1]))


def _basis(features: Tensor) -> Tensor:
    """Returns an orthonormal basis (N, t) of polynomials of features (N, d).

    They have products where there are rows enough, else squares, else neither.
    """
    size, d = features.shape
    spread = features.std(dim=0, correction=0)
    is_constant = torch.from_numpy(constant_columns(features.numpy(), resolution=0.0))
    # What moves by round-off keeps its unit, and drops out below.
    scale = torch.where(is_constant, 1.0, spread)
    scaled = (features - features.mean(dim=0)) / scale
    one = torch.ones(size, 1, dtype=features.dtype)
    columns = [one, scaled, scaled.square()]
    if 1 + d + d * (d + 1) // 2 <= size // _ROWS_PER_TERM:
        i, j = torch.triu_indices(d, d, offset=1)
        columns.append(scaled[:, i] * scaled[:, j])
    elif 1 + 2 * d > size // _ROWS_PER_TERM:
        columns.pop()
    polynomials = torch.cat(columns, dim=1)
    U, sizes, _ = torch.linalg.svd(polynomials, full_matrices=False)
    return U[:, sizes > 1e-9 * sizes[0]]


def _integration_coefficient(
    position_change: Tensor, rate_change: Tensor, basis: Tensor
) -> float:
    """Estimates c of ``position_change`` = c ``rate_change``, both (N,), in [0, 1].

    The instruments of the least squares are the basis (N, t). c is 1/2 unless the data
    contradict.
    """
    explained = basis @ (basis.mT @ rate_change)
    energy = float(explained @ rate_change)
    if energy <= 0.0:
        return _EVEN
    c = float(explained @ position_change) / energy
    remainder = position_change - c * rate_change
    standard_error = (float(remainder.square().mean()) / energy) ** 0.5
    if abs(c - _EVEN) <= _SIGNIFICANT * standard_error:
        return _EVEN
    return min(max(c, 0.0), 1.0)


def _is_learnable(remainder: Tensor, basis: Tensor) -> bool:
    """Whether the features explain enough of the mean square of a column (N,).

    The part that they explain is corrected for the number of terms of the basis (N, t),
    which explain some of any noise, and has to exceed what noise would show of it.
    """
    size, terms = basis.shape
    whole = float(remainder.square().sum())
    if terms >= size or whole == 0.0:
        return False
    unexplained = remainder - basis @ (basis.mT @ remainder)
    unexplained_variance = float(unexplained.square().sum()) / (size - terms)
    part = 1.0 - unexplained_variance / (whole / size)
    standard_error = (2 * terms / (size * (size - terms))) ** 0.5
    return part > max(_LEARNABLE, _SIGNIFICANT * standard_error)


def positions_by_rate(
    rates: Mapping[str, str], state_names: Sequence[str]
) -> dict[int, int]:
    """Returns the index of the position of each rate, by the rate's index."""
    return {
        state_names.index(rate): state_names.index(position)
        for rate, position in rates.items()
    }
