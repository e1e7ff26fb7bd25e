"""Problem: predict the next state from a trained exact GP, fast and safely under torch's function transforms.

GPyTorch trains; what it found is frozen here to plain tensors: data, Cholesky factor, weights and hyperparameters, one
GP per output with the squared exponential kernel with automatic relevance determination (SE-ARD),

    k_a(x~, x~') = sf2_a exp(-1/2 sum_d (x~_d - x~'_d)^2 / l_ad^2),   x~ = (x, u)

Rasmussen and Williams (2006), eqs. (2.25)-(2.26), Algorithm 2.1; the GP model of Cao, Lai and Alam (2017).

An affine scaling of the data is only another parametrisation of such a GP: length-scales in the units of the inputs,
standard deviations in those of the output, and a constant prior mean. So a posterior knows no scaling: it holds, takes
and gives physical units.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp.evaluation import host_arrays
from gpmpc.gp.model import hyperparameters
from gpmpc.gp.scaling import Scaling
from gpmpc.gp.transitions import Transitions

if TYPE_CHECKING:
    from gpmpc.fused import Packed

Predicts = Literal["next_state", "difference", "value"]
PREDICTS = ("next_state", "difference", "value")
IGNORED = 1e8  # length-scale of an input that drops out of a kernel, in units of its magnitude


@dataclass(frozen=True)
class GPPosterior:
    """Exact GPs, one per output, over the same N points; build it with one of the ``from_`` methods.

    Attributes:
        features: x~ = (x, u) of the training points (N, n + m).
        targets: What the GPs learned (N, k): next states, differences x[k+1] - x[k] (k = n), or any values.
        lengthscales: l (k, n + m), one row an output.
        signal_variance: sf2 (k,).
        noise_variance: sn2 (k,).
        offset: The prior mean, one constant an output (k,).
        cholesky: Lower factor L of K + sn2 I (k, N, N).
        weights: beta = (K + sn2 I)^-1 (y - offset) (k, N).
        input_dim: m, how many of the last features are certain inputs (controls).
        predicts: What the targets mean.
    """

    features: Tensor
    targets: Tensor
    lengthscales: Tensor
    signal_variance: Tensor
    noise_variance: Tensor
    offset: Tensor
    cholesky: Tensor
    weights: Tensor
    input_dim: int
    predicts: Predicts

    @classmethod
    def from_hyperparameters(
        cls,
        inputs: Tensor,
        targets: Tensor,
        lengthscales: Tensor,
        signal_variance: Tensor,
        noise_variance: Tensor,
        input_dim: int,
        predicts: Predicts = "next_state",
        offset: Tensor | None = None,
    ) -> "GPPosterior":
        """Factorises K + sn2 I and solves for the weights.

        Args:
            inputs: The GPs' inputs x~ = (x, u) (N, d), d = n + m, float64 like all that follows.
            targets: (N, k); k = n unless ``predicts="value"``.
            lengthscales: (k, d).
            signal_variance: (k,).
            noise_variance: (k,).
            input_dim: m, how many of the last columns of ``inputs`` are controls.
            predicts: ``"next_state"``; ``"difference"`` for targets x[k+1] - x[k]; or ``"value"`` for any function of
                (x, u) with k outputs, such as the residual of a known model.
            offset: Constant prior means (k,); zero by default.

        Raises:
            ShapeError: The shapes do not belong together, or there is no row.
            SettingError: A hyperparameter is not positive, a dtype or device differs, or the kernel matrix is not
                positive definite.
            DataError: An entry is not finite.
        """
        if inputs.dim() != 2 or targets.dim() != 2 or not len(inputs):
            raise ShapeError(
                "inputs (N, d) and targets (N, k) need two dimensions and a row; "
                f"got {tuple(inputs.shape)} and {tuple(targets.shape)}"
            )
        k, d = targets.shape[1], inputs.shape[1]
        offset = torch.zeros_like(targets[0]) if offset is None else offset
        expected = {
            "inputs": (inputs, (len(inputs), d)),
            "targets": (targets, (len(inputs), k)),
            "lengthscales": (lengthscales, (k, d)),
            "signal_variance": (signal_variance, (k,)),
            "noise_variance": (noise_variance, (k,)),
            "offset": (offset, (k,)),
        }
        for name, (value, shape) in expected.items():
            if tuple(value.shape) != shape:
                raise ShapeError(f"{name} must have shape {shape}; got {tuple(value.shape)}")
            if value.dtype != torch.float64:
                raise SettingError(name, f"must be float64 (convert after: posterior.to(dtype=...)); got {value.dtype}")
            if value.device != inputs.device:
                raise SettingError(name, f"must be on the device of inputs, {inputs.device}; got {value.device}")
            if not bool(torch.isfinite(value).all()):
                raise DataError(f"{name} must be finite; got {value[~torch.isfinite(value)][0]}")
        if predicts not in PREDICTS:
            raise SettingError("predicts", f"must be one of {', '.join(map(repr, PREDICTS))}; got {predicts!r}")
        if not 0 <= input_dim < d or (predicts != "value" and d != k + input_dim):
            raise ShapeError(
                f"inputs must have n + m columns, one state an output and {input_dim} controls; "
                f"got {d} columns and {k} outputs"
            )
        for name in ("lengthscales", "signal_variance", "noise_variance"):
            if not bool((expected[name][0] > 0).all()):
                raise SettingError(name, f"must be positive; got {expected[name][0].tolist()}")
        kernel = kernel_matrix(inputs, inputs, lengthscales, signal_variance)
        kernel.diagonal(dim1=-2, dim2=-1).add_(noise_variance[:, None])
        cholesky, info = torch.linalg.cholesky_ex(kernel)
        if bool(info.any()):
            output = int(torch.nonzero(info)[0])
            raise SettingError(
                "noise_variance",
                f"the kernel matrix of output {output} is not positive definite in float64; "
                f"signal-to-noise ratio {float((signal_variance / noise_variance)[output]):.1e}: raise the noise",
            )
        weights = torch.cholesky_solve((targets - offset).mT[..., None], cholesky)[..., 0]
        return cls(
            inputs,
            targets,
            lengthscales,
            signal_variance,
            noise_variance,
            offset,
            cholesky,
            weights,
            input_dim,
            predicts,
        )

    @classmethod
    def from_gpytorch(
        cls, model: Any, likelihood: Any = None, *, input_dim: int, predicts: Predicts = "next_state"
    ) -> "GPPosterior":
        """Freezes trained SE-ARD ExactGPs of GPyTorch: one, a batch (one batch dimension, an output each), or a list.

        Args:
            model: An ``ExactGP`` with a zero or constant mean and an ``RBFKernel``, scaled by a ``ScaleKernel`` or
                not; an ``IndependentModelList``; or a sequence of models over the same inputs.
            likelihood: Its ``GaussianLikelihood``, or a list of them; the models' own by default.
            input_dim: m.
            predicts: What the training targets mean.

        Raises:
            UnsupportedModel: The kernel, mean or likelihood is another one, or transforms are attached.
        """
        return cls.from_hyperparameters(**hyperparameters(model, likelihood), input_dim=input_dim, predicts=predicts)

    def unscaled(self, features: Scaling, targets: Scaling) -> "GPPosterior":
        """The same GPs in physical units, where these were trained on scaled data.

        Args:
            features: The scaling of x~ = (x, u), (n + m,).
            targets: The scaling of the targets (k,).
        """
        return replace(
            self,
            features=features.restore(self.features),
            targets=targets.restore(self.targets),
            lengthscales=self.lengthscales * features.factor,
            signal_variance=self.signal_variance * targets.factor**2,
            noise_variance=self.noise_variance * targets.factor**2,
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

    @property
    def dtype(self) -> torch.dtype:
        """Of every tensor."""
        return self.features.dtype

    @property
    def device(self) -> torch.device:
        """Of every tensor."""
        return self.features.device

    def __len__(self) -> int:
        return len(self.features)

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations (k, k), diagonal."""
        return torch.diag(self.noise_variance)

    @cached_property
    def precision(self) -> Tensor:
        """(K + sn2 I)^-1 (k, N, N)."""
        return torch.cholesky_inverse(self.cholesky)

    @cached_property
    def packed(self) -> "Packed":
        """The arrays of the compiled loops, for a float64 model in host memory."""
        from gpmpc.fused import pack  # loads numba

        parts = (self.features, self.lengthscales, self.signal_variance, self.cholesky, self.weights)
        return pack(*(part.numpy() for part in parts), self.state_dim)

    def to(self, device: str | torch.device | None = None, dtype: torch.dtype | None = None) -> "GPPosterior":
        """The same on another device, or in another floating-point type."""
        tensors = {f.name: v for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        return replace(self, **{name: value.to(device=device, dtype=dtype) for name, value in tensors.items()})

    def save(self, path: str | Path) -> None:
        """Writes one file without pickle, in one piece or not at all; see ``gpmpc.gp.storage``."""
        from gpmpc.gp.storage import save_posterior  # which knows this class

        save_posterior(self, path)

    @classmethod
    def load(cls, path: str | Path) -> "GPPosterior":
        """Reads what ``save`` wrote; the predictions are the same, bit by bit.

        Raises:
            DataError: The file is missing, damaged, of another kind or of a newer format.
        """
        from gpmpc.gp.storage import load_posterior

        return load_posterior(path)

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """The next state's distribution at a certain state and input (Rasmussen and Williams, 2006, eq. (2.25)).

        Args:
            state: x (*batch, n).
            input: u (*batch, m); may be left out where m = 0.

        Returns:
            Mean (*batch, k) and diagonal covariance (*batch, k, k) of the latent function: observation noise is not
            added.

        Raises:
            ShapeError: State or input do not fit the model.
        """
        k, _ = self._correlations(state, input)
        return self._belief(k, state)

    def predict_with_jacobian(self, state: Tensor, input: Tensor | None = None) -> tuple[Gaussian, Tensor, Tensor]:
        """``predict``, and its mean's derivatives by the state (*batch, k, n) and by the input (*batch, k, m)."""
        input = state[..., :0] if input is None else input
        if host_arrays(self.features, state, input) is not None:
            mean, variance, by_state, by_input = self._compiled("point_with_jacobian", state, input)
            return Gaussian(mean, torch.diag_embed(variance)), by_state, by_input
        k, difference = self._correlations(state, input)
        return self._belief(k, state), *self._jacobian(k, difference)

    def mean_with_jacobian(self, state: Tensor, input: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """``predict_with_jacobian`` without the variance, which costs most of it: the mean (*batch, k) comes first."""
        input = state[..., :0] if input is None else input
        if host_arrays(self.features, state, input) is not None:
            return self._compiled("mean_with_jacobian", state, input)
        k, difference = self._correlations(state, input)
        return self._mean(k, state), *self._jacobian(k, difference)

    def mean_hessian(self, state: Tensor, input: Tensor | None = None) -> Tensor:
        """The mean's second derivatives by the state (*batch, k, n, n)."""
        k, difference = self._correlations(state, input)
        z = difference[..., : self.state_dim] / self.lengthscales[:, None, : self.state_dim]
        weighted = k * self.weights
        total = weighted.sum(-1)[..., None, None] * torch.diag_embed(self.lengthscales[:, : self.state_dim] ** -2)
        return (weighted[..., None] * z).mT @ z - total

    def sample(
        self,
        state: Tensor,
        input: Tensor | None = None,
        samples: int = 1,
        generator: torch.Generator | None = None,
        observation_noise: bool = False,
    ) -> Tensor:
        """Independent draws of the next state (samples, *batch, k).

        Args:
            state: x (*batch, n).
            input: u (*batch, m).
            samples: How many.
            generator: Of the random numbers; torch's global one by default.
            observation_noise: Adds the noise variance.
        """
        belief = self.predict(state, input)
        variance = belief.variance + self.noise_variance if observation_noise else belief.variance
        shape = (samples, *belief.mean.shape)
        normal = torch.randn(shape, generator=generator, dtype=self.dtype, device=self.device)
        return belief.mean + variance.sqrt() * normal

    def learned(self, transitions: Transitions) -> Tensor:
        """What the GPs would be told of transitions: next states, or differences (N, n).

        Raises:
            ShapeError: The transitions have other dimensions.
        """
        if (transitions.state_dim, transitions.input_dim) != (self.state_dim, self.input_dim):
            raise ShapeError(
                f"the model has {self.state_dim} states and {self.input_dim} inputs; "
                f"got transitions with {transitions.state_dim} and {transitions.input_dim}"
            )
        if self.predicts == "difference":
            return transitions.next_states - transitions.states
        return transitions.next_states

    def explained(self, k: Tensor) -> Tensor:
        """|L_a^-1 k_a|^2 (*batch, k) of k (*batch, k, N): how much of the variance the data explain.

        The batch goes to the right-hand side's columns: broadcast against it, L would be copied for every member.
        """
        if k.dim() == 2:
            return torch.linalg.solve_triangular(self.cholesky, k[..., None], upper=False)[..., 0].square().sum(-1)
        columns = k.flatten(0, -3).movedim(0, -1)  # (k, N, batch)
        squares = torch.linalg.solve_triangular(self.cholesky, columns, upper=False).square().sum(-2)
        return squares.mT.unflatten(0, k.shape[:-2])

    def _correlations(self, state: Tensor, input: Tensor | None) -> tuple[Tensor, Tensor]:
        """k(x~_i, x~) (*batch, k, N) and (x~_i - x~) / l (*batch, k, N, d)."""
        input = state[..., :0] if input is None else input
        check_query(self, state, input)
        query = torch.cat([state, input], dim=-1)
        difference = (self.features - query[..., None, :])[..., None, :, :] / self.lengthscales[:, None, :]
        return self.signal_variance[:, None] * torch.exp(-difference.square().sum(-1) / 2), difference

    def _mean(self, k: Tensor, state: Tensor) -> Tensor:
        mean = (k * self.weights).sum(-1) + self.offset
        return mean + state if self.predicts == "difference" else mean

    def _belief(self, k: Tensor, state: Tensor) -> Gaussian:
        variance = (self.signal_variance - self.explained(k)).clamp_min(0)
        return Gaussian(self._mean(k, state), torch.diag_embed(variance))

    def _jacobian(self, k: Tensor, difference: Tensor) -> tuple[Tensor, Tensor]:
        """The mean's derivatives by state and input, from what ``_correlations`` gives."""
        weighted = (k * self.weights)[..., None, :]  # (*batch, k, 1, N)
        jacobian = (weighted @ (difference / self.lengthscales[:, None, :]))[..., 0, :]
        by_state, by_input = jacobian[..., : self.state_dim], jacobian[..., self.state_dim :]
        if self.predicts == "difference":
            by_state = by_state + torch.eye(self.state_dim, dtype=self.dtype, device=self.device)
        return by_state, by_input

    def _compiled(self, function: str, state: Tensor, input: Tensor) -> list[Tensor]:
        """Mean, (variance,) and derivatives by state and input from ``gpmpc.fused``."""
        from gpmpc import fused

        check_query(self, state, input)
        batch = state.shape[:-1]
        found = getattr(fused, function)(self.packed, *(v.reshape(-1, v.shape[-1]).numpy() for v in (state, input)))
        parts = [torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in found[: min(len(found), 4)]]
        parts[0] += self.offset
        if self.predicts == "difference":
            parts[0] += state
            parts[-2].diagonal(dim1=-2, dim2=-1).add_(1.0)
        return parts


def check_query(model: Any, state: Tensor, input: Tensor) -> None:
    """Raises unless a state (*batch, n) and an input (*batch, m) fit a model in shape, type and device.

    Raises:
        ShapeError: Another number of states or inputs.
        SettingError: Another dtype or device.
    """
    if state.shape[-1:] != (model.state_dim,) or input.shape[-1:] != (model.input_dim,):
        got = [tensor.shape[-1] if tensor.dim() else "a scalar" for tensor in (state, input)]
        raise ShapeError(
            f"the model has {model.state_dim} states and {model.input_dim} inputs; got {got[0]} and {got[1]}"
        )
    for name, value in (("state", state), ("input", input)):
        if value.dtype != model.dtype or value.device != model.device:
            raise SettingError(
                name, f"must be {model.dtype} on {model.device} like the model; got {value.dtype} on {value.device}"
            )


def kernel_matrix(points: Tensor, others: Tensor, lengthscales: Tensor, signal_variance: Tensor) -> Tensor:
    """k_a(x~_i, x~_j) (k, N, M) of points (N, d) and others (M, d).

    Summed over differences a column at a time: exact for near points, where |x|^2 + |x'|^2 - 2 x'x cancels.
    """
    shape = (len(lengthscales), len(points), len(others))
    total = torch.zeros(shape, dtype=points.dtype, device=points.device)
    for ours, theirs, scale in zip(points.T, others.T, lengthscales.T, strict=True):
        total += ((ours[:, None] - theirs) / scale[:, None, None]).square()
    return signal_variance[:, None, None] * torch.exp(total / -2)
