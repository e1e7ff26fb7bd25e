"""Check of a propagator of your own: ``check_propagator``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array, linearize
from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian, square_root
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, ResidualModel
from gpmpc.propagation import Propagation, Propagator, differentiate
from gpmpc.testing._promise import require, require_close, require_covariance

_DRAWS = 100_000  # of the Monte Carlo reference
_STEP = 1e-5  # of the finite differences, in units of the belief

# The parts of a propagation by their names in messages.
_Parts = Mapping[str, Tensor]


@dataclass(frozen=True)
class _Case:
    """A propagator with what it claims, a model, and where it is evaluated."""

    propagator: Propagator
    model: Any
    belief: Gaussian
    input: Tensor
    predicts_variances_only: bool
    noise: Tensor  # covariance that the propagator adds (k, k)
    samples: int | None  # states that it draws

    def propagate(
        self, belief: Gaussian | None = None, input: Tensor | None = None
    ) -> Propagation:
        """Propagates a belief and an input; by default the case's own."""
        if belief is None:
            belief = self.belief
        if input is None:
            input = self.input
        return self.propagator.propagate(self.model, belief, input)

    def expected_covariance(self, latent: Tensor) -> Tensor:
        """Returns what the method claims to predict of a latent covariance."""
        covariance = latent + self.noise
        if self.predicts_variances_only:
            return torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
        return covariance

    @property
    def sampling_error(self) -> float:
        """Allowance for the draws of a method that samples."""
        return 10 * self.samples**-0.5 if self.samples else 0.0


@explains_arguments
def check_propagator(
    propagator: Propagator,
    model: Any = None,
    exact: bool = False,
    *,
    linear: bool = True,
    diagonal: bool = False,
    process_noise: bool | None = None,
    samples: int | None = None,
) -> None:
    """Checks a propagator against the protocol ``gpmpc.propagation.Propagator``.

    It is compared with the plain prediction where nothing is uncertain, with the exact
    result on a linear model, with Monte Carlo if it claims to be exact, with the loop
    over a batch, with single precision, and its derivatives with finite differences.

    Args:
        propagator: The object to check.
        model: A model to check it with, in float64; small GPs of next states and of
            differences by default.
        exact: It claims the exact moments. Any method, exact or not, must approach the
            plain prediction in proportion to a vanishing covariance.
        linear: It claims to be exact where the model is linear, and first-order
            accurate in its input-output covariance. All methods of this package but
            mean equivalence do.
        diagonal: It claims the variances only, and predicts no correlation of the
            outputs.
        process_noise: It adds the model's noise covariance; by default as its attribute
            of that name says.
        samples: How many states it draws, if it does; its own standard error is then
            allowed for.

    Raises:
        AssertionError: The propagator breaks a promise; the message says which, and by
            how much.
    """
    if process_noise is None:
        process_noise = bool(getattr(propagator, "process_noise", False))

    def case_of(model: Any) -> _Case:
        noise = model.noise_covariance
        if not process_noise:
            noise = torch.zeros_like(noise)
        return _Case(
            propagator=propagator,
            model=model,
            belief=_belief(model),
            input=torch.full(
                (model.input_dim,), 0.2, dtype=model.dtype, device=model.device
            ),
            predicts_variances_only=diagonal,
            noise=noise,
            samples=samples,
        )

    models = [_small_gp("next_state"), _small_gp("difference")]
    if model is not None:
        models = [model]
    for each in models:
        case = case_of(each)
        result = _check_result(case)
        _check_repetition(case, result.belief)
        _check_without_covariance(case)
        _check_batch(case)
        _check_single_precision(case)
        if exact:
            _check_monte_carlo(case)
        if linear:
            _check_first_order_correlation(case)
        _check_derivatives(case)
    if linear:
        _check_linear(case_of(_linear_model()))


def _belief(model: Any) -> Gaussian:
    """Returns a belief about the state, with correlations."""
    n = model.state_dim
    like = torch.zeros(0, dtype=model.dtype, device=model.device)
    identity = torch.eye(n).to(like)
    correlations = torch.ones(n, n).tril(-1).to(like)
    root = 0.2 * identity + 0.05 * correlations
    mean = torch.linspace(0.3, -0.4, n, dtype=model.dtype, device=model.device)
    return Gaussian(mean, root @ root.mT)


def _small_gp(predicts: Literal["next_state", "difference"]) -> GPPosterior:
    """Returns a GP of two states, one input, 15 points."""
    generator = torch.Generator().manual_seed(0)
    features = 4 * torch.rand(15, 3, generator=generator, dtype=torch.float64) - 2
    first_target = torch.sin(features[:, 0] + features[:, 2])
    second_target = features[:, 1].cos() * features[:, 0]
    ones = torch.ones(2, dtype=torch.float64)
    return GPPosterior.from_hyperparameters(
        features,
        torch.stack([first_target, second_target], dim=1),
        lengthscales=_float64([[1.0, 1.5, 2.0], [1.4, 0.9, 3.0]]),
        signal_variance=ones,
        noise_variance=1e-2 * ones,
        input_dim=1,
        predicts=predicts,
    )


def _linear_model() -> ResidualModel:
    """Returns a model x+ = A x + B u + c, known so well that a GP adds nothing.

    It is of a class that every method takes.
    """
    nominal = Affine(
        _float64([[0.9, 0.3], [-0.2, 0.8]]),
        _float64([[0.0], [0.5]]),
        _float64([0.1, -0.2]),
    )
    zero = torch.zeros(1, 3, dtype=torch.float64)
    tiny = torch.full((2,), 1e-24, dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(
        zero,
        zero[:, :2],
        lengthscales=zero.expand(2, 3) + 1,
        signal_variance=tiny,
        noise_variance=tiny,
        input_dim=1,
        predicts="value",
    )
    return ResidualModel(nominal, gp, torch.eye(2, dtype=torch.float64), [0, 1], [0], 1)


def _float64(values: list) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _parts(result: Propagation) -> _Parts:
    return {
        "mean": result.belief.mean,
        "covariance": result.belief.covariance,
        "cross covariance": result.cross_covariance,
        "deficit": result.deficit,
    }


def _require_close_parts(
    promise: str,
    parts: _Parts,
    expected: _Parts,
    tolerance: float,
    floor: float = 1.0,
) -> None:
    """Raises unless the parts that are expected are close."""
    for name, value in expected.items():
        require_close(promise, parts[name], value, tolerance, f"the {name}", floor)


def _check_result(case: _Case) -> Propagation:
    """Checks the shapes, types and values of a result, and returns it."""
    arguments = {
        "mean": case.belief.mean,
        "covariance": case.belief.covariance,
        "input": case.input,
    }
    before = {name: tensor.clone() for name, tensor in arguments.items()}
    result = case.propagate()
    for name, tensor in arguments.items():
        require(
            torch.equal(before[name], tensor),
            f"the caller's {name} is left as it is",
            f"{before[name].tolist()} became {tensor.tolist()}",
        )
    _check_parts(case, _parts(result))
    require_covariance("propagate", result.belief.covariance)
    deficit = float(result.deficit)
    require(deficit >= 0, "deficit is not negative", f"got {deficit}")
    if case.predicts_variances_only:
        off_diagonal = result.belief.covariance - torch.diag(result.belief.variance)
        require(
            not bool(off_diagonal.any()),
            "a diagonal method predicts no correlation",
            f"got {off_diagonal.tolist()}",
        )
    return result


def _check_parts(case: _Case, parts: _Parts) -> None:
    """Checks shape, type and values of every part of a result."""
    n = case.model.state_dim
    k = case.model.output_dim
    shapes = {
        "mean": (k,),
        "covariance": (k, k),
        "cross covariance": (n, k),
        "deficit": (),
    }
    for name, part in parts.items():
        shape = tuple(part.shape)
        require(
            shape == shapes[name] and part.dtype == case.belief.mean.dtype,
            f"{name} has shape {shapes[name]} for one belief, and its type",
            f"got {shape}, {part.dtype}",
        )
        is_finite = bool(torch.isfinite(part).all())
        require(is_finite, f"{name} is finite", f"got {part.tolist()}")


def _check_repetition(case: _Case, first: Gaussian) -> None:
    """Checks that the second result, and that of a call, are the first one."""
    second = case.propagate().belief
    called = case.propagator(case.model, case.belief, case.input)
    for promise, other in (
        ("the same belief gives the same result", second),
        ("calling it propagates", called),
    ):
        same_mean = torch.equal(other.mean, first.mean)
        same_covariance = torch.equal(other.covariance, first.covariance)
        require(same_mean and same_covariance, promise, f"got {other} after {first}")


def _check_without_covariance(case: _Case) -> None:
    """Compares a certain, and an almost certain state, with the plain prediction."""

    def parts(scale: float) -> _Parts:
        belief = Gaussian(case.belief.mean, scale * case.belief.covariance)
        return _parts(case.propagate(belief))

    of_certain = parts(0.0)
    of_wide = parts(1e-2)
    of_narrow = parts(1e-6)
    plain = case.model.predict(case.belief.mean, case.input)
    expected = {
        "mean": plain.mean,
        "covariance": case.expected_covariance(plain.covariance),
    }
    _require_close_parts(
        "without covariance it is the plain prediction", of_certain, expected, 1e-8
    )
    require_close(
        "a certain state correlates with nothing",
        of_certain["cross covariance"],
        torch.zeros_like(of_certain["cross covariance"]),
        1e-10,
    )
    # A draw's error falls as the root of the covariance's scale, and so slower.
    rate = 5e-2 if case.samples else 1e-3
    for name, value in expected.items():
        distance = float((of_wide[name] - value).abs().max())
        narrow_distance = float((of_narrow[name] - value).abs().max())
        require(
            narrow_distance <= rate * distance + 1e-9,
            f"the {name} approaches the plain prediction as the covariance vanishes",
            f"with the covariance times 1e-2 it is {distance:.2e} away, "
            f"times 1e-6 still {narrow_distance:.2e}",
        )


def _check_batch(case: _Case) -> None:
    """Compares batches of beliefs with the loop over their members."""
    mean = case.belief.mean
    shifts = torch.linspace(-0.5, 0.5, 4, dtype=mean.dtype, device=mean.device)
    means = mean + shifts[:, None]
    covariances = case.belief.covariance * (1 + shifts)[:, None, None]
    inputs = case.input + shifts[:, None]
    members = [
        _parts(case.propagate(Gaussian(means[i], covariances[i]), inputs[i]))
        for i in range(len(shifts))
    ]
    for shape in ((4,), (2, 2)):
        belief = Gaussian(means.unflatten(0, shape), covariances.unflatten(0, shape))
        batch = _parts(case.propagate(belief, inputs.unflatten(0, shape)))
        for name, part in batch.items():
            stacked_members = torch.stack([member[name] for member in members])
            require_close(
                f"a batch is the loop over its members, here of shape {shape}",
                part,
                stacked_members.unflatten(0, shape),
                1e-9,
                f"the {name}",
                floor=1.0 if name == "mean" else 1e-4,
            )


def _check_single_precision(case: _Case) -> None:
    """Compares a result in float32 with that in float64, if the model has both."""
    if not hasattr(case.model, "to"):
        return
    belief = Gaussian(case.belief.mean.float(), case.belief.covariance.float())
    single = case.propagator.propagate(
        case.model.to(dtype=torch.float32), belief, case.input.float()
    )
    for name, part in _parts(single).items():
        require(
            part.dtype == torch.float32,
            f"a float32 model and belief give a float32 {name}",
            f"got {part.dtype}",
        )
    _require_close_parts(
        "float32 agrees with float64 to two digits",
        _parts(single),
        _parts(case.propagate()),
        1e-2,
        floor=0.1,
    )


def _check_monte_carlo(case: _Case) -> None:
    """Compares claimed moments with the sample means that they stand for.

    The differences are in standard errors.
    """
    claimed = _parts(case.propagate())
    draws = _draw_moments(case, claimed["mean"])
    # The variance of a method that draws itself adds to that of the reference.
    variance_ratio = 1 + _DRAWS / case.samples if case.samples else 1.0
    for name, values in draws.items():
        standard_error = (values.std(0) ** 2 * variance_ratio / _DRAWS).sqrt()
        round_off = 1e-9 * values.abs().max() + 1e-300
        difference = (values.mean(0) - claimed[name]).abs()
        largest = float((difference / (standard_error + round_off)).max())
        require(
            largest < 5,
            f"an exact method's {name} agrees with {_DRAWS} draws of Monte Carlo",
            f"it is {largest:.1f} standard errors away:\n"
            f"{claimed[name].tolist()} is off by {difference.tolist()}",
        )


def _draw_moments(case: _Case, mean: Tensor) -> _Parts:
    """Returns values at random states whose means are the moments about ``mean``."""
    belief = case.belief
    generator = torch.Generator().manual_seed(1)
    normal = torch.randn(_DRAWS, belief.dim, generator=generator, dtype=torch.float64)
    deviations = normal.to(belief.mean) @ square_root(belief.covariance)
    predictions = [
        case.model.predict(belief.mean + part, case.input.expand(len(part), -1))
        for part in deviations.split(10_000)
    ]
    means = torch.cat([prediction.mean for prediction in predictions])
    covariances = torch.cat([prediction.covariance for prediction in predictions])
    centred = means - mean
    products = centred[:, :, None] * centred[:, None, :] + covariances
    return {
        "mean": means,
        "covariance": case.expected_covariance(products),
        "cross covariance": deviations[:, :, None] * centred[:, None, :],
    }


def _check_first_order_correlation(case: _Case) -> None:
    """Compares the correlation with an almost certain state with S A'."""
    mean = case.belief.mean
    S = case.belief.covariance
    linearized = linearize(
        case.model, _one_row(mean), _one_row(case.input), covariance=False
    )
    A = torch.from_numpy(linearized.A[0]).to(mean)
    scale = 1e-6
    result = case.propagate(Gaussian(mean, scale * S))
    require_close(
        "the cross covariance Cov[x, x+] is S A' to first order",
        result.cross_covariance / scale,
        S @ A.mT,
        1e-3 + case.sampling_error,
        floor=float(S.abs().max()),
    )


def _one_row(vector: Tensor) -> Array:
    """Returns a vector (n,) as a C-contiguous float64 array (1, n)."""
    return np.ascontiguousarray(vector[None].double().cpu().numpy())


def _check_linear(case: _Case) -> None:
    """Compares the result on a linear model with the exact one."""
    try:
        result = case.propagate()
    except UnsupportedModel:
        return  # a method may take other models only
    S = case.belief.covariance
    A = case.model.nominal.A
    expected = {
        "mean": case.model.nominal(case.belief.mean, case.input),
        "covariance": case.expected_covariance(A @ S @ A.mT),
        "cross covariance": S @ A.mT,
    }
    _require_close_parts(
        "on a linear model it is exact",
        _parts(result),
        expected,
        1e-8 + case.sampling_error,
        floor=0.1,
    )


def _check_derivatives(case: _Case) -> None:
    """Checks all six derivatives of ``differentiate``, along two directions each."""
    result, derivatives = differentiate(
        case.propagator, case.model, case.belief, case.input
    )
    require_close(
        "differentiate: the belief is propagate's",
        result.belief.mean,
        case.propagate().belief.mean,
        1e-9,
        "the mean",
    )
    arguments = {
        "mean": case.belief.mean,
        "covariance": case.belief.covariance,
        "input": case.input,
    }
    generator = torch.Generator().manual_seed(2)
    for argument, value in 2 * list(arguments.items()):
        normal = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        direction = normal.to(case.belief.mean)
        if argument == "covariance":
            direction = (direction + direction.mT) / 2
        slopes = _numeric_slopes(case, arguments, argument, direction)
        dimensions = tuple(range(-direction.dim(), 0))
        for moment in ("mean", "covariance"):
            name = f"{moment}_by_{argument}"
            require_close(
                f"differentiate: {name} agrees with finite differences",
                (getattr(derivatives, name) * direction).sum(dimensions),
                slopes[moment],
                1e-5,
            )


def _numeric_slopes(
    case: _Case, arguments: _Parts, argument: str, direction: Tensor
) -> _Parts:
    """Returns central differences of mean and covariance along a direction."""

    def parts(step: float) -> _Parts:
        shifted = {**arguments, argument: arguments[argument] + step * direction}
        belief = Gaussian(shifted["mean"], shifted["covariance"])
        return _parts(case.propagate(belief, shifted["input"]))

    above = parts(_STEP)
    below = parts(-_STEP)
    return {
        moment: (above[moment] - below[moment]) / (2 * _STEP)
        for moment in ("mean", "covariance")
    }
