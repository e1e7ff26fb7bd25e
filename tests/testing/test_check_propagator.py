"""The check itself.

Our own propagators pass with every model, and each broken promise is found out and
named.
"""

from dataclasses import replace

import pytest
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MomentMatching,
    MonteCarlo,
    Propagation,
    Unscented,
)
from gpmpc.testing import check_propagator
from tests.testing.test_check_model import Honest, posterior, residual

OWN = {
    "mean equivalence": (MeanEquivalence, {}, {"linear": False}),
    "linearization": (Linearization, {}, {}),
    "moment matching": (MomentMatching, {}, {"exact": True}),
    "diagonal": (MomentMatching, {"diagonal": True}, {"exact": True, "diagonal": True}),
    "unscented": (Unscented, {}, {}),
    "Monte Carlo": (MonteCarlo, {"samples": 2000}, {"exact": True, "samples": 2000}),
}


@pytest.mark.parametrize("process_noise", [False, True])
@pytest.mark.parametrize(("kind", "settings", "claims"), OWN.values(), ids=OWN.keys())
def test_the_packages_own_propagators_pass(kind, settings, claims, process_noise):
    check_propagator(
        kind(**settings, process_noise=process_noise),
        **claims,
        process_noise=process_noise,
    )


@pytest.mark.parametrize(("kind", "settings", "claims"), OWN.values(), ids=OWN.keys())
@pytest.mark.parametrize(
    "make",
    [residual, lambda: posterior(n=3, m=0, predicts="difference")],
    ids=["residual", "autonomous"],
)
def test_they_pass_with_other_models(kind, settings, claims, make):
    check_propagator(kind(**settings), make(), **claims)


@pytest.mark.parametrize(
    "make",
    [Honest, lambda: residual(affine=False)],
    ids=["no GP", "nonlinear residual"],
)
@pytest.mark.parametrize(
    "name", ["mean equivalence", "linearization", "unscented", "Monte Carlo"]
)
def test_those_for_any_model_pass_with_code(name, make):
    kind, settings, claims = OWN[name]
    check_propagator(kind(**settings), make(), **claims)


class Broken:
    """Moment matching with one flaw."""

    def __init__(self, flaw):
        self.flaw = flaw

    def __call__(self, model, belief, input=None):
        return self.propagate(model, belief, input).belief

    def propagate(self, model, belief, input=None):
        return self.flaw(model, belief, input)


def exact(model, belief, input):
    return MomentMatching(process_noise=False).propagate(model, belief, input)


def with_belief(result, mean=None, covariance=None):
    mean = result.belief.mean if mean is None else mean
    covariance = result.belief.covariance if covariance is None else covariance
    return replace(result, belief=Gaussian(mean, covariance))


def five_per_cent_too_sure(model, belief, input):
    plain = model.predict(belief.mean, input).covariance
    result = exact(model, belief, input)
    return with_belief(
        result, covariance=plain + 0.95 * (result.belief.covariance - plain)
    )


def noise_that_nobody_asked_for(model, belief, input):
    result = exact(model, belief, input)
    return with_belief(
        result, covariance=result.belief.covariance + model.noise_covariance
    )


def standard_deviations_for_variances(model, belief, input):
    result = exact(model, belief, input)
    S = belief.covariance
    return with_belief(
        result,
        mean=result.belief.mean + 0.1 * (S.diagonal(dim1=-2, dim2=-1) + 1e-30).sqrt(),
    )


def one_covariance_for_the_batch(model, belief, input):
    S = belief.covariance.reshape(-1, *belief.covariance.shape[-2:])[0].expand(
        belief.covariance.shape
    )
    return exact(model, Gaussian(belief.mean, S), input)


def a_triangle(model, belief, input):
    result = exact(model, belief, input)
    return with_belief(result, covariance=result.belief.covariance.tril())


def scribbles(model, belief, input):
    result = exact(model, belief, input)
    belief.covariance.diagonal(dim1=-2, dim2=-1).add_(1e-9)
    return result


def dices(model, belief, input):
    result = exact(model, belief, input)
    return with_belief(result, mean=result.belief.mean + 1e-12 * torch.randn(2))


def double_precision_only(model, belief, input):
    result = exact(model, belief, input)
    return with_belief(
        result, result.belief.mean.double(), result.belief.covariance.double()
    )


def transposed_correlation(model, belief, input):
    result = exact(model, belief, input)
    return replace(result, cross_covariance=result.cross_covariance.mT)


def forgets_the_correlation(model, belief, input):
    result = exact(model, belief, input)
    return replace(result, cross_covariance=torch.zeros_like(result.cross_covariance))


def slightly_tilted(model, belief, input):
    result = Linearization(process_noise=False).propagate(model, belief, input)
    return with_belief(
        result,
        mean=result.belief.mean + 0.1 * belief.covariance.sum((-2, -1))[..., None],
    )


def indefinite(model, belief, input):
    result = exact(model, belief, input)
    return with_belief(
        result, covariance=result.belief.covariance - 0.2 * torch.eye(2).to(belief.mean)
    )


def squeezed(model, belief, input):
    result = exact(model, belief, input)
    return Propagation(
        result.belief, result.cross_covariance, result.deficit[..., None]
    )


@pytest.mark.parametrize(
    ("flaw", "claims", "message"),
    [
        (
            five_per_cent_too_sure,
            {"exact": True},
            "covariance agrees with .* Monte Carlo; it is .* standard errors away",
        ),
        (
            five_per_cent_too_sure,
            {},
            "on a linear model it is exact; the covariance is off by",
        ),
        (
            noise_that_nobody_asked_for,
            {},
            "without covariance it is the plain prediction; the covariance is off by",
        ),
        (
            standard_deviations_for_variances,
            {},
            "the mean approaches the plain prediction as the covariance vanishes",
        ),
        (
            one_covariance_for_the_batch,
            {},
            "a batch is the loop over its members, here of shape .*; the .* is off by",
        ),
        (a_triangle, {}, "the covariance is symmetric"),
        (indefinite, {}, "the covariance is positive semidefinite"),
        (scribbles, {}, "the caller's covariance is left as it is"),
        (dices, {}, "the same belief gives the same result"),
        (
            double_precision_only,
            {},
            "a float32 model and belief give a float32 mean; got torch.float64",
        ),
        (transposed_correlation, {}, "the cross covariance .* is S A' to first order"),
        (
            forgets_the_correlation,
            {"exact": True},
            "cross covariance agrees with .* Monte Carlo",
        ),
        (slightly_tilted, {"exact": True}, "mean agrees with .* Monte Carlo"),
        (slightly_tilted, {}, "on a linear model it is exact; the mean is off by"),
        (
            squeezed,
            {},
            r"deficit has shape \(\) for one belief, and its type; got \(1,\)",
        ),
    ],
)
def test_each_broken_promise_is_found_and_named(flaw, claims, message):
    with pytest.raises(AssertionError, match=message):
        check_propagator(Broken(flaw), **claims)


class WrongDerivative(MomentMatching):
    def differentiate(self, model, belief, input=None):
        propagation, sensitivity = super().differentiate(model, belief, input)
        wrong = 1.01 * sensitivity.covariance_by_covariance
        return propagation, replace(sensitivity, covariance_by_covariance=wrong)


def test_a_wrong_closed_form_of_a_derivative_is_found():
    with pytest.raises(
        AssertionError,
        match="covariance_by_covariance agrees with finite differences; it is off by",
    ):
        check_propagator(WrongDerivative())


def test_a_false_claim_of_exactness_is_found():
    for inexact in (Linearization(), MeanEquivalence()):
        with pytest.raises(
            AssertionError,
            match="an exact method's .* agrees with 100000 draws of Monte Carlo",
        ):
            check_propagator(inexact, exact=True)
    with pytest.raises(AssertionError, match="S A' to first order"):
        check_propagator(MeanEquivalence())
    with pytest.raises(
        AssertionError, match="a diagonal method predicts no correlation"
    ):
        check_propagator(MomentMatching(), diagonal=True)
