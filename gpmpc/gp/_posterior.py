"""Exact GPs with the SE-ARD kernel, frozen to plain tensors: data and prediction.

One GP per output with the squared exponential kernel with automatic relevance
determination,

    k_a(x~, x~') = sf2_a exp(-1/2 sum_d (x~_d - x~'_d)^2 / l_ad^2),   x~ = (x, u)

Rasmussen and Williams (2006), eqs. (2.25)-(2.26), Algorithm 2.1; the GP model of Cao,
Lai and Alam (2017). A posterior is in physical units: an affine scaling of the data is
only another parametrisation of such a GP.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from gpmpc._dynamics import (
    Array,
    FirstOrderExpansion,
    Linearized,
    TensorModel,
    check_destination,
    check_query,
    tensors_for,
    to_array,
)
from gpmpc.exceptions import ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian, check_tensors, constant_arrays
from gpmpc.gp._backend import check_and_choose_compiled
from gpmpc.gp._kernel import factorize, kernel_of_squares
from gpmpc.gp._scaling import Scaling
from gpmpc.gp._tensor_checks import Predicts, check_gp_tensors
from gpmpc.signals import UNKNOWN, Signals, check_signals

if TYPE_CHECKING:
    from gpmpc._kernels import Packed


class AffineForm(NamedTuple):
    """A model x+ = A x + G u + c + f0(x, u) + B f(x_s, u_s).

    Without f0 and angles moments go through it exactly.
    """

    f: "GPPosterior"  #: the latent functions
    A: Tensor | None = None  #: (n, n); None: zero
    G: Tensor | None = None  #: (n, m); None: zero
    c: Tensor | None = None  #: (n,); None: zero
    B: Tensor | None = None  #: (n, k); None: the identity
    #: the states that f depends on; None: all, and then all inputs too
    states: list[int] | None = None
    inputs: list[int] | None = None  #: the inputs that f depends on; None with states
    #: those of ``states`` that f sees as (sine, cosine), at their place
    angles: tuple[int, ...] = ()
    tape: Any = None  #: f0 as a ``gpmpc._kernels.tape.Tape``; None for zero


@dataclass(frozen=True, eq=False)
class GPPosterior(TensorModel):
    """Exact GPs, one per output, over the same N points.

    A training, ``from_hyperparameters`` or a file makes them.

    For each output, with the kernel k, features X and targets y::

        mean(x) = m + k(x, X) (K + sn^2 I)^-1 (y - m)
        variance(x) = sf^2 - k(x, X) (K + sn^2 I)^-1 k(X, x)
        k(x, x') = sf^2 exp(-1/2 sum_i (x_i - x'_i)^2 / l_i^2)

    See Also:
        ``Trainer``, which makes it of data; ``save_posterior``; ``append_transitions``
        for further data.
    """

    features: Tensor  #: x~ = (x, u) of the training points (N, n + m)
    #: of the GPs (N, k): next states, differences x[k+1] - x[k] (k = n), or any values
    targets: Tensor
    lengthscales: Tensor  #: l (k, n + m), one row an output
    signal_variance: Tensor  #: sf2 (k,)
    #: sn2 (k,), of what scatters next states around predictions
    noise_variance: Tensor
    offset: Tensor  #: the prior mean, one constant an output (k,)
    cholesky: Tensor  #: lower factor L of K + sn2 I (k, N, N)
    weights: Tensor  #: beta = (K + sn2 I)^-1 (y - offset) (k, N)
    input_dim: int  #: m, how many of the last features are certain inputs (controls)
    predicts: Predicts  #: what the targets mean
    signals: Signals = UNKNOWN  #: names and time step of the data, where they are known
    #: noise variances of ``targets`` (k,). They are ``noise_variance`` until
    #: ``gpmpc.estimation.separate_noise`` makes that the process' part alone. None of
    #: pseudo-observations, as of a sparse model: each has a noise of its own,
    #: correlated with that of others
    observation_noise: Tensor | None = None

    _part = property(lambda self: self.features)

    @classmethod
    def from_hyperparameters(
        cls,
        features: Tensor,
        targets: Tensor,
        lengthscales: Tensor,
        signal_variance: Tensor,
        noise_variance: Tensor,
        input_dim: int,
        predicts: Predicts = "next_state",
        offset: Tensor | None = None,
        signals: Signals = UNKNOWN,
    ) -> "GPPosterior":
        """Factorises K + sn2 I and solves for the weights.

        Args:
            features: x~ = (x, u) (N, d), d = n + m, float64 like all that follows.
            targets: (N, k); k = n unless ``predicts="value"``.
            lengthscales: (k, d).
            signal_variance: (k,).
            noise_variance: (k,).
            input_dim: m, how many of the last features are controls.
            predicts: ``"next_state"``; ``"difference"`` for targets x[k+1] - x[k]; or
                ``"value"`` for any function of (x, u) with k outputs, such as the
                residual of a known model.
            offset: Constant prior means (k,); zero by default.
            signals: Names of states and inputs, and time step, where they are known.

        Raises:
            ShapeError: The shapes do not belong together, or there is no row.
            SettingError: A hyperparameter is not positive, a dtype or device differs,
                or the kernel matrix is not positive definite.
            DataError: An entry is not finite.
        """
        check_tensors(targets=targets)
        offset = targets.new_zeros(targets.shape[-1:]) if offset is None else offset
        check_gp_tensors(
            features,
            targets,
            input_dim,
            predicts,
            lengthscales=lengthscales,
            signal_variance=signal_variance,
            noise_variance=noise_variance,
            offset=offset,
        )
        check_signals(signals)
        signals.check_sizes(features.shape[1] - input_dim, input_dim)
        cholesky = factorize(features, lengthscales, signal_variance, noise_variance)
        residuals = (targets - offset).mT[..., None]
        # One after another: torch copies the factors it is given.
        weights = [
            torch.cholesky_solve(residual, factor)[:, 0]
            for residual, factor in zip(residuals, cholesky, strict=True)
        ]
        noise_variance = noise_variance.clone()
        return cls(
            features=features.clone(),
            targets=targets.clone(),
            lengthscales=lengthscales.clone(),
            signal_variance=signal_variance.clone(),
            noise_variance=noise_variance,
            observation_noise=noise_variance,
            offset=offset.clone(),
            cholesky=cholesky,
            weights=torch.stack(weights),
            input_dim=int(input_dim),  # files hold no NumPy numbers
            predicts=predicts,
            signals=signals,
        )

    def unscaled(self, features: Scaling, targets: Scaling) -> "GPPosterior":
        """Converts GPs that were trained on scaled data to physical units.

        Args:
            features: The scaling of x~ (n + m,).
            targets: The scaling of the targets (k,).

        Raises:
            ShapeError: A scaling is of another number of columns.
        """
        columns = (features.factor.shape[0], targets.factor.shape[0])
        expected = (self.features.shape[1], self.output_dim)
        if columns != expected:
            raise ShapeError(
                f"scalings must be of {expected[0]} features and {expected[1]} "
                f"targets; got {columns[0]} and {columns[1]}"
            )
        observation_noise = self.observation_noise
        if observation_noise is not None:
            observation_noise = observation_noise * targets.factor**2
        return replace(
            self,
            features=features.restore(self.features),
            targets=targets.restore(self.targets),
            lengthscales=self.lengthscales * features.factor,
            signal_variance=self.signal_variance * targets.factor**2,
            noise_variance=self.noise_variance * targets.factor**2,
            observation_noise=observation_noise,
            offset=targets.restore(self.offset),
            cholesky=self.cholesky * targets.factor[:, None, None],
            weights=self.weights / targets.factor[:, None],
        )

    @property
    def state_dim(self) -> int:
        """Number of states, n: the uncertain features."""
        return self.features.shape[1] - self.input_dim

    @property
    def output_dim(self) -> int:
        """Number of outputs, k."""
        return self.targets.shape[1]

    def __len__(self) -> int:
        return len(self.features)

    def __repr__(self) -> str:
        return (
            f"GPPosterior({len(self)} points, n={self.state_dim}, m={self.input_dim}, "
            f"k={self.output_dim}, predicts={self.predicts!r}, "
            f"{self.dtype} on {self.device})"
        )

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance (k, k) of what scatters the data around the prediction, diagonal.

        Propagators add it to every step as process noise.
        """
        return torch.diag(self.noise_variance)

    @property
    def precision(self) -> Tensor:
        """(K + sn2 I)^-1 (k, N, N)."""
        # computed within no_grad it would stay without a graph
        if self.cholesky.requires_grad:
            return torch.cholesky_inverse(self.cholesky)
        return self._constant_precision

    @cached_property
    def _constant_precision(self) -> Tensor:
        return torch.cholesky_inverse(self.cholesky)

    @cached_property
    def packed(self) -> "Packed":
        """The arrays of the compiled loops, for a float64 model in host memory."""
        from gpmpc._kernels import pack  # loads numba

        return pack(
            self.features.numpy(),
            self.lengthscales.numpy(),
            self.signal_variance.numpy(),
            self.cholesky.numpy(),
            self.weights.numpy(),
            self.state_dim,
        )

    @cached_property
    def prediction_tensors(self) -> tuple[Tensor, ...]:
        """The tensors that predictions are made of."""
        return (
            self.weights,
            self.lengthscales,
            self.signal_variance,
            self.offset,
            self.features,
            self.cholesky,
        )

    @property
    def on_host(self) -> bool:
        """Whether compiled loops can evaluate it: constant float64 in host memory.

        Within ``torch.no_grad`` everything is constant.
        """
        if not self._can_be_on_host:
            return False
        if torch.is_grad_enabled():
            for tensor in self.prediction_tensors:  # quicker than any(...)
                if tensor.requires_grad:
                    return False
        return True

    @cached_property
    def _can_be_on_host(self) -> bool:
        """Whether it is float64 in host memory that no function transform follows."""
        if any(
            forward_ad.unpack_dual(tensor).tangent is not None
            for tensor in self.prediction_tensors
        ):
            return False
        numbers = [tensor.detach() for tensor in self.prediction_tensors]
        return self.dtype is torch.float64 and constant_arrays(*numbers) is not None

    @cached_property
    def _offset_array(self) -> Array:
        """The prior means (k,) in host memory."""
        return self.offset.numpy()

    @cached_property
    def _adds_state(self) -> bool:
        """Whether a prediction is the state and what the GPs predict."""
        return self.predicts == "difference"

    @property
    def affine_form(self) -> AffineForm:
        """The model as moments are composed: A = 0, or A = I for differences."""
        return AffineForm(self, A=self._eye if self._adds_state else None)

    @property
    def _eye(self) -> Tensor:
        return torch.eye(self.state_dim, dtype=self.dtype, device=self.device)

    @property
    def has_observation_noise(self) -> bool:
        """Whether ``targets`` are observations, with the noise ``observation_noise``.

        Those of a sparse model are pseudo-observations instead.
        """
        return self.observation_noise is not None

    def to(
        self, device: str | torch.device | None = None, dtype: torch.dtype | None = None
    ) -> "GPPosterior":
        """Moves the posterior to another device or type, float32 or float64.

        Tensors that are there already are shared, not copied.
        """
        check_destination(device, dtype)

        def move(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=dtype)

        observation_noise = self.observation_noise
        if observation_noise is not None:
            observation_noise = move(observation_noise)
        return replace(
            self,
            features=move(self.features),
            targets=move(self.targets),
            lengthscales=move(self.lengthscales),
            signal_variance=move(self.signal_variance),
            noise_variance=move(self.noise_variance),
            observation_noise=observation_noise,
            offset=move(self.offset),
            cholesky=move(self.cholesky),
            weights=move(self.weights),
        )

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """Predicts the outputs at a certain state and input.

        They are the next state, or the values of GPs with ``predicts="value"``.
        Rasmussen and Williams (2006), eqs. (2.25) and (2.26).

        Args:
            state: x (*batch, n).
            input: u (*batch, m); may be left out where m = 0.

        Returns:
            Mean (*batch, k) and diagonal covariance (*batch, k, k) of the latent
            function: observation noise is not added.

        Raises:
            ShapeError: State or input do not fit the model.
        """
        return self._belief(self._cross_covariances(state, input).k, state)

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the mean at K points (K, n), (K, m).

        The compiled kernels do it where they can, else torch.
        """
        if check_and_choose_compiled(self.on_host):
            from gpmpc import _kernels as kernels  # loads numba

            gps = kernels.linearize_gps(
                self.packed,
                states,
                inputs,
                covariance,
                self._offset_array,
                self._adds_state,
            )
            return Linearized(
                mean=gps.mean, A=gps.A, B=gps.B, covariance=gps.covariance
            )
        x, u = tensors_for(self, states, inputs)
        cross = self._cross_covariances(x, u)
        jacobian = self._jacobian(cross)
        V = None
        if covariance:
            V = to_array(self._belief(cross.k, x).covariance)
        return Linearized(
            mean=to_array(self._mean(cross.k, x)),
            A=to_array(jacobian.by_state),
            B=to_array(jacobian.by_input),
            covariance=V,
        )

    def predict_with_jacobian(
        self, state: Tensor, input: Tensor | None = None
    ) -> FirstOrderExpansion:
        """Predicts with the mean's derivatives, by torch.

        Returns:
            What ``predict`` gives, and the derivatives by state (*batch, k, n) and by
            input (*batch, k, m).
        """
        cross = self._cross_covariances(state, input)
        jacobian = self._jacobian(cross)
        return FirstOrderExpansion(
            belief=self._belief(cross.k, state),
            A=jacobian.by_state,
            B=jacobian.by_input,
        )

    def variance_reduction(
        self, k: Tensor, outputs: list[int] | slice = slice(None)
    ) -> Tensor:
        """Computes how far the data reduce the variance, |L_a^-1 k_a|^2 (*batch, k).

        Args:
            k: Covariances with the points (*batch, k, N).
            outputs: The GPs that they belong to.
        """
        # The batch goes to the right-hand side's columns: broadcast against it, L would
        # be copied for every member.
        columns = k.unsqueeze(0).flatten(0, -3).movedim(0, -1)  # (k, N, batch)
        factor = self.cholesky[outputs]
        whitened = torch.linalg.solve_triangular(factor, columns, upper=False)
        return whitened.square().sum(-2).mT.reshape(k.shape[:-1])

    def _cross_covariances(
        self, state: Tensor, input: Tensor | None
    ) -> "_CrossCovariances":
        """Computes the prior covariances of a query with the points."""
        input = state[..., :0] if input is None else input
        check_query(self, state, input)
        query = torch.cat([state, input], dim=-1)
        difference = self.features - query[..., None, :]  # (*batch, N, d)
        scaled_difference = difference[..., None, :, :] / self.lengthscales[:, None, :]
        squares = scaled_difference.square().sum(-1)
        return _CrossCovariances(
            k=kernel_of_squares(squares, self.signal_variance[:, None]),
            scaled_difference=scaled_difference,
        )

    def _mean(self, k: Tensor, state: Tensor) -> Tensor:
        """Computes the mean (*batch, k) from covariances (*batch, k, N)."""
        mean = (k * self.weights).sum(-1) + self.offset
        return mean + state if self._adds_state else mean

    def _belief(self, k: Tensor, state: Tensor) -> Gaussian:
        """Computes mean and covariance from covariances (*batch, k, N)."""
        variance = (self.signal_variance - self.variance_reduction(k)).clamp_min(0)
        return Gaussian(self._mean(k, state), torch.diag_embed(variance))

    def _jacobian(self, cross: "_CrossCovariances") -> "_Jacobian":
        """Computes the mean's derivatives."""
        weighted = (cross.k * self.weights)[..., None, :]  # (*batch, k, 1, N)
        slopes = cross.scaled_difference / self.lengthscales[:, None, :]
        jacobian = (weighted @ slopes)[..., 0, :]
        by_state = jacobian[..., : self.state_dim]
        if self._adds_state:
            by_state = by_state + self._eye
        return _Jacobian(by_state=by_state, by_input=jacobian[..., self.state_dim :])


class _CrossCovariances(NamedTuple):
    """Prior covariances of a query x~ with the points x~_i."""

    k: Tensor  #: k(x~_i, x~) (*batch, k, N)
    scaled_difference: Tensor  #: (x~_i - x~) / l (*batch, k, N, d)


class _Jacobian(NamedTuple):
    """Derivatives of a mean."""

    by_state: Tensor  #: (*batch, k, n)
    by_input: Tensor  #: (*batch, k, m)


def check_posterior(key: str, posterior: Any) -> None:
    """Raises ``UnsupportedModel`` of a model that is no ``GPPosterior``."""
    if isinstance(posterior, GPPosterior):
        return
    got = type(posterior).__name__
    if hasattr(posterior, "residual") and hasattr(posterior, "append"):
        got += f" (its GPs are its `residual`; {got}.append takes transitions)"
    raise UnsupportedModel(f"{key} must be a GPPosterior; got {got}")
