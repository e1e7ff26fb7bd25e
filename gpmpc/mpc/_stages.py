"""Affine stage models of the belief's dynamics, s_{k+1} = A_k s_k + B_k u_k + c_k, quadratic costs, and linear rows.

The *covariance* mode says what s holds of the belief N(mu, Sigma):

* ``full``: s = [mu; vec S] with the symmetric root S = Sigma^(1/2) (Cao, Lai and Alam, 2017, section 4.1).
* ``diagonal``: s = [mu; standard deviations]; correlations are dropped at every stage.
* ``zero_order``: s = mu; covariances are predicted beside the optimisation as if the inputs did not change them
  (Hewing, Kabzan and Zeilinger, 2020; Zanelli, Frey, Messerer and Diehl, 2021).
* ``none``: s = mu, through the model's mean at a certain state.

``full`` and ``diagonal`` are linearised at the means and covariances of the plan, whatever the propagator.

P(g'x <= f) >= eta is g'mu + kappa sd <= f for a Gaussian, sd = sqrt(g'Sigma g), and g'mu - kappa sd >= f on the other
side. Where s holds the covariance, sd is in the row: |S g|, or |diag(g) sd|, linearised at the plan (both are
homogeneous, so the row has no constant). (The paper writes S_jj for it, which is right for a diagonal S only.) Both are
convex: the row asks for no more than the constraint itself. In the mode ``zero_order`` the bounds move inwards by
kappa sd of the covariances predicted beside the program.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
import torch

from gpmpc._compiled import compiled
from gpmpc._dynamics import DynamicsModel, linearize, tensors_for, to_array
from gpmpc._kernels.linalg import dot
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite
from gpmpc.mpc._cost import PENALIZED, by_stage
from gpmpc.mpc._linear_quadratic import QuadraticCost, StageRows, Stages
from gpmpc.mpc.problem import Inequality, Problem
from gpmpc.propagation import Propagator, differentiate
from gpmpc.propagation import linearize as linearize_belief
from gpmpc.propagation._local_model import square_roots

Array = np.ndarray

Covariance = Literal["full", "diagonal", "zero_order", "none"]
COVARIANCES = ("full", "diagonal", "zero_order", "none")


class Plan(NamedTuple):
    """Where stages are linearised; it need not obey the dynamics."""

    states: Array  # s_0 .. s_H (H + 1, p); s_0 is the current one
    inputs: Array  # u_0 .. u_{H-1} (H, m)
    covariances: Array  # Sigma_0 .. Sigma_H (H + 1, n, n)


class StageLinearizer:
    """Linearises the dynamics of the belief at K points in one call, in one covariance mode; see the module's text."""

    def __init__(
        self, model: DynamicsModel, propagator: Propagator, covariance: Covariance
    ):
        self.model = model
        self.propagator = propagator
        self.covariance = covariance
        self._n = model.state_dim
        first_order = getattr(propagator, "first_order", False)
        self.at_points = covariance == "none" or (
            covariance == "zero_order" and first_order
        )
        noisy = covariance == "zero_order" and getattr(
            propagator, "process_noise", False
        )
        self._noise = to_array(model.noise_covariance) if noisy else None
        #: variances (n,) of the noise that V holds
        self.noise = np.zeros(self._n)
        if self._noise is not None:
            self.noise = np.ascontiguousarray(np.diagonal(self._noise))
        moments = {
            "full": self._full,
            "diagonal": self._diagonal,
            "zero_order": self._zero_order,
        }
        self._linearize = self._points if self.at_points else moments[covariance]

    def weight(self, Q: Array) -> Array:
        """The weights of s that belong to weights of x (K, n, n): the blocks on their diagonals (K, p / n, n, n)."""
        if self.covariance == "full":  # tr(Q Sigma) = |vec S|^2 in I_n kron Q
            return np.repeat(Q[:, None], self._n + 1, axis=1)
        return (
            np.stack([Q, Q * np.eye(self._n)], axis=1)
            if self.covariance == "diagonal"
            else Q[:, None]
        )

    def state(self, means: Array, covariances: Array) -> Array:
        """The vectors s (K, p) of beliefs (K, n), (K, n, n)."""
        if self.covariance == "full":
            return np.concatenate(
                (means, square_roots(covariances)[0].reshape(len(means), -1)), axis=1
            )
        if self.covariance == "diagonal":
            variances = np.diagonal(covariances, axis1=1, axis2=2)
            return np.concatenate([means, np.sqrt(np.clip(variances, 0, None))], axis=1)
        return means

    def moments(self, states: Array, covariances: Array) -> tuple[Array, Array]:
        """Means and covariances of the states s (K, p); ``covariances`` where s does not hold them."""
        n = self._n
        if self.covariance == "full":
            S = states[:, n:].reshape(-1, n, n)
            return states[:, :n], S @ S.mT
        if self.covariance == "diagonal":
            return states[:, :n], states[:, n:, None] ** 2 * np.eye(n)
        return states, covariances

    def __call__(
        self,
        states: Array,
        inputs: Array,
        covariances: Array,
        disturbance: Array | None = None,
    ) -> Stages:
        """The stage models at K points s (K, p), u (K, m), Sigma (K, n, n), disturbance (n,) added to the means."""
        after, A, B, V = self._linearize(states, inputs, covariances)
        if disturbance is not None:
            after = after.copy()
            after[:, : self._n] += disturbance
        return Stages(A, B, _constants.unchecked(A, B, after, states, inputs), after, V)

    def _points(self, states: Array, inputs: Array, _: Array) -> tuple[Array, ...]:
        found = linearize(self.model, states, inputs, self.covariance == "zero_order")
        V = (
            np.zeros((len(states), self._n, self._n))
            if found.covariance is None
            else found.covariance
        )
        V = V if self._noise is None else V + self._noise
        parts = (
            found.mean,
            found.A,
            found.B,
            V,
        )  # a model may give views, which the kernels do not notice
        return tuple([np.ascontiguousarray(part, dtype=np.float64) for part in parts])

    def _zero_order(
        self, states: Array, inputs: Array, covariances: Array
    ) -> tuple[Array, ...]:
        moved, d = differentiate(
            self.propagator, self.model, *self._tensors(states, covariances, inputs)
        )
        A = d.mean_by_mean
        S = moved.belief.covariance
        passed = A @ moved.cross_covariance  # mean equivalence passes nothing on
        V, _ = nearest_positive_semidefinite(S - (passed + passed.mT) / 2)
        return tuple(map(to_array, (moved.belief.mean, A, d.mean_by_input, V)))

    def _full(
        self, states: Array, inputs: Array, covariances: Array
    ) -> tuple[Array, ...]:
        belief, input = self._tensors(states[:, : self._n], covariances, inputs)
        local = linearize_belief(self.propagator, self.model, belief, input)
        return *map(to_array, (local.next_state, local.A, local.B)), np.zeros_like(
            covariances
        )

    def _diagonal(
        self, states: Array, inputs: Array, covariances: Array
    ) -> tuple[Array, ...]:
        n = self._n
        covariances = covariances * np.eye(n)
        belief, input = self._tensors(states[:, :n], covariances, inputs)
        moved, d = differentiate(self.propagator, self.model, belief, input)
        sd = belief.variance.sqrt()
        sd_next = moved.belief.variance.clamp_min(0).sqrt()
        # d Sigma_cc = 2 sd_c d sd_c, and backwards; where the next deviation is zero it has no derivative.
        backwards = torch.where(
            sd_next > 0, 0.5 / torch.where(sd_next > 0, sd_next, 1.0), 0.0
        )[..., None]
        twice = 2 * sd[..., None, :]
        mean_by_sd = d.mean_by_covariance.diagonal(dim1=-2, dim2=-1) * twice
        by_mean, by_input = (
            part.diagonal(dim1=-3, dim2=-2).mT
            for part in (d.covariance_by_mean, d.covariance_by_input)
        )
        by_variance = (
            d.covariance_by_covariance.diagonal(dim1=-2, dim2=-1)
            .diagonal(dim1=-3, dim2=-2)
            .mT
        )
        upper = torch.cat([d.mean_by_mean, mean_by_sd], dim=-1)
        lower = torch.cat(
            [backwards * by_mean, backwards * by_variance * twice], dim=-1
        )
        A = torch.cat([upper, lower], dim=-2)
        B = torch.cat([d.mean_by_input, backwards * by_input], dim=-2)
        return *map(
            to_array, (torch.cat([moved.belief.mean, sd_next], dim=-1), A, B)
        ), np.zeros_like(covariances)

    def _tensors(
        self, means: Array, covariances: Array, inputs: Array
    ) -> tuple[Gaussian, torch.Tensor]:
        mean, covariance, input = tensors_for(self.model, means, covariances, inputs)
        return Gaussian(mean, covariance), input


@compiled
def _constants(A, B, after, states, inputs):
    """C (K, p) of s+ = A s + B u + c through the points."""
    c = after.copy()
    for k in range(len(c)):
        for i in range(c.shape[1]):
            c[k, i] -= dot(A[k, i], states[k], A.shape[2]) + dot(
                B[k, i], inputs[k], B.shape[2]
            )
    return c


class StageCosts:
    """The cost of a problem's stages: the weights alone, ``quadratic``, and the squares of outputs along a plan."""

    def __init__(self, problem: Problem, horizon: int, linearizer: StageLinearizer):
        n = problem.state_dim
        m = problem.input_dim
        cost = problem.cost
        self._linearizer = linearizer
        self.outputs, (Q, R) = problem.outputs, cost.by_stage(horizon)
        for output in self.outputs:
            by_stage("weight", output.weight, horizon, 2)
            by_stage("reference", output.reference, horizon, 1)
        self._Q = Q
        own = linearizer.weight(Q[-1:])[0]
        Q = Q if cost.Q.ndim > 2 else cost.Q[None]
        R = R if cost.R.ndim > 2 else cost.R[None]
        W, own, R = (
            np.ascontiguousarray(part) for part in (linearizer.weight(Q), own, R)
        )
        self.quadratic = QuadraticCost(
            W,
            own,
            R,
            PENALIZED.index(cost.penalized),
            np.empty((0, n + m + 1, n + m + 1)),
        )

    def at(self, plan: Plan, parameters: Array | None = None) -> QuadraticCost:
        """The cost with its outputs linearised along a plan; raises what ``expand_function`` does."""
        if not self.outputs:
            return self.quadratic
        n = self._Q.shape[1]
        means = np.ascontiguousarray(plan.states[1:, :n])
        squares = np.sum(
            [output.squares(means, plan.inputs, parameters) for output in self.outputs],
            axis=0,
        )
        weights = self._linearizer.weight(self._Q + squares[:, :n, :n])
        weights[:, 0] = self._Q  # of the mean, which the squares weigh themselves
        return self.quadratic._replace(
            state=weights, terminal=weights[-1], squares=squares
        )


class ConstraintRows:
    """The rows of a problem's constraints, r a stage: of a box one for each entry with a bound, upper ones first.

    Attributes:
        soft: Whether a violation of any has a price.
        prices: Of the rows (r,), infinite where they are hard.
        elastic: Whether a row gives way where it cannot be kept (r,).
        signs: 1 where a row has upper bounds, -1 where it has lower ones (r,).
        applies: Whether a row has a bound at a stage (H, r).
        smooth: Whether there is any ``Inequality``.
    """

    def __init__(self, problem: Problem, horizon: int, covariance: Covariance):
        n = problem.state_dim
        self._horizon = horizon
        self._covariance = covariance
        self._smooth: list[tuple[Inequality, slice]] = []
        self._plain = np.zeros((0, 0, problem.input_dim))  # no row holds inputs
        elastic: list[bool] = []
        F = [np.empty((0, n))]
        kappa = []
        prices = []
        lower = [np.empty((horizon, 0))]
        upper = [np.empty((horizon, 0))]
        for constraint in problem.constraints:
            rows, below, above = constraint.rows(horizon)
            if constraint.stages is not None:
                if max(constraint.stages) > horizon:
                    raise SettingError(
                        "stages",
                        f"must be of 1 .. {horizon}; got {max(constraint.stages)}",
                    )
                outside = [k for k in range(horizon) if k + 1 not in constraint.stages]
                below[outside] = -np.inf
                above[outside] = np.inf
            sides = int(np.isfinite(below).sum() + np.isfinite(above).sum())
            if isinstance(constraint, Inequality):
                first = sum(map(len, F))
                self._smooth.append((constraint, slice(first, first + len(rows))))
                rows = np.zeros((len(rows), n))
            F = [*F, rows]
            lower = [*lower, below]
            upper = [*upper, above]
            kappa += [
                0.0 if covariance == "none" else constraint.standard_deviations(sides)
            ] * len(rows)
            prices += [problem.price(constraint)] * len(rows)
            elastic += [constraint.penalty == "elastic"] * len(rows)
        self._F = np.concatenate(F)
        self._lower = np.hstack(lower)
        self._upper = np.hstack(upper)
        self._kappa = np.array(kappa)
        self.prices = np.array(prices)
        self.elastic = np.array(elastic, dtype=bool)
        self.signs = np.where(np.isfinite(self._upper).any(axis=0), 1.0, -1.0)
        self.applies = np.isfinite(self._lower) | np.isfinite(self._upper)
        self.per_stage, self.soft = len(kappa), bool(np.isfinite(self.prices).any())
        margins = (
            self._kappa if covariance == "zero_order" else np.zeros(self.per_stage)
        )
        self._margins = np.tile(margins, (horizon, 1))
        self.smooth = bool(self._smooth)
        self._fixed = None
        if not (
            self.smooth
            or margins.any()
            or (self.per_stage and covariance in ("full", "diagonal"))
        ):
            E = self._rows(self._F[None], np.zeros((1, n, n)))
            self._fixed = StageRows(E, self._plain, self._lower, self._upper)

    def at(
        self,
        plan: Plan,
        covariances: Array,
        stages: int,
        parameters: Array | None = None,
        kappas: Array | None = None,
    ) -> StageRows:
        """The rows, tightened by the covariances (H + 1, n, n), at a plan where smooth constraints are linearised.

        ``kappas`` by stage (H,) take the place of those of the constraints that have some.
        """
        if self._fixed is not None:
            return self._fixed
        lower = self._lower.copy()
        upper = self._upper.copy()
        F = self._F[None]
        D = self._plain
        if self._smooth:
            means = np.ascontiguousarray(plan.states[1:, : F.shape[2]])
            F = np.repeat(F, self._horizon, axis=0)
            D = np.zeros((self._horizon, self.per_stage, D.shape[2]))
            for constraint, where in self._smooth:
                values, F[:, where], D[:, where] = constraint.expand(
                    means, plan.inputs, parameters
                )
                upper[:, where] += np.einsum("kri,ki->kr", F[:, where], means) - values
                upper[:, where] += np.einsum("kri,ki->kr", D[:, where], plan.inputs)
        margins = (
            self._margins
            if kappas is None
            else np.where(self._margins > 0, kappas[:, None], 0.0)
        )
        _tighten.unchecked(F, margins, covariances, lower, upper)
        E = self._rows(F, covariances[1 : stages + 1])
        return StageRows(np.ascontiguousarray(E), D, lower, upper)

    def _rows(self, F: Array, covariances: Array) -> Array:
        """E (K, r, p) of gradients F (K, r, n) at covariances of the states (K, n, n); one of either stands for all."""
        K = max(len(F), len(covariances))
        n = F.shape[2]
        weight = self.signs * self._kappa
        if self._covariance not in ("full", "diagonal"):
            return F
        F, covariances = (
            np.broadcast_to(part, (K, *part.shape[1:])) for part in (F, covariances)
        )
        if self._covariance == "diagonal":
            moved = (
                F * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).clip(0))[:, None]
            )
            norms = np.linalg.norm(moved, axis=-1, keepdims=True)
            slopes = np.divide(F * moved, norms, out=np.abs(F), where=norms > 0)
            return np.concatenate([F, weight[:, None] * slopes], axis=2)
        moved = F @ square_roots(covariances)[0]
        norms = np.linalg.norm(moved, axis=-1, keepdims=True)
        directions = np.divide(
            moved, norms, out=np.zeros_like(moved), where=norms > 0
        )  # S g / |S g|
        slopes = F[..., None] * directions[:, :, None, :]  # of |S g| by S (K, r, n, n)
        return np.concatenate(
            [F, (weight[:, None, None] * slopes).reshape(K, -1, n * n)], axis=2
        )


@compiled
def _tighten(F, kappa, covariances, lower, upper):
    """Moves the bounds of the rows (H, r) inwards by kappa (H, r) standard deviations."""
    held, r, n = F.shape
    for k in range(len(lower)):
        at = min(k, held - 1)
        for e in range(r):
            variance = 0.0
            for i in range(n):
                if F[at, e, i] != 0.0:
                    variance += F[at, e, i] * dot(covariances[k + 1, i], F[at, e], n)
            margin = kappa[k, e] * math.sqrt(max(variance, 0.0))
            lower[k, e] += margin
            upper[k, e] -= margin


@compiled
def price_violations(prices, rows, plan, hard_price):
    """What violations along a plan cost: their declared price, or ``hard_price`` per unit without one."""
    E, D, lower, upper = rows
    total = 0.0
    for k in range(len(lower)):
        at = min(k, len(E) - 1)
        s = plan.states[k + 1]
        u = plan.inputs[k]
        for e in range(len(prices)):
            value = dot(E[at, e], s, len(s)) + (
                dot(D[k, e], u, len(u)) if len(D) > 0 else 0.0
            )
            outside = max(0.0, value - upper[k, e], lower[k, e] - value)
            total += (hard_price if prices[e] == np.inf else prices[e]) * outside
    return total


@compiled
def largest_violation(rows, bounds, plan, previous_input):
    """By how much a plan misses a bound of its states, inputs or increments, at most."""
    E, D, lower, upper = rows
    largest = 0.0
    for k in range(len(plan.inputs)):
        s = plan.states[k + 1]
        u = plan.inputs[k]
        for e in range(lower.shape[1]):
            value = dot(E[min(k, len(E) - 1), e], s, len(s))
            if len(D) > 0:
                value += dot(D[k, e], u, len(u))
            largest = max(largest, value - upper[k, e], lower[k, e] - value)
        for j in range(len(u)):
            largest = max(largest, u[j] - bounds.upper[k, j], bounds.lower[k, j] - u[j])
            if len(bounds.rate_lower) > 0:
                before = plan.inputs[k - 1, j] if k > 0 else previous_input[j]
                rate = u[j] - before
                largest = max(
                    largest,
                    rate - bounds.rate_upper[k, j],
                    bounds.rate_lower[k, j] - rate,
                )
    return largest


@compiled
def keep_rates(inputs, last, lower, upper):
    """Moves inputs (H, m), one after the other, to within their rates from the one before."""
    for k in range(len(inputs)):
        for j in range(len(last)):
            before = inputs[k - 1, j] if k > 0 else last[j]
            at = min(k, len(lower) - 1)
            inputs[k, j] = min(
                max(inputs[k, j], before + lower[at, j]), before + upper[at, j]
            )
