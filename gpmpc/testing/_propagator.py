"""Check of a propagator of your own: ``check_propagator``."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import linearize
from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian, square_root
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, ResidualModel
from gpmpc.propagation import Propagation, Propagator, differentiate
from gpmpc.testing._promise import require, require_close, require_covariance

_DRAWS = 100_000  # of the Monte Carlo reference
_STEP = 1e-5  # of the finite differences, in units of the belief


@dataclass(frozen=True)
class _Case:
    """A propagator with what it claims, a model, and where it is evaluated."""

    propagator: Propagator
    model: Any
    belief: Gaussian
    input: Tensor
    diagonal: bool
    noise: Tensor
    samples: int | None

    def __call__(
        self, belief: Gaussian | None = None, input: Tensor | None = None
    ) -> Propagation:
        belief = belief or self.belief
        input = self.input if input is None else input
        return self.propagator.propagate(self.model, belief, input)

    def comparable(self, covariance: Tensor) -> Tensor:
        """What of an expected latent covariance the method claims to predict."""
        covariance = covariance + self.noise
        return (
            torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
            if self.diagonal
            else covariance
        )

    @property
    def sampling_error(self) -> float:
        """Allowance for the draws of a method that samples."""
        return 10 * self.samples**-0.5 if self.samples else 0.0


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

    def case(model: Any) -> _Case:
        n = model.state_dim
        like = {"dtype": model.dtype, "device": model.device}
        root = 0.2 * torch.eye(n, **like) + 0.05 * torch.ones(n, n, **like).tril(-1)
        belief = Gaussian(torch.linspace(0.3, -0.4, n, **like), root @ root.mT)
        noise = (
            model.noise_covariance
            if process_noise
            else torch.zeros_like(model.noise_covariance)
        )
        return _Case(
            propagator,
            model,
            belief,
            torch.full((model.input_dim,), 0.2, **like),
            diagonal,
            noise,
            samples,
        )

    for each in (
        [_small_gp("next_state"), _small_gp("difference")] if model is None else [model]
    ):
        at = case(each)
        _check_result(at)
        _check_without_covariance(at)
        _check_batch(at)
        _check_single_precision(at)
        if exact:
            _check_monte_carlo(at)
        if linear:
            _check_first_order_correlation(at)
        _check_derivatives(at)
    if linear:
        _check_linear(case(_linear_model()))


def _small_gp(predicts: Any) -> GPPosterior:
    """Two states, one input, 15 points."""
    generator = torch.Generator().manual_seed(0)
    features = 4 * torch.rand(15, 3, generator=generator, dtype=torch.float64) - 2
    targets = torch.stack(
        [
            torch.sin(features[:, 0] + features[:, 2]),
            features[:, 1].cos() * features[:, 0],
        ],
        dim=1,
    )
    ones = torch.ones(2, dtype=torch.float64)
    lengthscales = torch.tensor([[1.0, 1.5, 2.0], [1.4, 0.9, 3.0]], dtype=torch.float64)
    return GPPosterior.from_hyperparameters(
        features, targets, lengthscales, ones, 1e-2 * ones, 1, predicts
    )


def _linear_model() -> ResidualModel:
    """A model x+ = A x + B u + c that is known so well that a GP adds nothing.

    It is of a class that every method takes.
    """
    A = [[0.9, 0.3], [-0.2, 0.8]]
    B = [[0.0], [0.5]]
    c = [0.1, -0.2]
    nominal = Affine(*(torch.tensor(part, dtype=torch.float64) for part in (A, B, c)))
    zero = torch.zeros(1, 3, dtype=torch.float64)
    tiny = torch.full((2,), 1e-24, dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(
        zero, zero[:, :2], zero.expand(2, 3) + 1, tiny, tiny, 1, "value"
    )
    return ResidualModel(nominal, gp, torch.eye(2, dtype=torch.float64), [0, 1], [0], 1)


def _parts(result: Propagation) -> dict[str, Tensor]:
    return {
        "mean": result.belief.mean,
        "covariance": result.belief.covariance,
        "cross covariance": result.cross_covariance,
        "deficit": result.deficit,
    }


def _check_parts(
    promise: str,
    got: dict[str, Tensor],
    expected: dict[str, Tensor],
    tolerance: float,
    **at: Any,
) -> None:
    """Raises unless the parts that are expected are close."""
    for name, value in expected.items():
        require_close(promise, got[name], value, tolerance, f"the {name}", **at)


def _check_result(case: _Case) -> None:
    at = case.belief
    n = case.model.state_dim
    k = case.model.output_dim
    before = at.mean.clone(), at.covariance.clone(), case.input.clone()
    result = case()
    for name, old, new in zip(
        ("mean", "covariance", "input"),
        before,
        (at.mean, at.covariance, case.input),
        strict=True,
    ):
        require(
            torch.equal(old, new),
            f"the caller's {name} is left as it is",
            f"{old.tolist()} became {new.tolist()}",
        )
    shapes = {
        "mean": (k,),
        "covariance": (k, k),
        "cross covariance": (n, k),
        "deficit": (),
    }
    for name, value in _parts(result).items():
        right = tuple(value.shape) == shapes[name] and value.dtype == at.mean.dtype
        got = f"{tuple(value.shape)}"
        require(
            right,
            f"{name} has shape {shapes[name]} for one belief, and its type",
            f"got {got}, {value.dtype}",
        )
        require(
            bool(torch.isfinite(value).all()),
            f"{name} is finite",
            f"got {value.tolist()}",
        )
    require_covariance("propagate", result.belief.covariance)
    require(
        float(result.deficit) >= 0,
        "deficit is not negative",
        f"got {float(result.deficit)}",
    )
    off = result.belief.covariance - torch.diag(result.belief.variance)
    promise = "a diagonal method predicts no correlation"
    require(not (case.diagonal and bool(off.any())), promise, f"got {off.tolist()}")
    again = case().belief
    called = case.propagator(case.model, at, case.input)
    for promise, other in (
        ("the same belief gives the same result", again),
        ("calling it propagates", called),
    ):
        same = torch.equal(other.mean, result.belief.mean) and torch.equal(
            other.covariance, result.belief.covariance
        )
        require(same, promise, f"got {other} after {result.belief}")


def _check_without_covariance(case: _Case) -> None:
    at = case.belief
    plain = case.model.predict(case.belief.mean, case.input)
    expected = {"mean": plain.mean, "covariance": case.comparable(plain.covariance)}

    def result(scale: float) -> dict[str, Tensor]:
        return _parts(case(Gaussian(at.mean, scale * at.covariance)))

    certain = result(0.0)
    wide = result(1e-2)
    narrow = result(1e-6)
    _check_parts(
        "without covariance it is the plain prediction", certain, expected, 1e-8
    )
    zero = torch.zeros_like(certain["cross covariance"])
    require_close(
        "a certain state correlates with nothing",
        certain["cross covariance"],
        zero,
        1e-10,
    )
    rate = (
        5e-2 if case.samples else 1e-3
    )  # a draw's error falls as the root of the covariance's scale, and so slower
    for name, value in expected.items():
        far, near = (
            float((found[name] - value).abs().max()) for found in (wide, narrow)
        )
        promise = (
            f"the {name} approaches the plain prediction as the covariance vanishes"
        )
        text = (
            f"with the covariance times 1e-2 it is {far:.2e} away, "
            f"times 1e-6 still {near:.2e}"
        )
        require(near <= rate * far + 1e-9, promise, text)


def _check_batch(case: _Case) -> None:
    at = case.belief
    shifts = torch.linspace(-0.5, 0.5, 4, dtype=at.mean.dtype, device=at.mean.device)
    parts = (
        at.mean + shifts[:, None],
        at.covariance * (1 + shifts)[:, None, None],
        case.input + shifts[:, None],
    )
    alone = [
        _parts(case(Gaussian(mean, S), input))
        for mean, S, input in zip(*parts, strict=True)
    ]
    for batch in ((4,), (2, 2)):
        means, covariances, inputs = (part.unflatten(0, batch) for part in parts)
        for name, got in _parts(case(Gaussian(means, covariances), inputs)).items():
            expected = torch.stack([each[name] for each in alone]).unflatten(0, batch)
            floor = 1e-4
            promise = f"a batch is the loop over its members, here of shape {batch}"
            require_close(
                promise,
                got,
                expected,
                1e-9,
                f"the {name}",
                1.0 if name == "mean" else floor,
            )


def _check_single_precision(case: _Case) -> None:
    if not hasattr(case.model, "to"):
        return
    model = case.model.to(dtype=torch.float32)
    at = case.belief
    belief = Gaussian(at.mean.float(), at.covariance.float())
    single = _parts(case.propagator.propagate(model, belief, case.input.float()))
    for name, got in single.items():
        require(
            got.dtype == torch.float32,
            f"a float32 model and belief give a float32 {name}",
            f"got {got.dtype}",
        )
    _check_parts(
        "float32 agrees with float64 to two digits",
        single,
        _parts(case()),
        1e-2,
        floor=0.1,
    )


def _check_monte_carlo(case: _Case) -> None:
    """Compares claimed moments with the sample means that they stand for.

    The differences are in standard errors.
    """
    at = case.belief
    claimed = _parts(case())
    generator = torch.Generator().manual_seed(1)
    normal = torch.randn(_DRAWS, at.dim, generator=generator, dtype=torch.float64).to(
        at.mean
    )
    steps = normal @ square_root(at.covariance)
    moved = [
        case.model.predict(at.mean + part, case.input.expand(len(part), -1))
        for part in steps.split(10_000)
    ]
    means = torch.cat([each.mean for each in moved])
    centred = means - claimed["mean"]
    products = centred[:, :, None] * centred[:, None, :] + torch.cat(
        [each.covariance for each in moved]
    )
    drawn = {
        "mean": means,
        "covariance": case.comparable(products),
        "cross covariance": steps[:, :, None] * centred[:, None, :],
    }
    own = 1 + _DRAWS / case.samples if case.samples else 1.0
    for name, draws in drawn.items():
        error = (draws.std(0) ** 2 * own / _DRAWS).sqrt()
        off = (draws.mean(0) - claimed[name]).abs()
        worst = float((off / (error + 1e-9 * draws.abs().max() + 1e-300)).max())
        promise = f"an exact method's {name} agrees with {_DRAWS} draws of Monte Carlo"
        text = (
            f"it is {worst:.1f} standard errors away:\n"
            f"{claimed[name].tolist()} is off by {off.tolist()}"
        )
        require(worst < 5, promise, text)


def _check_first_order_correlation(case: _Case) -> None:
    at = case.belief
    scale = 1e-6
    x, u = (
        np.ascontiguousarray(part[None].double().cpu().numpy())
        for part in (at.mean, case.input)
    )
    A = torch.from_numpy(linearize(case.model, x, u, covariance=False).A[0]).to(at.mean)
    got = case(Gaussian(at.mean, scale * at.covariance)).cross_covariance / scale
    promise = "the cross covariance Cov[x, x+] is S A' to first order"
    floor = float(at.covariance.abs().max())
    require_close(
        promise, got, at.covariance @ A.mT, 1e-3 + case.sampling_error, floor=floor
    )


def _check_linear(case: _Case) -> None:
    try:
        result = case()
    except UnsupportedModel:
        return  # a method may take other models only
    S = case.belief.covariance
    A = case.model.nominal.A
    mean = case.model.nominal(case.belief.mean, case.input)
    covariance = case.comparable(A @ S @ A.mT)
    expected = {"mean": mean, "covariance": covariance, "cross covariance": S @ A.mT}
    _check_parts(
        "on a linear model it is exact",
        _parts(result),
        expected,
        1e-8 + case.sampling_error,
        floor=0.1,
    )


def _check_derivatives(case: _Case) -> None:
    """All six of ``differentiate``, each along two directions."""
    at = case.belief
    u = case.input
    moved, d = differentiate(case.propagator, case.model, at, u)
    require_close(
        "differentiate: the belief is propagate's",
        moved.belief.mean,
        case().belief.mean,
        1e-9,
        "the mean",
    )
    generator = torch.Generator().manual_seed(2)
    start = {"mean": at.mean, "covariance": at.covariance, "input": u}
    for by, value in 2 * list(start.items()):
        direction = torch.randn(
            value.shape, generator=generator, dtype=torch.float64
        ).to(at.mean)
        if by == "covariance":
            direction = (direction + direction.mT) / 2
        shifted = (start | {by: value + size * direction} for size in (_STEP, -_STEP))
        above, below = (
            _parts(case(Gaussian(s["mean"], s["covariance"]), s["input"]))
            for s in shifted
        )
        for of in ("mean", "covariance"):
            along = (getattr(d, f"{of}_by_{by}") * direction).sum(
                tuple(range(-direction.dim(), 0))
            )
            numeric = (above[of] - below[of]) / (2 * _STEP)
            require_close(
                f"differentiate: {of}_by_{by} agrees with finite differences",
                along,
                numeric,
                1e-5,
            )
