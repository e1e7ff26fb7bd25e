from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import Diverged, SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import KnownModel
from gpmpc.mpc import Decision, Reference, Timing
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.simulation import (
    Dropout,
    Gust,
    ModelLoop,
    Noise,
    Replaced,
    closed_loop,
    rehearse,
)
from gpmpc.status import Status
from gpmpc.systems import Map, System, Translational, step


class Cart:
    """A mass on a rail."""

    state_names = ("x", "v")
    input_names = ("a",)

    def derivative(self, x, u):
        return [x[1], u[0]]


class HeavyCart(Cart):
    def derivative(self, x, u):
        return [x[1], u[0] / 2]


class Exploding(Cart):
    def derivative(self, x, u):
        return [x[1], x[1] * 1e5]


class Feedback:
    """u = -K (x - r), planned over three steps; keeps what it saw.

    ``failing`` are steps that end without a solution.
    """

    horizon = 3

    def __init__(self, failing=()):
        self.failing = failing
        self.seen = []

    def control(self, belief, reference, previous=None):
        k = len(self.seen)
        self.seen.append(belief)
        input = -np.array([[1.0, 1.5]]) @ (belief.mean.numpy() - reference.states[0])
        status = Status.ITERATION_LIMIT if k in self.failing else Status.SOLVED
        means = np.tile(belief.mean.numpy(), (4, 1))
        inputs = np.tile(input, (3, 1))
        covariances = np.zeros((4, 2, 2))
        return Decision(
            input, inputs, means, covariances, status, 5, Timing(0.1, 0.2, 0.3)
        )


PLANT = System(Cart(), time_step=0.1, substeps=1)
REFERENCES = np.zeros((100, 2))
START = np.array([1.0, 0.0])
ALL_NOISE = {"process": [0.01, 0.02], "measurement": [0.03, 0.01], "input": [0.1]}


def fly(steps=30, controller=None, plant=PLANT, initial=START, **settings):
    return closed_loop(
        plant, controller or Feedback(), REFERENCES, initial, steps, **settings
    )


def test_states_follow_the_plant_from_what_acted():
    flight = fly(initial=[1, 0])
    stepped = [
        step(PLANT, x, u)
        for x, u in zip(flight.states[:-1], flight.inputs, strict=True)
    ]
    assert np.array_equal(stepped, flight.states[1:])
    assert np.array_equal(flight.measured, flight.states[:-1])
    assert flight.covariances.shape == (31, 2, 2)
    assert not flight.covariances.any()
    assert flight.times[-1] == pytest.approx(3.0)
    assert np.allclose(flight.seconds, 0.6)
    assert flight.failures == ()
    assert flight.iterations.tolist() == [5] * 30


def test_numbers_depend_on_the_seed_alone():
    noise = Noise(**ALL_NOISE)
    first = fly(noise=noise, seed=3)
    again = fly(noise=noise, seed=3)
    other = fly(noise=noise, seed=4)
    assert np.array_equal(first.states, again.states)
    assert np.array_equal(first.measured, again.measured)
    assert not np.array_equal(first.states, other.states)


def test_each_noise_has_its_own_stream_and_deviation():
    class Blind(Feedback):
        def control(self, belief, reference, previous=None):
            return super().control(Gaussian.certain(np.zeros(2)), reference, previous)

    steps = 97
    alone = {
        key: fly(steps, Blind(), noise=Noise(**{key: value}))
        for key, value in ALL_NOISE.items()
    }
    together = fly(steps, Blind(), noise=Noise(**ALL_NOISE))
    assert np.array_equal(alone["input"].inputs, together.inputs)
    drawn = together.measured - together.states[:-1]
    assert np.allclose(
        alone["measurement"].measured - alone["measurement"].states[:-1],
        drawn,
        atol=1e-14,
    )
    pushed = np.array(
        [
            step(PLANT, x, u)
            for x, u in zip(together.states[:-1], together.inputs, strict=True)
        ]
    )
    process = together.states[1:] - pushed
    assert np.abs(process.std(axis=0) / ALL_NOISE["process"] - 1).max() < 0.3
    assert np.abs(drawn.std(axis=0) / ALL_NOISE["measurement"] - 1).max() < 0.3
    assert abs(together.inputs.std() / 0.1 - 1) < 0.3


def test_a_belief_is_what_the_initial_state_is_drawn_from():
    belief = Gaussian(torch.tensor([1.0, 0.0]), torch.diag(torch.tensor([0.04, 0.0])))
    starts = np.array(
        [fly(1, initial=belief, seed=seed).states[0] for seed in range(40)]
    )
    assert np.all(starts[:, 1] == 0)
    assert 0.1 < starts[:, 0].std() < 0.3
    assert np.array_equal(fly(1, initial=belief, seed=7).states[0], starts[7])


def test_a_gust_acts_in_its_window_and_is_integrated():
    def pushes(flight):
        free = [
            step(PLANT, x, u)
            for x, u in zip(flight.states[:-1], flight.inputs, strict=True)
        ]
        return flight.states[1:] - np.array(free)

    pushed = pushes(fly(disturbances=[Gust({"v": 2.0}, start=0.5, stop=1.0)]))
    assert np.allclose(pushed[5:10], [0.01, 0.2], atol=1e-12)  # a h^2 / 2, a h
    assert np.abs(np.delete(pushed, range(5, 10), axis=0)).max() == 0


def test_a_gust_moves_a_plant_without_derivative():
    class InSteps:
        state_names = Cart.state_names
        input_names = Cart.input_names

        def successor(self, x, u):
            return [x[0] + 0.1 * x[1], x[1] + 0.1 * u[0]]

    plant = System(InSteps(), time_step=0.1)
    flight = fly(plant=plant, disturbances=[Gust({"v": 2.0}, start=0.5, stop=1.0)])
    free = [
        step(plant, x, u)
        for x, u in zip(flight.states[:-1], flight.inputs, strict=True)
    ]
    pushes = flight.states[1:] - np.array(free)
    assert np.allclose(pushes[5:10], [0.0, 2.0 * 0.1], atol=1e-12)  # a rate, by step
    assert np.abs(np.delete(pushes, range(5, 10), axis=0)).max() == 0


def test_a_plant_is_replaced_from_a_time_on():
    heavy = System(HeavyCart(), time_step=0.1, substeps=1)
    flight = fly(disturbances=[Replaced(heavy, start=1.0)])
    for k, (x, u) in enumerate(zip(flight.states[:-1], flight.inputs, strict=True)):
        assert np.array_equal(
            step(PLANT if k < 10 else heavy, x, u), flight.states[k + 1]
        )


def test_disturbances_add_up_in_their_order():
    heavy = System(HeavyCart(), time_step=0.1, substeps=1)
    flight = fly(3, disturbances=[Replaced(heavy), Gust({"v": 1.0})])
    expected = step(heavy, flight.states[0], flight.inputs[0]) + np.array([0.005, 0.1])
    assert np.allclose(flight.states[1], expected, atol=1e-14)


def test_a_dropout_is_bridged_counted_and_never_seen():
    controller = Feedback()
    flight = fly(
        controller=controller,
        disturbances=[Dropout(0.3, 0.6)],
        on_failure="previous_plan",
    )
    assert flight.failures == tuple((k, Status.INVALID_MEASUREMENT) for k in (3, 4, 5))
    assert np.isnan(flight.measured[3:6]).all()
    assert np.isnan(flight.predicted_means[3:6]).all()
    assert all(bool(torch.isfinite(belief.mean).all()) for belief in controller.seen)
    assert np.array_equal(flight.inputs[3:6], np.tile(flight.inputs[2], (3, 1)))
    assert np.abs(flight.states[-1]).max() < 0.3


def test_one_entry_can_drop_out():
    flight = fly(disturbances=[Dropout(0.3, 0.4, entries=[1])], on_failure="hold")
    assert np.isnan(flight.measured[3]).tolist() == [False, True]
    assert len(flight.failures) == 1


def test_every_failure_is_counted_with_step_and_status():
    flight = fly(controller=Feedback(failing=(2, 7)), on_failure="hold")
    assert flight.failures == ((2, Status.ITERATION_LIMIT), (7, Status.ITERATION_LIMIT))
    assert np.array_equal(flight.inputs[2], flight.inputs[1])


def test_plans_that_leave_the_data_are_counted_by_step():
    class Astray(Feedback):
        def control(self, belief, reference, previous=None):
            return replace(
                super().control(belief, reference, previous),
                plan_novelty=0.99 if len(self.seen) == 3 else 0.1,
            )

    assert fly(5, Astray()).far_from_data == (2,)


def test_every_step_is_told_as_it_happens():
    reported = []
    flight = fly(5, on_step=reported.append, noise=Noise(**ALL_NOISE))
    assert [s.k for s in reported] == list(range(5))
    assert [s.time for s in reported] == [0, 0.1, 0.2, 0.3, 0.4]
    assert np.array_equal([s.state for s in reported], flight.states[:-1])
    assert np.array_equal([s.measured for s in reported], flight.measured)
    assert np.array_equal([s.input for s in reported], flight.inputs)


class Attentive(Feedback):
    """Keeps the references that it is asked to follow."""

    def __init__(self):
        super().__init__()
        self.references = []

    def control(self, belief, reference, previous=None):
        self.references.append(reference)
        return super().control(belief, reference, previous)


def test_references_with_inputs_are_handed_on_window_by_window():
    controller = Attentive()
    seen = controller.references
    references = Reference(np.arange(18.0).reshape(9, 2), np.arange(8.0)[:, None])
    flight = closed_loop(PLANT, controller, references, START, 6)
    assert all(
        np.array_equal(r.states, references.states[k : k + 4])
        for k, r in enumerate(seen)
    )
    assert all(
        np.array_equal(r.inputs, references.inputs[k : k + 3])
        for k, r in enumerate(seen)
    )
    assert np.array_equal(flight.references, references.states[:7])


def test_kappas_move_along_a_path_and_stay_at_a_set_point():
    controller = Attentive()
    along = np.linspace(1.0, 2.0, 8)
    path = Reference(np.zeros((9, 2)), kappas=along)
    closed_loop(PLANT, controller, path, START, 6)
    assert [list(seen.kappas) for seen in controller.references] == [
        list(along[k : k + 3]) for k in range(6)
    ]
    controller = Attentive()
    by_stage = [0.5, 1.0, 1.5]
    closed_loop(PLANT, controller, Reference([0.0, 0.0], kappas=by_stage), START, 6)
    assert [list(seen.kappas) for seen in controller.references] == [by_stage] * 6
    with pytest.raises(ShapeError, match=r"kappas of a set point must be \(3,\)"):
        closed_loop(PLANT, controller, Reference([0.0, 0.0], kappas=[1.0]), START, 6)


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(0)
    x = torch.from_numpy(rng.normal(size=(40, 2)))
    u = torch.from_numpy(3 * rng.normal(size=(40, 1)))
    after = torch.from_numpy(
        np.array([step(PLANT, a, b) for a, b in zip(x.numpy(), u.numpy(), strict=True)])
    )
    ones = torch.ones(2)
    return GPPosterior.from_hyperparameters(
        torch.cat([x, u], 1),
        after - x,
        6 * torch.ones(2, 3),
        4 * ones,
        1e-5 * ones,
        1,
        "difference",
    )


def test_a_model_loop_carries_mean_and_covariance_on(model):
    controller = Feedback()
    propagator = MomentMatching()
    flight = fly(20, controller, ModelLoop(model, propagator, time_step=0.1))
    belief = Gaussian(torch.from_numpy(START), 0.1**2 * torch.eye(2))
    for k in range(20):
        assert np.array_equal(flight.states[k], belief.mean.numpy())
        assert np.array_equal(flight.covariances[k], belief.covariance.numpy())
        assert torch.equal(controller.seen[k].covariance, belief.covariance)
        belief = propagator(model, belief, torch.from_numpy(flight.inputs[k]))
    assert np.array_equal(flight.covariances[20], belief.covariance.numpy())
    assert np.abs(flight.states[-1] - fly(20).states[-1]).max() < 0.01


def test_a_model_loop_starts_from_a_given_belief(model):
    belief = Gaussian(torch.tensor([0.5, 0.0]), 0.5 * torch.eye(2))
    assert np.array_equal(
        fly(1, plant=ModelLoop(model, MomentMatching()), initial=belief).covariances[0],
        np.eye(2) / 2,
    )


def test_a_plant_that_leaves_the_finite_numbers_is_said_so():
    with pytest.raises(
        Diverged, match="step 1: the plant's state is not finite any more"
    ) as caught:
        fly(plant=System(Exploding(), 1.0, substeps=1), initial=np.array([0.0, 1.0]))
    assert caught.value.step == 1
    flown = caught.value.rollout
    assert flown.states[:, 1] == pytest.approx(
        [1.0, 1e20 / 24], rel=1e-4
    )  # what was flown before is kept
    assert len(flown.inputs) == 1
    with pytest.raises(Diverged) as caught:
        fly(plant=System(Exploding(), 1.0, substeps=1), initial=np.array([0.0, 1e29]))
    assert caught.value.rollout is None


def test_a_belief_that_overflows_ends_the_flight_as_diverged():
    unstable = KnownModel(lambda x, u: 1e3 * x + u, 2, 1)

    class Regulator(Feedback):
        def control(self, belief, reference, previous=None):
            decision = super().control(belief, reference, previous)
            return replace(decision, input=np.array([-1e3 * float(belief.mean[0])]))

    with pytest.raises(Diverged, match="belief cannot be carried on") as caught:
        fly(96, Regulator(), ModelLoop(unstable, Linearization()), [0.0, 0.0])
    assert len(caught.value.rollout.inputs) == caught.value.step > 45


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        (
            {"on_failure": "previous"},
            SettingError,
            "on_failure: must be one of 'previous_plan', .*; got 'previous'",
        ),
        (
            {"noise": Noise(process=[0.1])},
            ShapeError,
            "noise.process must have 2 standard deviations; got 1",
        ),
        (
            {"noise": Noise(input=[0.1, 1])},
            ShapeError,
            "noise.input must have 1 standard deviations; got 2",
        ),
        (
            {"initial": np.zeros(3)},
            ShapeError,
            r"the initial state must have shape \(2,\); got \(3,\)",
        ),
        (
            {"initial": np.array([np.nan, 0])},
            SettingError,
            "initial: must be finite; got",
        ),
        (
            {"steps": 98},
            ShapeError,
            "98 steps with horizon 3 need 101 references; got 100",
        ),
        ({"steps": 0}, SettingError, "steps: must be a whole number, 1 or more; got 0"),
        ({"seed": -1}, SettingError, "seed: must be a whole number, 0 or more; got -1"),
        (
            {"disturbances": [Gust({"w": 1.0})]},
            SettingError,
            "must name states of the plant, x, v; got 'w'",
        ),
        (
            {"disturbances": [Dropout(5, 6, entries=[2])]},
            SettingError,
            "must be indices of states, 0 to 1; got 2",
        ),
        (
            {"disturbances": [Replaced(System(Map(Translational()), 1.0))]},
            ShapeError,
            "replaced by one of the same states",
        ),
        (
            {"initial": Gaussian(torch.zeros(2), -0.01 * torch.eye(2))},
            SettingError,
            "initial.covariance: must have variances of zero or more",
        ),
        (
            {"initial": Gaussian(torch.zeros(2), torch.full((2, 2), torch.nan))},
            SettingError,
            "initial.covariance: must hold finite real numbers",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(settings, error, message):
    with pytest.raises(error, match=message):
        fly(**settings)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: Noise(process=[0.1, -0.1]),
            "noise.process: must be a number, 0 or more; got -0.1",
        ),
        (lambda: Noise(measurement=0.1), "noise.measurement: must be a list"),
        (
            lambda: Gust({"v": 1.0}, start=2.0, stop=1.0),
            r"stop: must be a number above 2.0 \[s\]; got 1.0",
        ),
        (lambda: Gust({"v": "strong"}), "rates.v: must be a number; got 'strong'"),
        (lambda: Gust({}), "rates: must map names of states to numbers"),
        (lambda: Dropout(1.0, 1.0), "stop: must be a number above 1.0"),
        (lambda: Dropout(1, 2, entries=0), "entries: must be a list .*; got 0"),
        (lambda: Dropout(1, 2, entries=[]), r"entries: must be a list .*; got \[\]"),
        (
            lambda: ModelLoop(None, None, time_step=-1),
            r"time_step: must be a number above 0 \[s\]; got -1",
        ),
    ],
)
def test_a_wrong_setting_is_refused_at_construction(build, message):
    with pytest.raises(SettingError, match=message):
        build()


def test_a_gust_on_a_simulator_is_refused_with_what_is_possible():
    class UnderWay(Cart):
        stateful = True

        def successor(self, x, u):
            return [x[0], x[1]]

    with pytest.raises(UnsupportedModel, match="Possible with any plant: Replaced"):
        # in its window or not: before the first step
        fly(plant=System(UnderWay(), 0.1), disturbances=[Gust({"v": 1.0}, start=99.0)])
    with pytest.raises(
        SettingError,
        match=r"system: must be a plant, such as System\(dynamics, 0.1\).*got UnderWay",
    ):
        fly(plant=UnderWay())


def test_nothing_disturbs_a_model_loop(model):
    for settings in (
        {"noise": Noise(process=[0.1, 0.1])},
        {"disturbances": [Gust({"v": 1.0})]},
    ):
        with pytest.raises(
            SettingError, match="need a plant in the loop; got a ModelLoop"
        ):
            fly(plant=ModelLoop(model, MomentMatching()), **settings)


@pytest.mark.parametrize("rate", [10, 30, 60, 100])
def test_a_window_opens_and_closes_at_its_step(rate):
    period = 1 / rate
    for k in range(1, 200):
        gust = Gust({"v": 1.0}, start=k * period, stop=(k + 1) * period)
        times = [round(i * period, 9) for i in (k - 1, k, k + 1)]
        assert [gust.acts(time) for time in times] == [False, True, False]


class InPlace(Feedback):
    """Calculates in the arrays that it is handed, as its sensor and its plant do."""

    def control(self, belief, reference, previous=None):
        decision = super().control(belief, reference, previous)
        belief.mean.numpy()[:] = np.nan
        reference.states[:] = np.nan
        return decision

    def disturb_plant(self, plant, time):
        return plant

    def disturb_measurement(self, state, time):
        state += 0.1
        return state


class InPlaceCart(Cart):
    def successor(self, x, u):
        x[0] += 0.1 * x[1]
        x[1] += 0.1 * u[0]
        return x


def test_arrays_handed_out_are_no_part_of_plant_or_record():
    plant = System(InPlaceCart(), time_step=0.1, substeps=1)
    careless = InPlace()
    flight = fly(controller=careless, plant=plant, disturbances=[careless])
    assert np.allclose(flight.measured, flight.states[:-1] + 0.1)
    assert np.array_equal(flight.references, np.zeros((31, 2)))
    x, v = flight.states.T
    assert np.allclose(np.diff(x), 0.1 * v[:-1])
    assert np.allclose(np.diff(v), 0.1 * flight.inputs[:, 0])
    assert not REFERENCES.any()


def test_a_model_loop_keeps_its_belief_to_itself(model):
    loop = ModelLoop(model, MomentMatching())
    careful = fly(controller=Feedback(), plant=loop, steps=3)
    careless = fly(controller=InPlace(), plant=loop, steps=3)
    assert np.array_equal(careful.states, careless.states)


def test_a_disturbance_without_a_method_is_refused():
    class Half:
        def disturb_plant(self, plant, time):
            return plant

    with pytest.raises(SettingError, match="the method 'disturb_measurement'"):
        fly(disturbances=[Half()])


def test_one_step_is_rehearsed_where_references_end():
    controller = Feedback()
    rehearse(PLANT, controller, Reference(np.zeros((4, 2))), START)
    assert len(controller.seen) == 1
    rehearse(PLANT, controller, Reference(np.zeros((5, 2))), START)
    assert len(controller.seen) == 3
