"""The model f + B d: a model that was learned before, and its change, a GP."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import angles_of, state_difference
from gpmpc._dynamics import Array, DynamicsModel, Linearized, linearize, to_array
from gpmpc._kernels import Window, linearize_gps
from gpmpc._kernels._window import V as WHITENED_TARGETS
from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.gp._online import least_informative
from gpmpc.learning._innovation import LARGEST_LEAD, Innovation, LearningStep
from gpmpc.learning._settings import OnlineLearning
from gpmpc.models import Features
from gpmpc.models._wrapper import Wrapper

_UNKNOWN_VARIANCE = 1e60  # of what nobody knows


class ChangeWindows(NamedTuple):
    """The GPs of the change, and those that will follow when the window is full."""

    current: Window  #: the GPs of d over (phi, u, t); at first without points
    #: the GPs without the points that go next, while their factor is being made
    successor: Window | None


class ObservedChange(NamedTuple):
    """What a transition says of the change."""

    point: Array  #: (phi, u, t), where it was seen
    value: Array  #: what d was there (k,)
    latent_variance: Array  #: variance of the model alone there (k,)


class Comparison(NamedTuple):
    """Innovations of a step, by the model with its change and by the one without."""

    with_change: Innovation
    without_change: Innovation
    model_with_step: "ChangedModel"  #: the step is a further point of its change

    def planned(self, active: bool) -> Innovation:
        """Returns the innovation of the model that plans.

        Args:
            active: Whether the change is used.
        """
        return self.with_change if active else self.without_change

    @property
    def lead(self) -> float:
        """Lead of the change's log density, as far as one step may count."""
        lead = self.with_change.log_density - self.without_change.log_density
        return max(-LARGEST_LEAD, min(lead, LARGEST_LEAD))


@dataclass(frozen=True, eq=False)
class ChangedModel(Wrapper):
    """A model and its change.

    Raises:
        UnsupportedModel: Another model, or a ``ResidualModel`` whose B is a function of
            the state.
    """

    model: DynamicsModel  #: f: a ``GPPosterior`` of next states, or a ``ResidualModel``
    #: how d is learned
    learning: OnlineLearning = field(default_factory=OnlineLearning)
    time: float = 0.0  #: t of all predictions [steps]
    #: further states that are angles, besides those of the model: a sensor may show
    #: them within a turn
    further_angles: Sequence[int] = ()

    def __post_init__(self) -> None:
        if (
            not isinstance(self.gp, GPPosterior)
            or self.gp.device.type != "cpu"
            or callable(self.B)
        ):
            raise UnsupportedModel(
                "learning while flying needs a GPPosterior or a ResidualModel with a "
                f"constant B, in host memory; got {type(self.model).__name__}"
            )

    @cached_property
    def gp(self) -> GPPosterior:
        """The GP that the model was learned with."""
        return cast(GPPosterior, getattr(self.model, "residual", self.model))

    @cached_property
    def features(self) -> Features:
        """The map from state and input to what d sees of them."""
        if self.gp is not self.model:
            return cast(Any, self.model).features
        n = self.model.state_dim
        m = self.model.input_dim
        return Features(list(range(n)), list(range(m)), [], n, m)

    @cached_property
    def B(self) -> Tensor:
        """Matrix B (n, k), by which d acts on the states."""
        if self.gp is not self.model:
            return cast(Any, self.model).B
        return torch.eye(self.gp.output_dim, dtype=self.gp.dtype)

    @cached_property
    def B_array(self) -> Array:
        """B (n, k) as an array."""
        return to_array(self.B)

    @cached_property
    def B_squared(self) -> Array:
        """Squares of the entries of B (n, k): by these variances of d act on states."""
        return self.B_array**2

    @cached_property
    def B_inverse(self) -> Array:
        """Pseudo-inverse of B (k, n): the part of an error of f that d can explain."""
        return np.asarray(np.linalg.pinv(self.B_array), dtype=np.float64)

    @cached_property
    def gp_noise(self) -> Array:
        """Noise variances of the targets of the model's GP (k,), sensors' included."""
        noise = self.gp.observation_noise
        return to_array(self.gp.noise_variance if noise is None else noise)

    @cached_property
    def further_noise(self) -> Array:
        """Variances (n,) of what scatters measured states besides the GP's noise.

        So do those of positions that follow from a rate, which have no GP of their own.
        Of a sensor whose noise nobody knows it is so large that nothing is asked.
        """
        of_gp = self.B_squared @ self.gp_noise
        noise: Tensor | None = getattr(self.model, "observation_noise", None)
        if self.gp is not self.model and noise is None:
            noise = cast(Any, self.model).noise
        further = np.zeros(self.model.state_dim)
        if self.gp is not self.model and noise is not None:
            further = (np.diagonal(to_array(noise)) - of_gp).clip(0.0)
        return np.where(of_gp + further > 0.0, further, _UNKNOWN_VARIANCE)

    @cached_property
    def sensor_noise(self) -> Array:
        """Variances (n,) of the noise of measured states."""
        return self.B_squared @ self.gp_noise + self.further_noise

    @cached_property
    def has_unreached_states(self) -> bool:
        """Whether d cannot explain every error of the model."""
        return bool(np.linalg.matrix_rank(self.B_array) < len(self.B_array))

    @cached_property
    def signal(self) -> Array:
        """Prior variances of d (k,)."""
        return self.learning.share**2 * to_array(self.gp.signal_variance)

    @cached_property
    def angles(self) -> list[int]:  # type: ignore[override]
        """Indices of the states that are angles."""
        return sorted({*angles_of(self.model), *self.further_angles})

    @cached_property
    def change(self) -> ChangeWindows:
        """The GPs of d; without points at first."""
        gp = self.gp
        time_scale = np.full(gp.output_dim, self.learning.memory)
        lengthscales = np.column_stack([to_array(gp.lengthscales), time_scale])
        window = Window.empty(
            lengthscales, self.signal, gp.state_dim, self.learning.points
        )
        return ChangeWindows(current=window, successor=None)

    def __len__(self) -> int:
        return self.change.current.arrays.size

    def later(self, steps: float) -> "ChangedModel":
        """Returns the model some steps later."""
        return self._copy_with(time=self.time + steps)

    def without_points(self) -> "ChangedModel":
        """Returns the model without any point of the change."""
        return replace(self)  # a new object has no ``change`` yet

    def with_point(
        self, point: Array, target: Array, noise_variance: Array
    ) -> "ChangedModel":
        """Returns the model with a further point of the change.

        A fifth of the points goes at once when the window is full. The factor of those
        that remain is made beforehand, some rows with every new point.

        Args:
            point: (phi, u, t).
            target: What d is there (k,).
            noise_variance: Of the target (k,).

        Raises:
            SettingError: The noise is too small.
        """
        capacity = self.learning.points
        points_to_drop = max(1, capacity // 5)  # at once
        points_until_rebuild = capacity - points_to_drop
        # Up to ``points_to_drop`` while the successor's factor is made.
        steps_into_rebuild = max(0, len(self) - points_until_rebuild)
        current, successor = self.change
        if steps_into_rebuild > 0 and successor is None:
            # Chosen now, a fifth of the room ahead of when they go.
            successor = current.without(self._first_to_go(points_to_drop))
        if successor is not None and steps_into_rebuild == points_to_drop:
            current = successor
            successor = None
        elif successor is not None:
            # Rows cost the square of their number: so every step does as much.
            # Until it takes over nothing predicts by it.
            part = (steps_into_rebuild / points_to_drop) ** (1 / 3)
            rows = int(points_until_rebuild * part)
            successor = successor.append(point, target, noise_variance, rows=rows)
        current = current.append(point, target, noise_variance)
        return self._copy_with(change=ChangeWindows(current, successor))

    def _first_to_go(self, count: int) -> Sequence[int]:
        """Indices of the points of the change that go first."""
        if self.learning.remove == "oldest":
            return range(count)
        return least_informative(self.posterior, count)

    def _copy_with(self, **changes: Any) -> "ChangedModel":
        """Copies the model with what it has computed, but for some attributes."""
        copied = object.__new__(type(self))
        copied.__dict__.update(self.__dict__ | changes)
        return copied

    def observe(self, state: Array, input: Array, next_state: Array) -> ObservedChange:
        """Computes what a transition says of the change.

        Args:
            state: x (n,).
            input: u (m,).
            next_state: Measured after it (n,).
        """
        states = state[None]
        inputs = input[None]
        prediction = linearize(self.model, states, inputs)
        z, v, _ = self.features.linearize(states, inputs)
        error = state_difference(next_state, prediction.mean[0], self.angles)
        covariance = cast(Array, prediction.covariance)[0]
        return ObservedChange(
            point=np.concatenate([z[0], v[0], [self.time]]),
            value=self.B_inverse @ error,
            latent_variance=self.explainable_variance(covariance),
        )

    def explainable_variance(self, covariance: Array) -> Array:
        """Variances (*batch, k) of the part of a state that d can explain.

        Args:
            covariance: Of the state (*batch, n, n).
        """
        return ((self.B_inverse @ covariance) * self.B_inverse).sum(-1)

    def predict_then_learn(self, step: LearningStep) -> Comparison:
        """Compares predictions of a step with the change and without, and learns it.

        The new point's row of the factor holds its innovation, given the points before
        it.
        """
        model = self.with_point(step.point, step.observed_change, step.noise_variance)
        innovation = model.last_innovation()
        latent = self.latent_left_by_change(
            model_variance=step.latent_variance,
            change_variance=innovation.variance - step.noise_variance,
            prior_variance=self.signal,
        )
        return Comparison(
            with_change=Innovation(innovation.error, innovation.variance + latent),
            without_change=Innovation(
                step.observed_change, step.noise_variance + step.latent_variance
            ),
            model_with_step=model,
        )

    def last_innovation(self) -> Innovation:
        """Innovation of the last point of the change, predicted by those before it.

        With L the factor and v = L^-1 y, L_NN^2 is the variance, noise included, and
        v_N L_NN the error.
        """
        column = self.change.current.columns[:, len(self) - 1]
        root = column[:, len(self) - 1]
        return Innovation(error=column[:, WHITENED_TARGETS] * root, variance=root**2)

    def latent_left_by_change(
        self, model_variance: Any, change_variance: Any, prior_variance: Any
    ) -> Any:
        """Computes the variance of the model alone that points of d leave.

            model - max(model - prior, 0) (1 - min(change / prior, 1))

        Where the model alone varies by more than d does before it has seen a point, it
        knows nothing, as where an input moves that its data held still. There an error
        teaches both at once, and of that excess as large a part is left as of d's prior
        variance.

        Args:
            model_variance: Of the model alone (*batch, k), of NumPy or torch.
            change_variance: Of d with its points (*batch, k).
            prior_variance: Of d without (k,).
        """
        excess = (model_variance - prior_variance).clip(0.0)
        ratio = (change_variance / prior_variance).clip(None, 1.0)
        return model_variance - excess * (1.0 - ratio)

    @property
    def posterior(self) -> GPPosterior:
        """The GPs of d as tensors."""
        window = self.change.current
        arrays = window.arrays
        size = len(self)
        k, d = arrays.inverse_squares.shape
        targets = window.data[d : d + k, :size].T
        factor = window.columns[:, :size, :size].transpose(0, 2, 1)
        return GPPosterior(
            features=torch.from_numpy(arrays.points[:, :size].T),
            targets=torch.from_numpy(targets),
            lengthscales=torch.from_numpy(arrays.inverse_squares**-0.5),
            signal_variance=torch.from_numpy(np.exp(arrays.log_signal)),
            noise_variance=torch.from_numpy(self.gp_noise),
            offset=torch.from_numpy(np.zeros(k)),
            cholesky=torch.from_numpy(factor),
            weights=torch.from_numpy(arrays.weights[:, :size]),
            input_dim=self.gp.input_dim + 1,
            predicts="value",
        )

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance of the observations (n, n)."""
        return self.model.noise_covariance

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """Predicts the next state at x (*batch, n) and u (*batch, m), without noise."""
        belief = self.model.predict(state, input)
        if not len(self):
            return belief
        z, v = self.features(state, input)
        time = torch.full_like(state[..., :1], self.time)
        # The change is in float64, whatever the model's type.
        change = self.posterior.predict(
            z.double(), torch.cat([v, time], dim=-1).double()
        )
        change_mean = change.mean.to(belief.mean)
        change_variance = change.variance.to(belief.mean)
        B_inverse = torch.as_tensor(self.B_inverse).to(belief.mean)
        latent_left = self.latent_left_by_change(
            model_variance=((B_inverse @ belief.covariance) * B_inverse).sum(-1),
            change_variance=change_variance,
            prior_variance=torch.as_tensor(self.signal).to(belief.mean),
        )
        variance = latent_left + change_variance
        mean = belief.mean + change_mean @ self.B.mT
        return Gaussian(mean, self.B @ torch.diag_embed(variance) @ self.B.mT)

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises at K points (K, n), (K, m): the model and its change apart."""
        model = linearize(self.model, states, inputs, covariance)
        if not len(self):
            return model
        z, v, slope = self.features.linearize(states, inputs)
        inputs_and_time = np.empty((len(v), v.shape[1] + 1))
        inputs_and_time[:, :-1] = v
        inputs_and_time[:, -1] = self.time
        no_offset = np.zeros(self.gp.output_dim)
        change = linearize_gps(
            self.change.current, z, inputs_and_time, covariance, no_offset, False
        )
        by_state, by_input = self.features.chain(change.A, change.B[..., :-1], slope)
        B = self.B_array
        V = model.covariance
        if V is not None and change.covariance is not None:
            variance = np.diagonal(change.covariance, axis1=1, axis2=2)
            latent_left = self.latent_left_by_change(
                model_variance=self.explainable_variance(V),
                change_variance=variance,
                prior_variance=self.signal,
            )
            variance = variance + latent_left
            V = (B * variance[:, None, :]) @ B.T
        return Linearized(
            mean=model.mean + change.mean @ B.T,
            A=model.A + B @ by_state,
            B=model.B + B @ by_input,
            covariance=V,
        )
