"""Kalman filters for learned models: estimates of the state with their covariance.

    predict:   N(mu-, Sigma-) = propagator(model, N(mu, Sigma), u)
    update:    K = Cov[x, y] (Cov[y] + R)^-1
               mu = mu- + K (y - E[y]),   Sigma = Sigma- - K (Cov[y] + R) K'

with the moments of y = h(x) + v, v ~ N(0, R), by a propagator as well: a measurement is
a ``DynamicsModel`` without inputs. By first-order linearisation this is the extended
Kalman filter, by the unscented transform the unscented one (Julier and Uhlmann, 2004),
by moment matching the assumed-density filter of Deisenroth, Huber and Hanebeck (2009).
Entries of y that are not finite are missing, and the others are used.

The update is computed from a root of Sigma-, not by the difference that it is written
with (``gpmpc.estimation._conditioning``): a prior may be 1e16 times as wide as a
sensor's noise, and a sensor perfect.
"""

from collections import deque
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import state_difference
from gpmpc._arrays import UNMEASURED, read_array
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import (
    Array,
    DynamicsModel,
    Linearized,
    TensorModel,
    check_next_states,
    check_query,
    predict_with_jacobian,
)
from gpmpc._functions import call
from gpmpc.estimation._conditioning import (
    condition,
    covariance_root,
    squared,
    unexplained_covariance,
    whitened_cross_covariance,
)
from gpmpc.exceptions import (
    SettingError,
    ShapeError,
    check_indices,
    check_kind,
    check_method,
    check_number,
    check_numbers,
)
from gpmpc.gaussian import Gaussian, check_covariance, check_tensors
from gpmpc.models._nominal import (
    check_slopes,
    linearize_function,
    points_near_zero,
)
from gpmpc.propagation import Linearization, MeanEquivalence, Propagator, Unscented
from gpmpc.propagation._propagator import checked_arguments
from gpmpc.signals import signals_of


@explains_arguments
@dataclass(frozen=True, eq=False)
class Measurement(TensorModel):
    """A measurement model that is a function of the state.

    Raises:
        ShapeError: R is not square.
        SettingError: R is no tensor or no covariance, or an angle is no entry of y.

    >>> seen = Measurement.of_states(4, states=[0, 2], std=[0.01, 0.02])
    >>> seen.output_dim, seen.noise_covariance.diagonal().sqrt().tolist()
    (2, [0.01, 0.02])

    See Also:
        ``KalmanFilter``, which takes it.
    """

    state_dim: int  #: n, of the state
    noise_covariance: Tensor  #: R (p, p)
    #: h, from x (*batch, n) to y (*batch, p), in torch
    function: Callable[[Tensor], Tensor]
    #: entries of y that are angles [rad]: their differences are taken within half a
    #: turn
    angles: Sequence[int] = ()
    input_dim = 0
    _part = property(lambda self: self.noise_covariance)

    def __post_init__(self) -> None:
        check_number("state_dim", self.state_dim, least=1, whole=True)
        check_tensors(noise_covariance=self.noise_covariance)
        R = self.noise_covariance
        if R.dim() != 2 or len(R) != R.shape[1]:
            raise ShapeError(f"noise_covariance must be (p, p); got {tuple(R.shape)}")
        check_covariance("noise_covariance", R)
        if not callable(self.function):
            raise SettingError(
                "function", f"must be a function of the state; got {self.function!r}"
            )
        check_indices("angles", self.angles, len(R))

    @classmethod
    @explains_arguments
    def of_states(
        cls,
        state_dim: int,
        states: Sequence[int],
        std: Sequence[float],
        angles: Sequence[int] = (),
    ) -> "Measurement":
        """Measures some of n states, in float64.

        Args:
            state_dim: n.
            states: Indices of the measured states; one that several sensors measure
                comes several times.
            std: Standard deviations of their noise.
            angles: Those of the measured states that sensors show modulo one turn, by
                their place among them.

        Raises:
            SettingError: A state is out of range, or a standard deviation is negative.
        """
        states = check_indices("states", states, state_dim, may_repeat=True)
        if not states:
            raise SettingError("states", "must name a state; got none")
        check_numbers("std", std, len(states), least=0)
        R = torch.diag(torch.tensor(list(std), dtype=torch.float64) ** 2)
        return cls(
            state_dim=state_dim,
            noise_covariance=R,
            function=_Selection(states, state_dim),
            angles=angles,
        )

    @property
    def output_dim(self) -> int:
        """Number of measured values, p."""
        return len(self.noise_covariance)

    @property
    def measured_states(self) -> tuple[int, ...] | None:
        """Indices of the states that are measured; None of another function."""
        if isinstance(self.function, _Selection):
            return tuple(self.function.states)
        return None

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """Predicts the measurement (*batch, p) at a certain state, without noise."""
        check_query(self, state, state[..., :0] if input is None else input)
        value = call("function", self.function, state)
        expected = (*state.shape[:-1], self.output_dim)
        if not isinstance(value, Tensor) or value.shape != expected:
            got: Any = type(value).__name__
            if isinstance(value, Tensor):
                got = tuple(value.shape)
            raise ShapeError(
                f"the measurement must give (*batch, {self.output_dim}) at "
                f"{tuple(state.shape)}; got {got}"
            )
        return Gaussian(value, value.new_zeros(*value.shape, self.output_dim))

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises h at K points (K, n); ``inputs`` is (K, 0)."""
        function = self.function
        if not hasattr(function, "linearize"):
            function = partial(call, "function", function)
        value, A = linearize_function(function, self, states)
        K, p = value.shape
        return Linearized(
            mean=value,
            A=A,
            B=np.zeros((K, p, 0)),
            covariance=np.zeros((K, p, p)) if covariance else None,
        )


class _Selection:
    """h(x) = x[states], with its expansion."""

    def __init__(self, states: Sequence[int], state_dim: int):
        self.states = list(states)
        self.matrix = np.eye(state_dim)[list(states)]

    def __call__(self, state: Tensor) -> Tensor:
        return state[..., self.states]

    def linearize(self, states: Array) -> tuple[Array, Array]:
        value = np.ascontiguousarray(states[:, self.states])
        return value, np.tile(self.matrix, (len(states), 1, 1))


@dataclass(frozen=True, eq=False)
class Update:
    """A belief after a measurement, and the innovation.

    See Also:
        ``KalmanFilter``, which returns it.
    """

    belief: Gaussian  #: over the state (*batch, n)
    innovation: Tensor  #: y - E[y] (*batch, p), NaN where nothing was measured
    covariance: Tensor  #: Cov[y] + R of the innovation (*batch, p, p), all entries


@dataclass(frozen=True, eq=False)
class FilterRun:
    """A log of T steps, filtered; see ``KalmanFilter.run``.

    See Also:
        ``KalmanFilter.run``, which returns it; ``smooth``.
    """

    predicted: Gaussian  #: beliefs before the measurements (T + 1, n), (T + 1, n, n)
    filtered: Gaussian  #: beliefs after them
    cross_covariances: Tensor  #: Cov[x_k, x_{k+1}] of the predictions (T, n, n)
    innovations: Tensor  #: (T + 1, p), NaN where nothing was measured
    innovation_covariances: Tensor  #: (T + 1, p, p)


def _without_noise(observer: Propagator) -> Propagator:
    """Returns the observer as one that adds no noise."""
    if not getattr(observer, "process_noise", False):
        return observer
    quiet: Any = copy(observer)
    quiet.process_noise = False
    return quiet


@explains_arguments
class KalmanFilter:
    """Estimates the state of a model from measurements.

    Args:
        model: A ``DynamicsModel``; disturbance states or pending inputs are estimated
            with the others.
        measurement: What sensors show.
        propagator: How beliefs move, with the process noise.
        observer: How the moments of the measurement are computed; their noise is left
            to the update, which adds it.

    Raises:
        SettingError: Model and measurement have different states, another type or
            device; the model predicts something else than next states; the propagator
            adds no process noise, or does not say that it does by its attribute
            ``process_noise``; or one is ``MeanEquivalence``, by which no measurement
            corrects anything.

    See Also:
        ``Measurement``; ``LateMeasurements`` for those that come late; ``smooth`` for
        what was filtered.
    """

    def __init__(
        self,
        model: DynamicsModel,
        measurement: Measurement,
        propagator: Propagator | None = None,
        observer: Propagator | None = None,
    ):
        propagator = Linearization() if propagator is None else propagator
        check_next_states(model)
        check_kind("measurement", measurement, Measurement, "Measurement(...)")
        if measurement.state_dim != model.state_dim:
            got = f"{measurement.state_dim} and {model.state_dim}"
            raise SettingError(
                "measurement", f"must be of as many states as the model has; got {got}"
            )
        _check_same_type(model, measurement)
        check_method("propagator", propagator, "propagate", "Linearization()")
        if not getattr(propagator, "process_noise", False):
            rule = "must add the process noise, as Linearization() does, and say so"
            got = f"{type(propagator).__name__} without process_noise"
            raise SettingError("propagator", f"{rule}; got {got}")
        _check_correlates("propagator", propagator)
        self.model = model
        self.measurement = measurement
        self.propagator = propagator
        self._names = signals_of(model)
        self._measured_names = _measured_names(measurement, self._names.state_names)
        observer = Linearization() if observer is None else observer
        check_method("observer", observer, "propagate", "Linearization()")
        _check_correlates("observer", observer)
        self.observer = _without_noise(observer)
        is_followed = not hasattr(measurement.function, "linearize")
        if getattr(self.observer, "first_order", False) and is_followed:
            point = points_near_zero(measurement.state_dim)
            check_slopes("function", measurement.function, measurement, *point)

    @classmethod
    def extended(cls, model: DynamicsModel, measurement: Measurement) -> "KalmanFilter":
        """Makes the extended Kalman filter: both are linearised to first order."""
        return cls(model, measurement)

    @classmethod
    def unscented(
        cls, model: DynamicsModel, measurement: Measurement
    ) -> "KalmanFilter":
        """Makes the unscented Kalman filter."""
        return cls(model, measurement, propagator=Unscented(), observer=Unscented())

    def predict(self, belief: Gaussian, input: Any = None) -> Gaussian:
        """Moves a belief (*batch, n) on by a step with an applied input (*batch, m).

        The input may be left out where m = 0.
        """
        check_kind("belief", belief, Gaussian, "a Gaussian")
        belief = belief.in_order(self._names.state_names)
        control = self._as_input(belief, input)
        return self.propagator.propagate(self.model, belief, control).belief

    def update(self, belief: Gaussian, measured: Any) -> Update:
        """Corrects a belief (*batch, n) by a measurement y (*batch, p).

        Entries of y that are not finite, or 1e30 or more in size, are missing: marks of
        sensors that saw nothing.

        Raises:
            ShapeError: y has another number of entries.
        """
        check_kind("belief", belief, Gaussian, "a Gaussian")
        belief = belief.in_order(self._names.state_names)
        y = self._as_measurement(belief, measured)
        R = self.measurement.noise_covariance
        expected = self._predicted_measurement(belief)
        missing = ~(y.abs() < UNMEASURED)
        innovation = state_difference(y, expected.mean, self.measurement.angles)
        # A missing entry shows nothing, with a noise that is independent of others.
        unrelated = missing[..., None] | missing[..., None, :]
        eye = torch.eye(len(R)).to(R)
        noise = torch.where(unrelated, eye, expected.unexplained + R)
        H_root = torch.where(missing[..., None], 0.0, expected.H_root)
        posterior = condition(expected.root, H_root, noise)
        correction = posterior.gain @ torch.where(missing, 0.0, innovation)[..., None]
        corrected = Gaussian(belief.mean + correction[..., 0], posterior.covariance)
        return Update(
            belief=corrected,
            innovation=torch.where(missing, torch.nan, innovation),
            covariance=expected.covariance + R,
        )

    def _as_input(self, belief: Gaussian, input: Any) -> Tensor:
        """Converts an input to a tensor of its own, like a belief's; None to none."""
        if input is None:
            return belief.mean[..., :0]
        return _like(belief, "input", input, self._names.input_names)

    def _as_measurement(self, belief: Gaussian, measured: Any) -> Tensor:
        """Converts a measurement to a tensor of its own, like a belief's.

        Raises:
            ShapeError: It has another number of entries.
        """
        y = _like(belief, "a measurement", measured, self._measured_names)
        expected = (*belief.mean.shape[:-1], self.measurement.output_dim)
        if y.shape != expected:
            raise ShapeError(
                f"a measurement must have shape {expected}; got {tuple(y.shape)}"
            )
        return y

    def _predicted_measurement(self, belief: Gaussian) -> "_PredictedMeasurement":
        """Computes what sensors show of a belief (*batch, n), without their noise."""
        root = covariance_root(belief.covariance)
        if getattr(self.observer, "first_order", False):
            no_input = checked_arguments(self.measurement, belief, None)
            value, H, _ = predict_with_jacobian(self.measurement, belief.mean, no_input)
            H_root = H @ root
            return _PredictedMeasurement(
                root=root,
                H_root=H_root,
                mean=value.mean,
                unexplained=value.covariance,
            )
        propagated = self.observer.propagate(self.measurement, belief)
        covariance = propagated.belief.covariance
        H_root = whitened_cross_covariance(root, propagated.cross_covariance)
        return _PredictedMeasurement(
            root=root,
            H_root=H_root,
            mean=propagated.belief.mean,
            unexplained=unexplained_covariance(covariance, H_root),
        )

    def run(self, belief: Gaussian, inputs: Any, measured: Any) -> FilterRun:
        """Filters a log.

        Args:
            belief: Before the first measurement (n,).
            inputs: (T, m).
            measured: (T + 1, p).

        Raises:
            ShapeError: There is not one measurement more than inputs.
        """
        check_kind("belief", belief, Gaussian, "a Gaussian")
        belief = belief.in_order(self._names.state_names)
        inputs = _like(belief, "inputs", inputs, self._names.input_names)
        measured = _like(belief, "measurements", measured, self._measured_names)
        if len(measured) != len(inputs) + 1:
            raise ShapeError(
                f"T inputs belong to T + 1 measurements; got {len(inputs)} and "
                f"{len(measured)}"
            )
        predicted = [belief]
        updates = [self.update(belief, measured[0])]
        n = belief.dim
        cross_covariances = belief.covariance.new_zeros(len(inputs), n, n)
        for k, input in enumerate(inputs):
            step = self.propagator.propagate(self.model, updates[-1].belief, input)
            predicted.append(step.belief)
            cross_covariances[k] = step.cross_covariance
            updates.append(self.update(step.belief, measured[k + 1]))
        return FilterRun(
            predicted=_stacked(predicted),
            filtered=_stacked([update.belief for update in updates]),
            cross_covariances=cross_covariances,
            innovations=torch.stack([update.innovation for update in updates]),
            innovation_covariances=torch.stack(
                [update.covariance for update in updates]
            ),
        )


class _PredictedMeasurement(NamedTuple):
    """A belief N(mu, L L') as sensors show it."""

    root: Tensor  # L (*batch, n, n)
    H_root: Tensor  # Y = H L of Cov[x, y] = L Y' (*batch, p, n)
    mean: Tensor  # E[y] (*batch, p)
    # Cov[y] - Y Y', which H L does not explain (*batch, p, p); none at first order
    unexplained: Tensor

    @property
    def covariance(self) -> Tensor:
        """Cov[y] (*batch, p, p)."""
        return squared(self.H_root) + self.unexplained


@explains_arguments
def smooth(run: FilterRun) -> Gaussian:
    """Computes the beliefs given the whole log (T + 1, n).

    This is the smoother of Rauch, Tung and Striebel (1965), with the covariances
    Cov[x_k, x_{k+1}] of the propagator, which makes it the unscented one of Sarkka
    (2008) where the filter is unscented.

    See Also:
        ``KalmanFilter.run``, which makes the run.
    """
    mean = run.filtered.mean[-1]
    covariance = run.filtered.covariance[-1]
    beliefs = [Gaussian(mean, covariance)]
    for k in reversed(range(len(run.cross_covariances))):
        # The state a step later is a measurement of this one; what the log says of it
        # comes instead of what was predicted, whose noise is the process noise.
        root = covariance_root(run.filtered.covariance[k])
        H_root = whitened_cross_covariance(root, run.cross_covariances[k])
        noise = unexplained_covariance(run.predicted.covariance[k + 1], H_root)
        given_next = condition(root, H_root, noise)
        difference = mean - run.predicted.mean[k + 1]
        mean = run.filtered.mean[k] + given_next.gain @ difference
        carried = given_next.gain @ covariance_root(covariance)
        covariance = given_next.covariance + squared(carried)
        beliefs.append(Gaussian(mean, covariance))
    return _stacked(beliefs[::-1])


@explains_arguments
class LateMeasurements:
    """A filter in a loop whose measurements may come late.

    It goes back to their time, and forward again.

    Args:
        filter: The filter.
        belief: At the first step, before its measurement (n,).
        longest: Steps that a measurement may be late; each takes its part of the time
            where one is.

    Raises:
        SettingError: ``longest`` is no whole number of zero or more.

    See Also:
        ``KalmanFilter``, which it holds.
    """

    def __init__(self, filter: KalmanFilter, belief: Gaussian, longest: int = 10):
        check_number("longest", longest, least=0, whole=True)
        check_kind("filter", filter, KalmanFilter, "KalmanFilter(...)")
        check_kind("belief", belief, Gaussian, "a Gaussian")
        # A copy: a belief of an array shares its memory.
        belief = replace(
            belief, mean=belief.mean.clone(), covariance=belief.covariance.clone()
        )
        self.filter = filter
        self.belief = belief
        # Beliefs before the measurements of each step.
        self._before: deque[Gaussian] = deque([belief], longest + 1)
        self._inputs: deque[Tensor] = deque(maxlen=longest)
        self._measured: deque[list[Tensor]] = deque([[]], longest + 1)

    def step(self, input: Any = None) -> Gaussian:
        """Goes on by a step with an applied input (m,); returns the belief after it.

        The input may be left out where m = 0.
        """
        acting = self.filter._as_input(self.belief, input)
        self.belief = self.filter.predict(self.belief, acting)
        self._inputs.append(acting)
        self._before.append(self.belief)
        self._measured.append([])
        return self.belief

    def measure(self, measured: Any, age: int = 0) -> Gaussian:
        """Takes a measurement (p,) of the state ``age`` steps ago.

        Where it raises, nothing has changed.

        Returns:
            The belief over the state now.

        Raises:
            SettingError: It is older than the filter remembers, or from the future.
            ShapeError: It has another number of entries.
        """
        check_number("age", age, least=0, whole=True, unit="[steps]")
        if age >= len(self._before):
            raise SettingError(
                "age",
                f"must be at most {len(self._before) - 1} steps, which are remembered; "
                f"got {age}",
            )
        y = self.filter._as_measurement(self.belief, measured)
        before = list(self._before)[-1 - age :]
        measurements = list(self._measured)[-1 - age :]
        measurements[0] = [*measurements[0], y]
        belief = before[0]
        for k in range(age + 1):
            if k > 0:
                belief = self.filter.predict(belief, self._inputs[k - 1 - age])
                before[k] = belief
            for of_sensor in measurements[k]:
                belief = self.filter.update(belief, of_sensor).belief
        for k in range(age + 1):
            self._before[k - 1 - age] = before[k]
            self._measured[k - 1 - age] = measurements[k]
        self.belief = belief
        return self.belief


def _check_correlates(key: str, propagator: Propagator) -> None:
    """Raises ``SettingError`` of a propagator without any Cov[x, y].

    No measurement would correct an estimate by it, and none smooth an earlier one.
    """
    if isinstance(propagator, MeanEquivalence):
        rule = "must say how what follows depends on the state, as Linearization() does"
        raise SettingError(key, f"{rule}; got MeanEquivalence")


def _check_same_type(model: DynamicsModel, measurement: Measurement) -> None:
    """Raises ``SettingError`` where the two compute in another type or place."""
    ours = (model.dtype, model.device)
    theirs = (measurement.dtype, measurement.device)
    if ours != theirs:
        raise SettingError(
            "measurement",
            f"must be {ours[0]} on {ours[1]} like the model, as its noise_covariance "
            f"is; got {theirs[0]} on {theirs[1]} (model.to(...), or "
            "dataclasses.replace(measurement, noise_covariance=...))",
        )


def _measured_names(
    measurement: Measurement, state_names: Sequence[str]
) -> tuple[str, ...]:
    """Returns the names of y where it is some of the states; none otherwise.

    None either where a state has no name, or several sensors measure it: no labels
    could tell them apart.
    """
    states = measurement.measured_states
    if states is None or max(states) >= len(state_names):
        return ()
    names = tuple(state_names[i] for i in states)
    return names if len(set(names)) == len(names) else ()


def _like(belief: Gaussian, key: str, value: Any, names: Sequence[str]) -> Tensor:
    """Copies numbers to a tensor like a belief's, in the order of names."""
    if isinstance(value, Tensor) and not value.is_complex():
        return value.to(belief.mean, copy=True)
    array = np.array(read_array(key, value, names))
    return torch.as_tensor(array, dtype=belief.mean.dtype, device=belief.mean.device)


def _stacked(beliefs: Sequence[Gaussian]) -> Gaussian:
    return Gaussian(
        torch.stack([b.mean for b in beliefs]),
        torch.stack([b.covariance for b in beliefs]),
    )
