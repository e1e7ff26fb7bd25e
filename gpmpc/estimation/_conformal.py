"""Conformal tubes: how many standard deviations a bound needs.

That follows from predictions that were compared with what happened.

A chance constraint g'x <= f moves its bound inwards by kappa sd, and a Gaussian takes
kappa = Phi^-1(eta). Models are wrong in ways that their covariance does not say. Here
kappa of each stage k is a quantile of the scores

    s = max_g g'(x_k - mu_k) / sqrt(g' Sigma_k g)

of held-out k-step predictions: the ceil((N + 1) eta)-th smallest of N scores holds a
new one with probability eta or more, whatever their distribution (split conformal
prediction: Vovk, Gammerman and Shafer, 2005; Lei et al., 2018), where the new score and
the N are exchangeable: windows that do not overlap, flown as the plant will be.

``AdaptiveTube`` corrects it while it runs (Gibbs and Candes, 2021): with err = 1 where
a prediction did not hold,

    alpha <- alpha + rate (1 - eta - err)
    kappa  = quantile of the scores at 1 - alpha

Whatever the plant does, of T predictions of stage k no more than T a + a / rate + k + 1
do not hold, a = 1 - eta the share it aims at, as long as no score exceeds ``largest``:
alpha begins at a, and below zero, where kappa is the largest, only predictions made
before can miss.

To be at or below 1 - eta with confidence it has to aim lower. Of T decisions m may be
misses, m the largest number whose exact upper 95 % limit (Clopper and Pearson, 1934) is
at or below 1 - eta; so ``decisions=T`` aims at

    a = (m - k - 1) / (T + 1 / rate).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.stats import beta
from torch import Tensor

from gpmpc._angles import angles_of, full_turns, state_difference
from gpmpc._arrays import is_measured, read_array
from gpmpc._calls import explains_arguments
from gpmpc._compiled import compiled
from gpmpc._dynamics import Array, DynamicsModel, to_array
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_indices,
    check_number,
)
from gpmpc.models._past import (
    belief_of_measured,
    first_signals,
    measured_dim,
    rows_before,
    whole_states,
)
from gpmpc.propagation import Propagator, rollout
from gpmpc.signals import signals_of


@explains_arguments
@dataclass(frozen=True, eq=False)
class ConformalTube:
    """Scores of held-out predictions, and the standard deviations that follow.

    Raises:
        ShapeError: Scores or rows are no table of a row and a column.
        DataError: A score or an entry of the rows is not finite.
        SettingError: An angle is no state.

    See Also:
        ``AdaptiveTube``, which follows what happens in flight.
    """

    scores: Array  #: those of each stage in a column (N, H), which are sorted
    rows: Array  #: the directions g (r, n) that were compared
    angles: Sequence[int] = ()  #: states whose errors are taken within half a turn

    def __post_init__(self) -> None:
        scores = np.sort(_table("scores", self.scores, "(N, H)"), axis=0)
        rows = _table("rows", self.rows, "(r, n)")
        for name, table in (("scores", scores), ("rows", rows)):
            if not np.isfinite(table).all():
                raise DataError(f"{name} must be finite; got {table.tolist()}")
        check_indices("angles", self.angles, rows.shape[1])
        object.__setattr__(self, "scores", scores)
        object.__setattr__(self, "rows", rows)

    @classmethod
    def calibrate(
        cls,
        model: DynamicsModel,
        propagator: Propagator,
        states: Any,
        inputs: Any,
        horizon: int,
        rows: Any = None,
        angles: Sequence[int] | None = None,
    ) -> "ConformalTube":
        """Compares predictions with a held-out log, over windows that do not overlap.

        Args:
            model: Was not trained on this log.
            propagator: As the controller has it, with the process noise.
            states: x_0 .. x_T at equal time steps (T + 1, n); of a model with a past,
                such as a ``DelayedModel``, what is measured of them.
            inputs: u_0 .. u_{T-1} (T, m) or one more.
            horizon: H.
            rows: Directions g (r, n); both sides of every state by default. A bound on
                the first state from above alone is [[1, 0, ..]]: fewer directions, a
                smaller kappa.
            angles: Indices of the states that are angles [rad], whose errors are taken
                within half a turn; by default those of the model.

        Raises:
            ShapeError: States, inputs or rows do not belong together.
            DataError: The log is shorter than the horizon, a score is not finite, or a
                table has other columns than the model's names.
        """
        check_number("horizon", horizon, least=1, whole=True)
        columns = np.shape(states)[-1] if np.ndim(states) else 0
        names = first_signals(signals_of(model), columns)
        states = read_array("states", states, names.state_names)
        inputs = read_array("inputs", inputs, names.input_names)
        x = torch.as_tensor(states, dtype=model.dtype, device=model.device)
        u = torch.as_tensor(inputs, dtype=model.dtype, device=model.device)
        if x.dim() != 2 or u.dim() != 2 or len(u) not in (len(x) - 1, len(x)):
            got = f"{tuple(x.shape)} and {tuple(u.shape)}"
            raise ShapeError(
                f"states (T + 1, n) and inputs (T, m) must be one log; got {got}"
            )
        whole, first = _with_past(model, x, u)
        begins = np.arange(first, len(x) - horizon, horizon)
        steps = begins[:, None] + np.arange(1, horizon + 1)  # (windows, H)
        n = x.shape[1]
        if not len(steps):
            raise DataError(
                f"a log of {len(x)} states has no window of {horizon} steps"
            )
        both_sides = np.vstack([np.eye(n), -np.eye(n)])
        G = both_sides if rows is None else _as_rows(rows)
        if G.shape[1] != n:
            raise ShapeError(f"rows must be (r, {n}); got {G.shape}")
        starts = belief_of_measured(model, whole[begins])
        predicted = rollout(propagator, model, starts, u[steps - 1])
        covariance = to_array(predicted.covariance)[..., :n, :n]
        deviation = np.sqrt(np.einsum("ri,khij,rj->khr", G, covariance, G))
        if not (deviation > 0).all():
            raise DataError(
                "a direction has no variance: predict with the process noise"
            )
        turning = angles_of(model) if angles is None else list(angles)
        mean = predicted.mean[..., :n]
        errors = to_array(state_difference(x[steps], mean, turning))
        scores = (errors @ G.T / deviation).max(-1)
        if not np.isfinite(scores).all():
            raise DataError("a score is not finite: a prediction or a state is not")
        return cls(scores=scores, rows=G, angles=turning)

    @property
    def horizon(self) -> int:
        """H."""
        return self.scores.shape[1]

    def kappas(self, probability: float) -> Array:
        """Returns the standard deviations of each stage that hold with eta (H,).

        Raises:
            SettingError: The probability does not lie between 0 and 1.
            DataError: There are fewer than eta / (1 - eta) scores: no number of them
                says so much.
        """
        _check_probability(probability)
        rank = math.ceil((len(self.scores) + 1) * probability - 1e-9)
        if rank > len(self.scores):
            need = math.ceil(probability / (1 - probability) - 1e-9)
            raise DataError(
                f"a probability of {probability:g} needs {need} windows or more; "
                f"got {len(self.scores)}"
            )
        return self.scores[rank - 1].copy()


def _with_past(model: DynamicsModel, x: Tensor, u: Tensor) -> tuple[Tensor, int]:
    """Completes measured states (T + 1, n) of a model with a past.

    Returns:
        The whole states, and the row from which on they are known.
    """
    if x.shape[1] != measured_dim(model):
        return x, 0
    return whole_states(model, x, u), rows_before(model)


@explains_arguments
class AdaptiveTube:
    """Adapts the standard deviations of each stage to how often predictions hold.

    Each step: ``observe`` the state, decide with ``kappas``, ``remember`` the plan.

    Args:
        tube: Scores to begin with.
        probability: eta.
        rate: By how much one prediction that did not hold moves alpha; larger adapts
            faster and varies more, at rare violations most of all. By default (1 - eta)
            / 5.
        noise: Covariance of the measurements of what ``observe`` is given (n, n); none
            by default.
        largest: The largest number of standard deviations; twice the largest score of
            all by default.
        decisions: After how many predictions of a stage the exact upper 95 % limit of
            the share that did not hold is to be at or below 1 - eta; by default the
            share itself is brought to 1 - eta.

    Raises:
        SettingError: A probability not between 0 and 1, a rate that is not positive, or
            too few decisions to say so.
        ShapeError: The noise is no matrix (n, n).

    See Also:
        ``ConformalTube``, which it begins with.
    """

    def __init__(
        self,
        tube: ConformalTube,
        probability: float,
        rate: float | None = None,
        noise: Any = None,
        largest: float | None = None,
        decisions: int | None = None,
    ):
        _check_probability(probability)
        rate = (1.0 - probability) / 5.0 if rate is None else rate
        check_number("rate", rate, above=0)
        H = tube.horizon
        r, n = tube.rows.shape
        if largest is None:
            largest = 2.0 * max(float(tube.scores.max()), 1.0)
        check_number("largest", largest, above=0)
        self.tube = tube
        self.probability = float(probability)
        self.rate = float(rate)
        self.largest = float(largest)
        self.noise = np.zeros((n, n))
        if noise is not None:
            self.noise = _of_shape("noise", noise, (n, n))
        self.allowed = np.full(H, 1.0 - probability)  # a of each stage
        if decisions is not None:
            self.allowed = _aimed_misses(probability, rate, decisions, H)
        self.kappas = np.empty(H)
        self.alphas = self.allowed.copy()
        self.counts = np.zeros(H)
        self.misses = np.zeros(H)
        # Of the plans of the last H steps, by stage and direction.
        self._bounds = np.full((H, H, r), np.nan)
        self._step = 0
        # Plans count turns from the state that they began at, which a sensor may wrap.
        # So states and plans are moved by whole turns to where this state, the last
        # value of each entry, goes on without jumps; NaN before the first.
        self._last_state = np.full(n, np.nan)
        # Nothing yet: kappas alone, from the scores.
        self._compare(np.full(n, np.nan))

    def observe(self, state: Any) -> Array:
        """Compares a state (n,) with the plans before it; returns kappas (H,).

        Entries that are NaN, or of 1e30 or more in size, were not measured: a stage
        where a direction of such an entry counts is not compared.

        Raises:
            ShapeError: It has another number of entries.
        """
        state = _of_shape("a state", state, (self.tube.rows.shape[1],))
        state = np.where(is_measured(state), state, np.nan)
        state = self._without_jumps(state)
        self._step += 1
        self._compare(state)
        return self.kappas

    def _compare(self, state: Array) -> None:
        """Compares a state (n,) with the plans before it, and adapts kappas."""
        # New arrays: what was handed out before stays as it is.
        self.kappas = self.kappas.copy()
        self.alphas = self.alphas.copy()
        self.counts = self.counts.copy()
        self.misses = self.misses.copy()
        _observe.unchecked(
            state,
            self.tube.rows,
            self._bounds,
            self._step,
            _Adaptation(self.rate, self.allowed, self.largest),
            self.tube.scores,
            _StageState(self.kappas, self.alphas, self.counts, self.misses),
        )

    def remember(self, means: Array, covariances: Array, stages: Any = None) -> None:
        """Remembers a plan from the current state on.

        Args:
            means: As a decision has them (H + 1, n).
            covariances: Likewise (H + 1, n, n).
            stages: Whether each stage's prediction counts (H,), or each of its
                directions (H, r), such as where the plan touches a bound: how often
                bounds are violated there is what alpha follows then. By default all do.

        Raises:
            ShapeError: One of them has another shape.
        """
        H = self.tube.horizon
        r, n = self.tube.rows.shape
        means = _of_shape("means", means, (H + 1, n))
        covariances = _of_shape("covariances", covariances, (H + 1, n, n))
        counted_directions = np.full((H, r), True)
        if stages is not None:
            counted_directions = np.array(stages, dtype=bool)
            shape = counted_directions.shape
            if shape not in ((H,), (H, r)):
                raise ShapeError(f"stages must be ({H},) or {(H, r)}; got {shape}")
        turns = full_turns(self._last_state - means[0], self.tube.angles)
        means = means + np.nan_to_num(turns)
        bounds = self._bounds[self._step % H]
        _remember.unchecked(
            means,
            covariances,
            self.noise,
            self.tube.rows,
            self.kappas,
            bounds,
        )
        bounds[~counted_directions] = np.nan

    def _without_jumps(self, state: Array) -> Array:
        """Moves the angles of a state (n,) to within half a turn of the last ones.

        NaN, which was not measured, stays; the last value of each entry counts.
        """
        turns = full_turns(state - self._last_state, self.tube.angles)
        state = state - np.nan_to_num(turns)
        self._last_state = np.where(np.isnan(state), self._last_state, state)
        return state

    @property
    def violations(self) -> Array:
        """Part of the predictions that did not hold (H,); NaN before the first."""
        return np.divide(
            self.misses,
            self.counts,
            out=np.full_like(self.misses, np.nan),
            where=self.counts > 0,
        )


def _as_rows(rows: Any) -> Array:
    return np.atleast_2d(np.asarray(rows, dtype=float))


def _table(name: str, values: Any, dimensions: str) -> Array:
    """Copies numbers of two dimensions, each of one entry or more.

    Raises:
        ShapeError: They have others.
    """
    table = np.array(values, dtype=np.float64, order="C")
    if table.ndim != 2 or not table.size:
        raise ShapeError(f"{name} must be {dimensions}; got {table.shape}")
    return table


def _of_shape(name: str, values: Any, shape: tuple[int, ...]) -> Array:
    """Copies numbers to a contiguous array, as compiled code reads it unchecked.

    Raises:
        ShapeError: They have another shape.
    """
    array = np.array(values, dtype=np.float64, order="C")
    if array.shape != shape:
        raise ShapeError(f"{name} must be {shape}; got {array.shape}")
    return array


def _check_probability(probability: float) -> None:
    if not 0 < probability < 1:
        raise SettingError(
            "probability", f"must lie between 0 and 1; got {probability}"
        )


def _aimed_misses(
    probability: float, rate: float, decisions: int, horizon: int
) -> Array:
    """Computes the part of misses to aim at, by stage (H,); see the module's text.

    Raises:
        SettingError: The decisions are too few.
    """
    check_number("decisions", decisions, least=1, whole=True)
    spare = np.arange(1, horizon + 1) + 1
    misses = _most_misses(1.0 - probability, decisions)
    aimed = (misses - spare) / (decisions + 1.0 / rate)
    if not (aimed > 0).all():
        raise SettingError(
            "decisions",
            f"are too few for a probability of {probability:g}; got {decisions}",
        )
    return aimed


def _most_misses(rate: float, decisions: int) -> int:
    """Finds the most misses whose exact upper 95 % limit is at or below a rate."""
    misses = np.arange(int(rate * decisions) + 1)
    limits = beta.ppf(0.95, misses + 1, np.maximum(decisions - misses, 1))
    return int((limits <= rate).sum()) - 1


class _Adaptation(NamedTuple):
    """The settings of the adaptation."""

    rate: float
    allowed: Array  #: a of each stage (H,)
    largest: float  #: largest kappa


class _StageState(NamedTuple):
    """What is adapted or counted for each stage (H,)."""

    kappas: Array
    alphas: Array
    counts: Array  #: predictions that were compared
    misses: Array  #: those that did not hold


@compiled(locked=True)
def _observe(state, rows, bounds, step, adaptation, scores, stages):
    """Updates alpha and kappa of each stage by a state (n,).

    ``bounds`` (H, H, r) are those of the last plans.
    """
    N, H = scores.shape
    for k in range(H):
        # The plan of k + 1 steps ago said where the state would be at its stage k.
        # A bound that does not count is NaN.
        any_bound_counts = False
        is_measured = True
        is_violated = False
        plan = (step - k - 1) % H
        for r in range(len(rows)):
            value = 0.0
            for i in range(len(state)):
                if rows[r, i] != 0.0:  # a state that was not measured is NaN
                    value += rows[r, i] * state[i]
            bound = bounds[plan, k, r]
            is_counted = bound == bound
            any_bound_counts = any_bound_counts or is_counted
            is_measured = is_measured and (not is_counted or value == value)
            is_violated = is_violated or value > bound
        # A stage that is not measured as a whole is left out, held or not: with only
        # the misses that are seen the share would be another.
        if any_bound_counts and is_measured:
            miss = 1.0 if is_violated else 0.0
            stages.counts[k] += 1.0
            stages.misses[k] += miss
            change = adaptation.rate * (adaptation.allowed[k] - miss)
            stages.alphas[k] = min(stages.alphas[k] + change, 1.0)
        rank = math.ceil((N + 1) * (1.0 - stages.alphas[k]) - 1e-9)
        if rank > N:
            stages.kappas[k] = adaptation.largest
        else:
            stages.kappas[k] = scores[max(rank, 1) - 1, k]
    bounds[step % H] = np.nan  # until a plan of this step is remembered


@compiled(locked=True)
def _remember(means, covariances, noise, rows, kappas, bounds):
    """Writes the bounds g'mu + kappa sd of a plan, by stage and direction (H, r)."""
    n = means.shape[1]
    for k in range(len(kappas)):
        for r in range(len(rows)):
            value = 0.0
            variance = 0.0
            for i in range(n):
                value += rows[r, i] * means[k + 1, i]
                for j in range(n):
                    variance += (
                        rows[r, i]
                        * (covariances[k + 1, i, j] + noise[i, j])
                        * rows[r, j]
                    )
            bounds[k, r] = value + kappas[k] * math.sqrt(max(variance, 0.0))
