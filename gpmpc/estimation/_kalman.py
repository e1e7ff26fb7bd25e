"""Kalman filters for learned models: estimates of the state from what sensors show, with their covariance.

    predict:   N(mu-, Sigma-) = propagator(model, N(mu, Sigma), u)
    update:    K = Cov[x, y] (Cov[y] + R)^-1,   mu = mu- + K (y - E[y]),   Sigma = Sigma- - K (Cov[y] + R) K'

with the moments of y = h(x) by a propagator as well. By first-order linearisation this is the extended Kalman filter,
by the unscented transform the unscented one (Julier and Uhlmann, 2004), by moment matching the assumed-density filter
of Deisenroth, Huber and Hanebeck (2009). Entries of y that are not finite are missing, and the others are used.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gpmpc._dynamics import DynamicsModel
from gpmpc.estimation._consistency import wrapped
from gpmpc.estimation._measurement import Measurement
from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite
from gpmpc.propagation import Linearization, Propagator, Unscented


@dataclass(frozen=True)
class Update:
    """A belief after a measurement, and by how much the measurement differed from what was expected."""

    belief: Gaussian  #: over the state (*batch, n)
    innovation: Tensor  #: y - E[y] (*batch, p), NaN where nothing was measured
    covariance: Tensor  #: Cov[y] + R of the innovation (*batch, p, p), all entries


@dataclass(frozen=True)
class FilterRun:
    """A log of T steps, filtered; see ``KalmanFilter.run``."""

    predicted: Gaussian  #: beliefs before the measurements (T + 1, n), (T + 1, n, n)
    filtered: Gaussian  #: beliefs after them
    cross_covariances: Tensor  #: Cov[x_k, x_{k+1}] of the predictions (T, n, n)
    innovations: Tensor  #: (T + 1, p), NaN where nothing was measured
    innovation_covariances: Tensor  #: (T + 1, p, p)


class KalmanFilter:
    """Estimates the state of a model from measurements.

    Args:
        model: A ``DynamicsModel``; disturbance states or pending inputs are estimated with the others.
        measurement: What sensors show.
        propagator: How beliefs move; with ``process_noise=True``.
        observer: How the moments of the measurement are computed, without noise, which the update adds.

    Raises:
        SettingError: Model and measurement have different states, or the propagator adds no process noise.
    """

    def __init__(
        self,
        model: DynamicsModel,
        measurement: Measurement,
        propagator: Propagator | None = None,
        observer: Propagator | None = None,
    ):
        propagator = Linearization(process_noise=True) if propagator is None else propagator
        if measurement.state_dim != model.state_dim:
            got = f"{measurement.state_dim} and {model.state_dim}"
            raise SettingError("measurement", f"must be of as many states as the model has; got {got}")
        if not getattr(propagator, "process_noise", True):
            rule = "must add the process noise, such as Linearization(process_noise=True)"
            raise SettingError("propagator", f"{rule}; got {type(propagator).__name__} without")
        self.model, self.measurement, self.propagator = model, measurement, propagator
        self.observer = Linearization() if observer is None else observer

    @classmethod
    def extended(cls, model: DynamicsModel, measurement: Measurement) -> "KalmanFilter":
        """The extended Kalman filter: first-order linearisation of model and measurement."""
        return cls(model, measurement, Linearization(process_noise=True))

    @classmethod
    def unscented(cls, model: DynamicsModel, measurement: Measurement) -> "KalmanFilter":
        """The unscented Kalman filter."""
        return cls(model, measurement, Unscented(process_noise=True), Unscented())

    def predict(self, belief: Gaussian, input: Any) -> Gaussian:
        """Moves a belief (*batch, n) on by a step with the input that was applied (*batch, m)."""
        return self.propagator(self.model, belief, self._tensor(input, belief))

    def update(self, belief: Gaussian, measured: Any, measurement: Measurement | None = None) -> Update:
        """Corrects a belief by a measurement.

        Args:
            belief: Before it (*batch, n).
            measured: y (*batch, p); entries that are not finite are missing.
            measurement: Of another sensor than the filter's.

        Raises:
            ShapeError: y has another number of entries.
        """
        measurement = self.measurement if measurement is None else measurement
        y, R = self._tensor(measured, belief), measurement.noise_covariance
        if y.shape != (*belief.mean.shape[:-1], len(R)):
            expected = (*belief.mean.shape[:-1], len(R))
            raise ShapeError(f"a measurement must have shape {expected}; got {tuple(y.shape)}")
        seen = self.observer.propagate(measurement, belief)
        S, missing = seen.belief.covariance + R, ~torch.isfinite(y)
        innovation = y - seen.belief.mean
        angles = list(measurement.angles)
        if angles:
            innovation[..., angles] = wrapped(innovation[..., angles])
        # A missing entry is one of variance one that has nothing to do with the state.
        used = torch.where(missing[..., None] | missing[..., None, :], torch.eye(len(R)).to(S), S)
        C = torch.where(missing[..., None, :], 0.0, seen.cross_covariance)
        gain = _right_solved(C, used)
        mean = belief.mean + (gain @ torch.where(missing, 0.0, innovation)[..., None])[..., 0]
        covariance, _ = nearest_positive_semidefinite(belief.covariance - gain @ used @ gain.mT)
        return Update(Gaussian(mean, covariance), torch.where(missing, torch.nan, innovation), S)

    def run(self, belief: Gaussian, inputs: Any, measured: Any) -> FilterRun:
        """Filters a log.

        Args:
            belief: Before the first measurement (n,).
            inputs: u_0 .. u_{T-1} (T, m).
            measured: y_0 .. y_T (T + 1, p).

        Raises:
            ShapeError: There is not one measurement more than inputs.
        """
        inputs, measured = self._tensor(inputs, belief), self._tensor(measured, belief)
        if len(measured) != len(inputs) + 1:
            raise ShapeError(f"T inputs belong to T + 1 measurements; got {len(inputs)} and {len(measured)}")
        predicted, updates, crosses = [belief], [self.update(belief, measured[0])], []
        for input, y in zip(inputs, measured[1:], strict=True):
            moved = self.propagator.propagate(self.model, updates[-1].belief, input)
            predicted.append(moved.belief)
            crosses.append(moved.cross_covariance)
            updates.append(self.update(moved.belief, y))
        innovations, covariances = (torch.stack([getattr(u, k) for u in updates]) for k in ("innovation", "covariance"))
        n = belief.dim
        cross = torch.stack(crosses) if crosses else belief.mean.new_zeros(0, n, n)
        return FilterRun(_stacked(predicted), _stacked([u.belief for u in updates]), cross, innovations, covariances)

    def _tensor(self, value: Any, belief: Gaussian) -> Tensor:
        return torch.as_tensor(value, dtype=belief.mean.dtype, device=belief.mean.device)


def smooth(run: FilterRun) -> Gaussian:
    """The beliefs given the whole log (T + 1, n): the smoother of Rauch, Tung and Striebel (1965).

    With the covariances Cov[x_k, x_{k+1}] of the propagator, which makes it the unscented one of Sarkka (2008) where
    the filter is unscented.
    """
    mean, covariance = run.filtered.mean[-1], run.filtered.covariance[-1]
    beliefs = [Gaussian(mean, covariance)]
    for k in reversed(range(len(run.cross_covariances))):
        before, after = run.predicted.covariance[k + 1], run.predicted.mean[k + 1]
        gain = _right_solved(run.cross_covariances[k], before)
        mean = run.filtered.mean[k] + gain @ (mean - after)
        covariance = run.filtered.covariance[k] + gain @ (covariance - before) @ gain.mT
        covariance, _ = nearest_positive_semidefinite(covariance)
        beliefs.append(Gaussian(mean, covariance))
    return _stacked(beliefs[::-1])


class LateMeasurements:
    """A filter in a loop whose measurements may come late: it goes back to their time, and forward again.

    Args:
        filter: The filter.
        belief: At the first step, before its measurement (n,).
        longest: Steps that a measurement may be late; each takes its part of the time where one is.

    Raises:
        SettingError: ``longest`` is no whole number of zero or more.
    """

    def __init__(self, filter: KalmanFilter, belief: Gaussian, longest: int = 10):
        check_number("longest", longest, least=0, whole=True)
        self.filter = filter
        self._before: deque[Gaussian] = deque([belief], longest + 1)  # beliefs before the measurements of each step
        self._inputs: deque[Any] = deque(maxlen=longest)
        self._measured: deque[list[Any]] = deque([[]], longest + 1)
        self.belief = belief

    def step(self, input: Any) -> Gaussian:
        """Goes on by a step, in which an input (m,) was applied; returns the belief over the state then."""
        self._inputs.append(input)
        self.belief = self.filter.predict(self.belief, input)
        self._before.append(self.belief)
        self._measured.append([])
        return self.belief

    def measure(self, measured: Any, age: int = 0) -> Gaussian:
        """Takes a measurement (p,) of a state some steps ago; returns the belief over the state now.

        Args:
            measured: y.
            age: How many steps ago it was taken.

        Raises:
            SettingError: It is older than the filter remembers, or from the future.
        """
        check_number("age", age, least=0, whole=True, unit="[steps]")
        if age >= len(self._before):
            raise SettingError("age", f"must be at most {len(self._before) - 1} steps, which are remembered; got {age}")
        self._measured[-1 - age].append(measured)
        if not age:
            self.belief = self.filter.update(self.belief, measured).belief
            return self.belief
        first = len(self._before) - 1 - age
        belief = self._before[first]
        for k in range(first, len(self._before)):
            if k > first:
                belief = self.filter.predict(belief, self._inputs[k - len(self._before)])
                self._before[k] = belief
            for y in self._measured[k]:
                belief = self.filter.update(belief, y).belief
        self.belief = belief
        return belief


def _right_solved(C: Tensor, S: Tensor) -> Tensor:
    """C S^-1 for symmetric S; by the pseudo-inverse where S is singular."""
    factor, info = torch.linalg.cholesky_ex(S)
    if bool(info.any()):
        return C @ torch.linalg.pinv(S, hermitian=True)
    return torch.cholesky_solve(C.mT, factor).mT


def _stacked(beliefs: Sequence[Gaussian]) -> Gaussian:
    return Gaussian(torch.stack([b.mean for b in beliefs]), torch.stack([b.covariance for b in beliefs]))
