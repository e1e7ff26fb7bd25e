"""What the five propagators promise, each where its answer is known, and what they say
to bad input."""

import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian, square_root
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, KnownModel, ResidualModel
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MomentMatching,
    MonteCarlo,
    Unscented,
    differentiate,
    linearize,
)

DETERMINISTIC = {
    "mean equivalence": MeanEquivalence,
    "linearization": Linearization,
    "moment matching": MomentMatching,
    "unscented": Unscented,
    "sigma points": lambda **settings: Unscented(
        alpha=0.5, beta=2.0, kappa=1.0, **settings
    ),
}
ALL = DETERMINISTIC | {
    "Monte Carlo": lambda **settings: MonteCarlo(samples=400, **settings)
}


def gp(n=2, m=1, predicts="next_state", outputs=None, noise=1e-2):
    """A smooth posterior; ``outputs`` other than n for a function's value."""
    generator = torch.Generator().manual_seed(0)
    k = outputs or n
    features = 3 * torch.rand(25, n + m, generator=generator) - 1.5
    targets = torch.stack(
        [
            torch.sin(features.sum(1) + a) + 0.3 * features[:, a % n] ** 2
            for a in range(k)
        ],
        dim=1,
    )
    lengthscales = 1.0 + torch.rand(k, n + m, generator=generator)
    return GPPosterior.from_hyperparameters(
        features,
        targets,
        lengthscales,
        torch.full((k,), 1.5),
        torch.full((k,), noise),
        m,
        predicts,
    )


def linear(noise=0.04):
    """x+ = A x + B u + c + d, d of a prior that no data have told anything: variance Q
    near 0, noise sn2."""
    A = torch.tensor([[0.9, 0.4], [-0.3, 0.8]])
    B = torch.tensor([[0.2], [0.7]])
    c = torch.tensor([0.5, -1.0])
    far = torch.full((1, 3), 1e6)  # so far off that the prior is all there is
    d = GPPosterior.from_hyperparameters(
        far,
        torch.zeros(1, 2),
        torch.ones(2, 3),
        torch.tensor([0.03, 0.05]),
        torch.full((2,), noise),
        1,
        "value",
    )
    return ResidualModel(Affine(A, B, c), d, torch.eye(2), [0, 1], [0], 1)


def belief(n=2, scale=1.0):
    root = 0.3 * torch.eye(n) + 0.1 * torch.ones(n, n).tril(-1)
    return Gaussian(torch.linspace(0.4, -0.3, n), scale * root @ root.T)


@pytest.mark.parametrize(
    "name", [name for name in DETERMINISTIC if name != "mean equivalence"]
)
@pytest.mark.parametrize("process_noise", [False, True])
def test_a_linear_gaussian_system_is_propagated_exactly(name, process_noise):
    model = linear()
    at = belief()
    u = torch.tensor([0.7])
    A = model.nominal.A
    B = model.nominal.B
    c = model.nominal.c
    Q = torch.diag(torch.tensor([0.03, 0.05])) + process_noise * 0.04 * torch.eye(2)
    result = DETERMINISTIC[name](process_noise=process_noise).propagate(model, at, u)
    assert torch.allclose(result.belief.mean, A @ at.mean + B @ u + c, atol=1e-12)
    assert torch.allclose(
        result.belief.covariance, A @ at.covariance @ A.T + Q, atol=1e-12
    )
    assert torch.allclose(result.cross_covariance, at.covariance @ A.T, atol=1e-12)
    assert float(result.deficit) == 0


def test_mean_equivalence_forgets_only_the_state_covariance():
    model = linear()
    at = belief()
    u = torch.tensor([0.7])
    result = MeanEquivalence(process_noise=False).propagate(model, at, u)
    assert torch.allclose(result.belief.mean, model.nominal(at.mean, u), atol=1e-12)
    assert torch.allclose(
        result.belief.covariance, torch.diag(torch.tensor([0.03, 0.05])), atol=1e-12
    )
    assert not result.cross_covariance.any()


def test_monte_carlo_is_exact_up_to_its_standard_error():
    model = linear()
    at = belief()
    u = torch.tensor([0.7])
    samples = 100_000
    A = model.nominal.A
    result = MonteCarlo(samples, 3, process_noise=False).propagate(model, at, u)
    spread = A @ at.covariance @ A.T
    assert torch.all(
        (result.belief.mean - model.nominal(at.mean, u)).abs()
        < 4.5 * (spread.diagonal() / samples).sqrt()
    )
    expected = spread + torch.diag(torch.tensor([0.03, 0.05]))
    # Var of a sample covariance of Gaussians: (S_ab^2 + S_aa S_bb) / N.
    error = (
        (spread**2 + torch.outer(spread.diagonal(), spread.diagonal())) / samples
    ).sqrt()
    assert torch.all((result.belief.covariance - expected).abs() < 4.5 * error)
    error = (
        (at.covariance @ A.T) ** 2 + torch.outer(at.variance, spread.diagonal())
    ) / samples
    assert torch.all(
        (result.cross_covariance - at.covariance @ A.T).abs() < 4.5 * error.sqrt()
    )


def test_monte_carlo_depends_on_its_seed_alone():
    model = gp()
    at = belief()
    u = torch.zeros(1)
    first, again, other = (
        MonteCarlo(500, seed=seed)(model, at, u).mean for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_the_order_of_accuracy_on_a_nonlinear_model_is_as_stated():
    model = gp()
    u = torch.tensor([0.2])

    def errors(propagator, scale):
        at = belief(scale=scale)
        exact = MomentMatching()(model, at, u)
        ours = propagator(model, at, u)
        return torch.stack(
            [
                (ours.mean - exact.mean).abs().max(),
                (ours.covariance - exact.covariance).abs().max(),
            ]
        )

    # Error of the mean (scale^p): first order misses 1/2 tr(H S), sigma points do not.
    for propagator, power in (
        (MeanEquivalence(), 1),
        (Linearization(), 1),
        (Unscented(), 2),
    ):
        rate = errors(propagator, 1e-2) / errors(propagator, 1e-3)
        assert float(rate[0].log10()) == pytest.approx(power, abs=0.15)
    # Error of the covariance: Unscented sees the curvature of the model's variance,
    # linearization does not.
    rate = errors(Unscented(), 1e-2) / errors(Unscented(), 1e-3)
    assert float(rate[1].log10()) == pytest.approx(2, abs=0.15)
    assert float(
        (errors(Linearization(), 1e-2) / errors(Linearization(), 1e-3))[1].log10()
    ) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("predicts", ["next_state", "difference"])
def test_an_autonomous_model_takes_no_input_or_one_of_no_columns(name, predicts):
    model = gp(m=0, predicts=predicts)
    at = belief()
    without = ALL[name]()(model, at)
    empty = ALL[name]()(model, at, torch.zeros(0))
    assert torch.equal(without.mean, empty.mean)
    assert torch.equal(without.covariance, empty.covariance)
    batch = Gaussian(at.mean.expand(3, 2), at.covariance.expand(3, 2, 2))
    assert torch.allclose(
        ALL[name]()(model, batch).mean, without.mean.expand(3, 2), atol=1e-12
    )


@pytest.mark.parametrize("name", ALL)
def test_observation_noise_is_added_unless_it_is_refused(name):
    model = gp(noise=0.02)
    at = belief()
    u = torch.tensor([0.3])
    latent = ALL[name](process_noise=False).propagate(model, at, u)
    noisy = ALL[name]().propagate(model, at, u)
    assert torch.equal(latent.belief.mean, noisy.belief.mean)
    assert torch.equal(latent.cross_covariance, noisy.cross_covariance)
    assert torch.allclose(
        noisy.belief.covariance - latent.belief.covariance,
        0.02 * torch.eye(2),
        atol=1e-13,
    )


@pytest.mark.parametrize("name", ALL)
def test_noise_of_a_residual_model_acts_where_the_residual_does(name):
    d = gp(n=1, m=1, predicts="value")
    nominal = Affine(torch.eye(2), torch.ones(2, 1), torch.zeros(2))
    model = ResidualModel(nominal, d, torch.tensor([[0.5], [2.0]]), [1], [0], 1)
    latent, noisy = (
        ALL[name](process_noise=noise)(model, belief(), torch.zeros(1))
        for noise in (False, True)
    )
    B = torch.tensor([[0.5], [2.0]])
    assert torch.allclose(
        noisy.covariance - latent.covariance, 0.01 * B @ B.T, atol=1e-12
    )


@pytest.mark.parametrize("name", [name for name in ALL if name != "moment matching"])
def test_a_function_of_more_outputs_than_states_is_propagated(name):
    model = gp(predicts="value", outputs=3)
    at = belief()
    u = torch.tensor([0.1])
    result = ALL[name]().propagate(model, at, u)
    exact = MomentMatching().propagate(model, at, u)
    assert result.belief.mean.shape == (3,)
    assert result.cross_covariance.shape == (2, 3)
    assert torch.allclose(result.belief.mean, exact.belief.mean, atol=0.15)


def test_moment_matching_names_who_can_do_what_it_cannot():
    model = linear()
    other = ResidualModel(lambda x, u: x.sin(), model.residual, model.B, [0, 1], [0], 1)
    message = (
        "MomentMatching needs a GPPosterior, or a ResidualModel of an Affine nominal "
        "model and one; got ResidualModel. "
        "Possible with any model: MeanEquivalence, Linearization, Unscented, MonteCarlo"
    )
    with pytest.raises(UnsupportedModel) as caught:
        MomentMatching()(other, belief(), torch.zeros(1))
    assert str(caught.value) == message
    for name in ("mean equivalence", "linearization", "unscented", "Monte Carlo"):
        assert torch.isfinite(
            ALL[name]()(other, belief(), torch.zeros(1)).covariance
        ).all()


@pytest.mark.parametrize("name", ALL)
class TestBadInput:
    """Every propagator holds belief and input against the same rules."""

    def refused(self, name, error, message, at=None, u=None, model=None):
        with pytest.raises(error, match=message):
            ALL[name]()(
                model or gp(), at or belief(), torch.zeros(1) if u is None else u
            )

    def test_another_number_of_states_or_inputs(self, name):
        self.refused(name, ShapeError, r"got \(3,\) and \(1,\)", at=belief(3))
        self.refused(name, ShapeError, r"got \(2,\) and \(2,\)", u=torch.zeros(2))
        with pytest.raises(ShapeError, match=r"got \(2,\) and \(0,\)"):
            ALL[name]()(gp(), belief())

    def test_a_covariance_of_another_shape(self, name):
        with pytest.raises(ShapeError, match=r"got \(2,\) and \(2,\)"):
            ALL[name]()(gp(), Gaussian(torch.zeros(2), torch.ones(2)), torch.zeros(1))

    @pytest.mark.parametrize("value", [torch.nan, torch.inf])
    def test_entries_that_are_not_finite(self, name, value):
        at = belief()
        bad = torch.tensor([0.1, value])
        self.refused(
            name,
            DataError,
            "the belief's mean must be finite; got",
            at=Gaussian(bad, at.covariance),
        )
        self.refused(
            name,
            DataError,
            "the belief's covariance must be finite; got",
            at=Gaussian(at.mean, torch.diag(bad)),
        )
        self.refused(name, DataError, "the input must be finite; got", u=bad[1:])

    def test_an_indefinite_covariance_by_how_much(self, name):
        at = Gaussian(torch.zeros(2), torch.tensor([[1.0, 1.5], [1.5, 1.0]]))
        message = (
            r"must be positive semidefinite; "
            r"got an eigenvalue of -0\.5 \(largest entry 1\.5\)"
        )
        self.refused(name, DataError, message, at=at)
        batch = Gaussian(torch.zeros(2, 2), torch.stack([torch.eye(2), at.covariance]))
        self.refused(name, DataError, message, at=batch, u=torch.zeros(2, 1))

    def test_singular_covariances_and_negative_round_off_are_taken(self, name):
        for S in (torch.ones(2, 2), torch.diag(torch.tensor([1.0, -1e-15]))):
            next_belief = ALL[name]()(
                gp(), Gaussian(torch.zeros(2), 0.1 * S), torch.zeros(1)
            )
            assert torch.isfinite(next_belief.covariance).all()

    def test_a_belief_in_another_precision_than_the_model(self, name):
        at = belief()
        single = Gaussian(at.mean.float(), at.covariance.float())
        message = (
            "state: must be torch.float64 on cpu like the model; "
            "got torch.float32 on cpu"
        )
        self.refused(name, SettingError, message, at=single)
        self.refused(
            name,
            SettingError,
            "input: must be torch.float64",
            u=torch.zeros(1, dtype=torch.float32),
        )
        mixed = Gaussian(at.mean, at.covariance.float())
        self.refused(
            name,
            SettingError,
            "belief: mean and covariance must have the same dtype and device",
            at=mixed,
        )
        next_belief = ALL[name]()(
            gp().to(dtype=torch.float32), single, torch.zeros(1, dtype=torch.float32)
        )
        assert next_belief.covariance.dtype == torch.float32


def test_settings_out_of_range_are_refused():
    for make, message in (
        (
            lambda: Unscented(alpha=0.0),
            "alpha: must be a number, 1e-07 or more; got 0.0",
        ),
        (lambda: Unscented(beta=torch.nan), "beta: must be a number; got nan"),
        (
            lambda: MomentMatching(diagonal="false"),
            "diagonal: must be true or false; got 'false'",
        ),
        (
            lambda: MonteCarlo(samples=1),
            "samples: must be a whole number, 2 or more; got 1",
        ),
        (
            lambda: MonteCarlo(seed=0.5),
            "seed: must be a whole number, 0 or more; got 0.5",
        ),
        (
            lambda: Unscented(kappa=-2.0)(gp(), belief(), torch.zeros(1)),
            r"n \+ kappa must be positive; got 2 states",
        ),
        (
            lambda: Unscented(kappa=-2.0 + 1e-15)(gp(), belief(), torch.zeros(1)),
            r"alpha\^2 \(n \+ kappa\) must be 1e-14 or more; got 1.11e-15 of 2 states",
        ),
    ):
        with pytest.raises(SettingError, match=message):
            make()


@pytest.mark.parametrize("samples", [3, 2500])  # 2500 are predicted in three parts
def test_monte_carlo_gives_the_sample_moments_of_its_draws(samples):
    model = gp()
    at = belief()
    u = torch.tensor([0.3])
    propagation = MonteCarlo(samples, 4, process_noise=False).propagate(model, at, u)
    steps = torch.from_numpy(
        np.random.default_rng(4).standard_normal((samples, 2))
    ) @ square_root(at.covariance)
    predictions = model.predict(at.mean + steps, u.expand(samples, 1))
    both = torch.cov(torch.cat([steps, predictions.mean], dim=1).mT)
    assert torch.allclose(propagation.belief.mean, predictions.mean.mean(0), rtol=1e-12)
    assert torch.allclose(
        propagation.belief.covariance,
        both[2:, 2:] + predictions.covariance.mean(0),
        rtol=1e-10,
        atol=1e-14,
    )
    assert torch.allclose(
        propagation.cross_covariance, both[:2, 2:], rtol=1e-10, atol=1e-14
    )


def silent_heading(n):
    """Nothing moves, and the GP of the first state's sine and cosine adds nothing."""
    silent = GPPosterior.from_hyperparameters(
        torch.full((1, 2), 1e6),
        torch.zeros(1, 1),
        lengthscales=torch.ones(1, 2),
        signal_variance=torch.full((1,), 1e-12),
        noise_variance=torch.full((1,), 1e-12),
        input_dim=0,
        predicts="value",
    )
    B = torch.eye(n)[:, -1:]
    return ResidualModel(Affine.identity(n, 0), silent, B, [0], [], 0, angles=[0])


class WrappedHeading(KnownModel):
    """A user's model whose first state turns by 1 rad and is shown within a turn."""

    angles = (0,)

    def __init__(self, n):
        def step(x, u):
            turned = torch.remainder(x[..., :1] + 1.0, 2 * torch.pi)
            return torch.cat([turned, x[..., 1:]], dim=-1)

        super().__init__(step, state_dim=n, input_dim=0)


class TurningHeading(KnownModel):
    """A user's model whose first state counts turns, by more than a half each step."""

    angles = (0,)

    def __init__(self, n):
        def step(x, u):
            return torch.cat([x[..., :1] + 1.5 * x[..., 1:2], x[..., 1:]], dim=-1)

        super().__init__(step, state_dim=n, input_dim=0)


class KickedHeading(KnownModel):
    """A user's model that adds to a heading which it has wrapped before."""

    angles = (0,)

    def __init__(self, n):
        def step(x, u):
            heading = torch.remainder(x[..., :1] + torch.pi, 2 * torch.pi) - torch.pi
            return torch.cat([heading + 0.1 * x[..., 1:2], x[..., 1:]], dim=-1)

        super().__init__(step, state_dim=n, input_dim=0)


@pytest.mark.parametrize(
    "make", [silent_heading, WrappedHeading, TurningHeading, KickedHeading]
)
@pytest.mark.parametrize("n", [2, 6])
def test_a_wide_belief_over_an_angle_stays_as_wide(n, make):
    """Points beyond half a turn from the first were folded to the other side."""
    model = make(n)
    at = Gaussian(torch.linspace(0.5, 1.0, n), 2.2**2 * torch.eye(n))
    exact = Linearization().propagate(model, at)
    sampling_error = 0.25 * float(exact.belief.variance.max())
    propagators = [(Unscented(), 1e-9)]
    propagators += [(MonteCarlo(300, seed=seed), sampling_error) for seed in range(3)]
    for propagator, loose in propagators:
        propagation = propagator.propagate(model, at)
        assert torch.allclose(
            propagation.belief.covariance, exact.belief.covariance, atol=loose
        )
        assert torch.allclose(
            propagation.cross_covariance, exact.cross_covariance, atol=loose
        )
        mean = propagation.belief.mean
        assert torch.allclose(mean, exact.belief.mean, atol=loose / 2)


def test_a_wide_state_hides_no_negative_variance_of_another():
    """A place in metres, and an angle."""
    message = r"an eigenvalue of -0\.01 \(largest entry 1e\+06\)"
    broken = torch.diag(torch.tensor([1e6, -1e-2]))
    with pytest.raises(DataError, match=message):
        MeanEquivalence()(gp(), Gaussian(torch.zeros(2), broken), torch.zeros(1))
    crooked = torch.diag(torch.tensor([1e6, 1e-6, 1e-6]))
    crooked[1, 2] = 1e-6
    with pytest.raises(DataError, match="must be symmetric; .* differ by 1e-06"):
        MeanEquivalence()(gp(3), Gaussian(torch.zeros(3), crooked), torch.zeros(1))
    rounded = torch.diag(torch.tensor([1e6, -1e-8]))
    MeanEquivalence()(gp(), Gaussian(torch.zeros(2), rounded), torch.zeros(1))


def test_a_batch_takes_no_more_samples_at_once_than_one_belief():
    class Counting(KnownModel):
        most = 0

        def predict(self, state, input):
            Counting.most = max(Counting.most, state[..., 0].numel())
            return super().predict(state, input)

    model = Counting(lambda x, u: torch.sin(x) + u, 2, 2)
    spread = 0.1 * torch.eye(2).expand(50, 2, 2)
    batch = Gaussian(torch.randn(50, 2), spread)
    propagator = MonteCarlo(samples=400)
    after = propagator(model, batch, torch.zeros(50, 2))
    assert Counting.most <= 1000
    alone = propagator(model, Gaussian(batch.mean[7], spread[7]), torch.zeros(2))
    assert torch.allclose(after.mean[7], alone.mean)
    assert torch.allclose(after.covariance[7], alone.covariance)


def test_a_wide_stage_of_a_plan_hides_no_broken_one():
    eye = torch.eye(2)
    batch = Gaussian(torch.zeros(3, 2), torch.stack([0 * eye, 1e8 * eye, -0.1 * eye]))
    message = r"an eigenvalue of -0\.1 \(largest entry 0\.1\)"
    with pytest.raises(DataError, match=message):
        MeanEquivalence()(gp(), batch, torch.zeros(1))
    crooked = torch.tensor([[1.0, 0.1], [0.0, 1.0]])
    batch = Gaussian(torch.zeros(2, 2), torch.stack([1e8 * eye, crooked]))
    with pytest.raises(DataError, match="must be symmetric; .* differ by 0.1"):
        MeanEquivalence()(gp(), batch, torch.zeros(1))


def test_what_is_no_model_propagator_or_input_is_named():
    u = torch.zeros(1)
    for call, message in (
        (lambda: linearize(Linearization(), gp(), belief(), np.zeros(1)), "input"),
        (lambda: linearize(None, gp(), belief(), u), "propagator"),
        (lambda: linearize(Linearization(), None, belief(), u), "model"),
        (lambda: differentiate(None, gp(), belief(), u), "propagator"),
        (lambda: differentiate(Unscented(), None, belief(), u), "model"),
        (lambda: Unscented()(None, belief(), u), "model"),
        (lambda: Unscented()(gp(), torch.zeros(2), u), "belief"),
    ):
        with pytest.raises(SettingError, match=f"^{message}: must be "):
            call()


def test_results_are_compared_without_an_error():
    one = Linearization().propagate(gp(), belief(), torch.zeros(1))
    other = Linearization().propagate(gp(), belief(), torch.zeros(1))
    assert one == one
    assert one != other
