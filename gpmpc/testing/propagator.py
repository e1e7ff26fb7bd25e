"""Does a propagator keep its promises?

``check_propagator(propagator)`` moves beliefs through small models and compares: with the plain prediction where
nothing is uncertain, with the exact answer on a linear model, with Monte Carlo if the method claims to be exact, with
the loop over a batch, with single precision, and its derivatives with finite differences. It raises an
``AssertionError`` that names the broken promise and the numbers, and returns nothing if all is well.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian, square_root
from gpmpc.gp.posterior import GPPosterior
from gpmpc.models import Affine, ResidualModel
from gpmpc.propagation import Propagation, Propagator, differentiate, linearize
from gpmpc.testing.promise import require, require_close, require_covariance

DRAWS = 100_000  # of the Monte Carlo oracle
STEP = 1e-5  # of the finite differences, in units of the belief


@dataclass(frozen=True)
class _Case:
    """A propagator with what it claims, a model, and where it is asked."""

    propagator: Propagator
    model: Any
    belief: Gaussian
    input: Tensor
    diagonal: bool
    noise: Tensor
    samples: int | None

    def __call__(self, belief: Gaussian | None = None, input: Tensor | None = None) -> Propagation:
        belief, input = belief or self.belief, self.input if input is None else input
        return self.propagator.propagate(self.model, belief, input)

    def comparable(self, covariance: Tensor) -> Tensor:
        """What of an expected latent covariance the method claims to predict."""
        covariance = covariance + self.noise
        return torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1)) if self.diagonal else covariance


def check_propagator(
    propagator: Propagator,
    model: Any = None,
    exact: bool = False,
    *,
    linear: bool = True,
    diagonal: bool = False,
    process_noise: bool = False,
    samples: int | None = None,
    belief: Gaussian | None = None,
    input: Tensor | None = None,
) -> None:
    """Checks ``propagator`` against the protocol ``gpmpc.propagation.Propagator``.

    Args:
        propagator: The object to check.
        model: A model to check it with, in float64; small GPs of next states and of differences by default.
        exact: It claims the exact moments, and is held against Monte Carlo. Any method, exact or not, must approach
            the plain prediction in proportion to a vanishing covariance.
        linear: It claims to be exact where the model is linear, and first-order accurate in its input-output
            covariance. All methods of this package but mean equivalence do.
        diagonal: It claims the variances only, and predicts no correlation of the outputs.
        process_noise: It adds the model's noise covariance.
        samples: How many states it draws, if it does; its own standard error is then allowed for.
        belief: Where to ask (n,), with a positive definite covariance; by default near the default models' data.
        input: Likewise (m,).

    Raises:
        AssertionError: The propagator breaks a promise; the message says which.
    """
    models = [_small_gp("next_state"), _small_gp("difference")] if model is None else [model]
    for each in models:
        case = _case(propagator, each, belief, input, diagonal, process_noise, samples)
        _check_result(case)
        _check_without_covariance(case)
        _check_batch(case)
        _check_single_precision(case)
        if exact:
            _check_monte_carlo(case)
        if linear:
            _check_first_order_correlation(case)
        _check_derivatives(case)
        _check_local_model(case)
    if linear:
        _check_linear(_case(propagator, _linear_model(), None, None, diagonal, process_noise, samples))


def _case(propagator, model, belief, input, diagonal, process_noise, samples) -> _Case:
    n, m = model.state_dim, model.input_dim
    like = {"dtype": model.dtype, "device": model.device}
    if belief is None:
        root = 0.2 * torch.eye(n, **like) + 0.05 * torch.ones(n, n, **like).tril(-1)
        belief = Gaussian(torch.linspace(0.3, -0.4, n, **like), root @ root.mT)
    input = torch.full((m,), 0.2, **like) if input is None else input
    noise = model.noise_covariance if process_noise else torch.zeros_like(model.noise_covariance)
    return _Case(propagator, model, belief, input, diagonal, noise, samples)


def _small_gp(predicts: str) -> GPPosterior:
    """Two states, one input, 15 points."""
    generator = torch.Generator().manual_seed(0)
    features = 4 * torch.rand(15, 3, generator=generator, dtype=torch.float64) - 2
    targets = torch.stack([torch.sin(features[:, 0] + features[:, 2]), features[:, 1].cos() * features[:, 0]], dim=1)
    ones = torch.ones(2, dtype=torch.float64)
    lengthscales = torch.tensor([[1.0, 1.5, 2.0], [1.4, 0.9, 3.0]], dtype=torch.float64)
    return GPPosterior.from_hyperparameters(features, targets, lengthscales, ones, 1e-2 * ones, 1, predicts)


def _linear_model() -> ResidualModel:
    """x+ = A x + B u + c, learned so well that nothing is left to a GP, in a class that every method takes."""
    A, B, c = [[0.9, 0.3], [-0.2, 0.8]], [[0.0], [0.5]], [0.1, -0.2]
    nominal = Affine(*(torch.tensor(part, dtype=torch.float64) for part in (A, B, c)))
    zero, tiny = torch.zeros(1, 3, dtype=torch.float64), torch.full((2,), 1e-24, dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(zero, zero[:, :2], zero.expand(2, 3) + 1, tiny, tiny, 1, "value")
    return ResidualModel(nominal, gp, torch.eye(2, dtype=torch.float64), [0, 1], [0], 1)


def _check_result(case: _Case) -> None:
    at, n, k = case.belief, case.model.state_dim, case.model.output_dim
    before = at.mean.clone(), at.covariance.clone(), case.input.clone()
    result = case()
    after = at.mean, at.covariance, case.input
    for name, old, new in zip(("mean", "covariance", "input"), before, after, strict=True):
        require(torch.equal(old, new), f"the caller's {name} is left as it is", f"{old.tolist()} became {new.tolist()}")
    parts = {
        "belief.mean": (result.belief.mean, (k,)),
        "belief.covariance": (result.belief.covariance, (k, k)),
        "cross_covariance": (result.cross_covariance, (n, k)),
        "deficit": (result.deficit, ()),
    }
    for name, (value, shape) in parts.items():
        got = tuple(value.shape)
        require(got == shape, f"{name} has shape {shape} for one belief", f"got {got}")
        require(value.dtype == at.mean.dtype, f"{name} has the belief's type, {at.mean.dtype}", f"got {value.dtype}")
        require(bool(torch.isfinite(value).all()), f"{name} is finite", f"got {value.tolist()}")
    require_covariance("propagate", result.belief.covariance)
    require(float(result.deficit) >= 0, "deficit is not negative", f"got {float(result.deficit)}")
    if case.diagonal:
        off = result.belief.covariance - torch.diag(result.belief.variance)
        require(not bool(off.any()), "a diagonal method predicts no correlation", f"got {off.tolist()}")
    again, called = case(), case.propagator(case.model, at, case.input)
    for name, other in (("the same belief gives the same answer", again.belief), ("calling it propagates", called)):
        same = torch.equal(other.mean, result.belief.mean)
        same &= torch.equal(other.covariance, result.belief.covariance)
        require(same, name, f"got {other} after {result.belief}")


def _check_without_covariance(case: _Case) -> None:
    at, plain = case.belief, case.model.predict(case.belief.mean, case.input)
    expected = case.comparable(plain.covariance)
    certain = case(Gaussian(at.mean, torch.zeros_like(at.covariance)))
    promise = "without covariance it is the plain prediction"
    require_close(promise, certain.belief.mean, plain.mean, 1e-8, "the mean")
    require_close(promise, certain.belief.covariance, expected, 1e-8, "the covariance")
    zero = torch.zeros_like(certain.cross_covariance)
    require_close(
        "a certain state correlates with nothing", certain.cross_covariance, zero, 1e-10, "the cross covariance"
    )

    def gap(scale: float) -> Tensor:
        belief = case(Gaussian(at.mean, scale * at.covariance)).belief
        return torch.stack([(belief.mean - plain.mean).abs().max(), (belief.covariance - expected).abs().max()])

    # A draw's error falls as the root of the covariance's scale, and so slower.
    (wide, narrow), rate = (gap(1e-2), gap(1e-6)), 5e-2 if case.samples else 1e-3
    for name, before, after in zip(("mean", "covariance"), wide.tolist(), narrow.tolist(), strict=True):
        require(
            after <= rate * before + 1e-9,
            f"the {name} approaches the plain prediction as the covariance vanishes",
            f"with the covariance times 1e-2 it is {before:.2e} away, times 1e-6 still {after:.2e}",
        )


def _check_batch(case: _Case) -> None:
    at = case.belief
    shifts = torch.linspace(-0.5, 0.5, 4, dtype=at.mean.dtype, device=at.mean.device)
    means, controls = at.mean + shifts[:, None], case.input + shifts[:, None]
    covariances = at.covariance * (1 + shifts)[:, None, None]
    together = case(Gaussian(means, covariances), controls)
    nested = case(Gaussian(means.unflatten(0, (2, 2)), covariances.unflatten(0, (2, 2))), controls.unflatten(0, (2, 2)))
    for j in range(len(shifts)):
        alone = case(Gaussian(means[j], covariances[j]), controls[j])
        for name, take in _PARTS.items():
            what, floor = f"the {name} of member {j}", 1.0 if name == "mean" else 1e-4
            for promise, got in (
                ("a batch is the loop over its members", take(together)[j]),
                ("two batch dimensions are the loop over their members", take(nested)[j // 2, j % 2]),
            ):
                require_close(promise, got, take(alone), 1e-9, what, floor)


def _check_single_precision(case: _Case) -> None:
    if not hasattr(case.model, "to"):
        return
    at = case.belief
    model, belief = case.model.to(dtype=torch.float32), Gaussian(at.mean.float(), at.covariance.float())
    single, double = case.propagator.propagate(model, belief, case.input.float()), case()
    for name, take in _PARTS.items():
        got = take(single)
        require(got.dtype == torch.float32, f"a float32 model and belief give a float32 {name}", f"got {got.dtype}")
        require_close("float32 agrees with float64 to two digits", got, take(double), 1e-2, f"the {name}", floor=0.1)


def _check_monte_carlo(case: _Case) -> None:
    """The claimed moments against the sample means that they are, in standard errors."""
    at, result = case.belief, case()
    generator = torch.Generator().manual_seed(1)
    normal = torch.randn(DRAWS, at.dim, generator=generator, dtype=torch.float64).to(at.mean)
    steps = normal @ square_root(at.covariance)
    moved = [case.model.predict(at.mean + part, case.input.expand(len(part), -1)) for part in steps.split(10_000)]
    centred = torch.cat([each.mean for each in moved]) - result.belief.mean
    products = centred[:, :, None] * centred[:, None, :] + torch.cat([each.covariance for each in moved])
    claimed = {
        "mean": (torch.zeros_like(result.belief.mean), centred),
        "covariance": (result.belief.covariance, case.comparable(products)),
        "cross covariance": (result.cross_covariance, steps[:, :, None] * centred[:, None, :]),
    }
    own = 1 + DRAWS / case.samples if case.samples else 1.0
    for name, (claim, draws) in claimed.items():
        error = (draws.std(0) ** 2 * own / DRAWS).sqrt()
        off = (draws.mean(0) - claim).abs()
        worst = float((off / (error + 1e-9 * draws.abs().max() + 1e-300)).max())
        require(
            worst < 5,
            f"an exact method's {name} agrees with {DRAWS} draws of Monte Carlo",
            f"it is {worst:.1f} standard errors away:\ngot  {claim.tolist()}\noff by {off.tolist()}",
        )


def _check_first_order_correlation(case: _Case) -> None:
    at, scale = case.belief, 1e-6
    _, A, _ = case.model.predict_with_jacobian(at.mean, case.input)
    got = case(Gaussian(at.mean, scale * at.covariance)).cross_covariance / scale
    tolerance = 1e-3 + (10 * case.samples**-0.5 if case.samples else 0)
    promise = "the cross covariance Cov[x, x+] is S A' to first order"
    require_close(promise, got, at.covariance @ A.mT, tolerance, floor=float(at.covariance.abs().max()))


def _check_linear(case: _Case) -> None:
    try:
        result = case()
    except UnsupportedModel:
        return  # a method may take other models only
    S, A = case.belief.covariance, case.model.nominal.A
    tolerance = 1e-8 + (10 * case.samples**-0.5 if case.samples else 0)
    expected = {
        "mean": (result.belief.mean, case.model.nominal(case.belief.mean, case.input)),
        "covariance": (result.belief.covariance, case.comparable(A @ S @ A.mT)),
        "cross covariance": (result.cross_covariance, S @ A.mT),
    }
    for name, (got, value) in expected.items():
        require_close("on a linear model it is exact", got, value, tolerance, f"the {name}", floor=0.1)


def _check_derivatives(case: _Case) -> None:
    """All six of ``differentiate``, along each unit change."""
    at, u = case.belief, case.input
    moved, d = differentiate(case.propagator, case.model, at, u)
    require_close("differentiate: the belief is propagate's", moved.belief.mean, case().belief.mean, 1e-9, "the mean")
    n, like = at.dim, {"dtype": at.mean.dtype, "device": at.mean.device}
    eye = torch.eye(n, **like)
    still, flat = torch.zeros(n, **like), torch.zeros(n, n, **like)
    changes = [("mean", i, (eye[i], flat, torch.zeros_like(u))) for i in range(n)]
    changes += [("input", j, (still, flat, torch.eye(len(u), **like)[j])) for j in range(len(u))]
    pairs = [(i, j) for i in range(n) for j in range(i + 1)]
    changes += [("covariance", ij, (still, (E := torch.outer(eye[ij[0]], eye[ij[1]])) + E.mT, 0 * u)) for ij in pairs]
    for by, which, (dm, dS, du) in changes:
        forward, back = (
            case(Gaussian(at.mean + t * dm, at.covariance + t * dS), u + t * du).belief for t in (STEP, -STEP)
        )
        for of, got in (("mean", getattr(d, f"mean_by_{by}")), ("covariance", getattr(d, f"covariance_by_{by}"))):
            given = (got * dS).sum((-2, -1)) if by == "covariance" else got[..., which]
            numeric = (getattr(forward, of) - getattr(back, of)) / (2 * STEP)
            promise = f"differentiate: {of}_by_{by} agrees with finite differences"
            require_close(promise, given, numeric, 1e-5, f"that by entry {which}")


def _check_local_model(case: _Case) -> None:
    """A, B and c of s+ = A s + B u + c, s = [mu; vec(Sigma^1/2)], along a change of everything."""
    if case.model.output_dim != case.model.state_dim:
        return
    at, u, n = case.belief, case.input, case.model.state_dim

    def extended(belief: Gaussian) -> Tensor:
        return torch.cat([belief.mean, square_root(belief.covariance).flatten(-2)], dim=-1)

    def following(s: Tensor, control: Tensor) -> Tensor:
        root = s[n:].unflatten(0, (n, n))
        return extended(case(Gaussian(s[:n], root @ root.mT), control).belief)

    local, s = linearize(case.propagator, case.model, at, u), extended(at)
    promise = "linearize: A s + B u + c is the next extended state"
    require_close(promise, local(s, u), following(s, u), 1e-7)
    generator = torch.Generator().manual_seed(2)
    root = torch.randn(n, n, generator=generator, dtype=torch.float64)
    ds = torch.cat([torch.randn(n, generator=generator, dtype=torch.float64), (root + root.mT).flatten()]).to(s)
    du = torch.ones_like(u)
    numeric = (following(s + STEP * ds, u + STEP * du) - following(s - STEP * ds, u - STEP * du)) / (2 * STEP)
    promise = "linearize: A and B agree with finite differences of the next extended state"
    require_close(promise, local.A @ ds + local.B @ du, numeric, 1e-4)


_PARTS = {
    "mean": lambda result: result.belief.mean,
    "covariance": lambda result: result.belief.covariance,
    "cross covariance": lambda result: result.cross_covariance,
    "deficit": lambda result: result.deficit,
}
