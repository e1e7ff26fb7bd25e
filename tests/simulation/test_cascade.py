from itertools import pairwise

import numpy as np
import pytest

from gpmpc.exceptions import Diverged, SettingError, ShapeError, SolverFailure
from gpmpc.metrics import tracking_error
from gpmpc.mpc import Problem, Tracking
from gpmpc.mpc.baselines import NMPC
from gpmpc.simulation import Cascade, Dropout, Gust, Noise, Replaced, cascade_loop
from gpmpc.status import Status
from gpmpc.systems import Coupled, Map, Rotational, System, Translational, step
from gpmpc.trajectories import Elliptical, Lorenz, states_along

PLANT = System(Coupled(), time_step=0.05, substeps=1)
PROBLEM = Problem(Tracking([1] * 6, [1] * 3))
OUTER = NMPC(System(Translational(), 1.0, 1), PROBLEM, 1, [7.26, 0, 0])
INNER = NMPC(System(Rotational(), 0.05, 1), PROBLEM, 1, [0, 0, 0])
CASCADE = Cascade(OUTER, INNER)
NOISE = Noise(measurement=[0.01] * 6 + [0.002, 0.01] * 3)


def fly(trajectory, steps, cascade=CASCADE, plant=PLANT, **settings):
    references = states_along(trajectory, np.arange(steps + 2.0))
    start = np.concatenate([references[0], np.zeros(6)])
    return cascade_loop(
        plant, cascade, references, settings.pop("initial", start), steps, **settings
    )


def distance(flight):
    return tracking_error(flight.outer.states, flight.outer.references, (0, 2, 4)).total


@pytest.mark.parametrize(
    ("trajectory", "expected"),
    [(Elliptical(), 0.01), (Lorenz(), 0.2)],
    ids=["elliptical", "lorenz"],
)
def test_it_tracks_both_trajectories_of_the_paper(trajectory, expected):
    flight = fly(trajectory, 25)
    assert flight.outer.failures == flight.inner.failures == ()
    assert distance(flight) < expected


def test_the_rollouts_are_two_views_of_one_flight():
    flight = fly(Elliptical(), 3, noise=NOISE)
    stepped = [
        step(PLANT, x, u)
        for x, u in zip(flight.states[:-1], flight.inputs, strict=True)
    ]
    assert np.array_equal(stepped, flight.states[1:])
    assert np.array_equal(flight.outer.states, flight.states[::20, :6])
    assert np.array_equal(flight.inner.states, flight.states[:, 6:])
    assert np.array_equal(flight.inner.inputs, flight.inputs[:, 1:])
    assert np.array_equal(np.repeat(flight.outer.inputs[:, 0], 20), flight.inputs[:, 0])
    assert (flight.outer.time_step, flight.inner.time_step) == (1.0, 0.05)
    assert (len(flight.outer.seconds), len(flight.inner.seconds)) == (3, 60)


def test_each_loop_is_told_to_a_recorder_at_its_own_rate():
    steps = {"outer": [], "inner": []}
    flight = fly(
        Elliptical(),
        3,
        noise=NOISE,
        on_step=lambda loop, step: steps[loop].append(step),
    )
    for reported, loop in (
        (steps["outer"], flight.outer),
        (steps["inner"], flight.inner),
    ):
        assert [step.k for step in reported] == list(range(len(loop.inputs)))
        assert [step.time for step in reported] == pytest.approx(
            loop.time_step * np.arange(len(loop.inputs))
        )
        for name, expected in (
            ("state", loop.states[:-1]),
            ("measured", loop.measured),
            ("input", loop.inputs),
        ):
            assert np.array_equal([getattr(step, name) for step in reported], expected)
        assert np.array_equal(
            [step.reference for step in reported], loop.references[: len(reported)]
        )
        expected = [
            step.measured - before.decision.means[1]
            for before, step in pairwise(reported)
        ]
        assert np.array_equal([step.innovation for step in reported[1:]], expected)


def thrust_direction(roll, pitch, yaw):
    """Horizontal part of the unit vector along the thrust, (ux, uy)."""
    ux = np.cos(roll) * np.sin(pitch) * np.cos(yaw) + np.sin(roll) * np.sin(yaw)
    uy = np.cos(roll) * np.sin(pitch) * np.sin(yaw) - np.sin(roll) * np.cos(yaw)
    return ux, uy


def test_the_attitude_reaches_the_outer_plans_thrust_direction():
    flight = fly(Lorenz(), 8)
    ends = flight.states[18::20, 6:][
        :8
    ]  # the last but one inner step looks at the next outer one
    reached = np.array([thrust_direction(x[0], x[2], x[4]) for x in ends])
    assert np.abs(reached - flight.outer.inputs[:, 1:]).max() < 2e-3


def test_it_flies_with_a_yaw_that_is_still_wrong():
    start = np.concatenate([states_along(Elliptical(), np.zeros(1))[0], np.zeros(6)])
    start[10] = 1.0  # [rad]
    flight = fly(Elliptical(), 6, initial=start)
    assert abs(flight.states[-1, 10]) < 1e-3
    assert distance(flight) < 0.05


def test_it_survives_a_wrong_mass_and_a_gust():
    heavy = System(Coupled(mass=0.8), time_step=0.05, substeps=1)
    disturbances = [
        Replaced(heavy, start=4.0),
        Gust({"vx": 0.5, "vy": -0.3}, start=8.0, stop=10.0),
    ]
    flight = fly(
        Elliptical(),
        20,
        disturbances=disturbances,
        noise=NOISE,
        on_failure="previous_plan",
    )
    error = np.linalg.norm(
        (flight.outer.states - flight.outer.references)[:, ::2], axis=1
    )
    assert error[:5].max() < 0.1
    assert 0.2 < error.max() < 2.5  # nothing learns the mass: a sag in z remains
    assert (
        np.abs((flight.outer.states - flight.outer.references)[-3:, [0, 2]]).max() < 0.2
    )  # the gust is over


def test_without_position_the_attitude_is_still_held():
    lost = [Dropout(3.0, 5.5, entries=range(6))]
    flight = fly(Elliptical(), 10, disturbances=lost, on_failure="previous_plan")
    assert flight.outer.failures == tuple(
        (k, Status.INVALID_MEASUREMENT) for k in (3, 4, 5)
    )
    assert flight.inner.failures == ()
    assert distance(flight) < 0.5


def test_without_any_measurement_for_a_moment_both_plans_go_on():
    flight = fly(Elliptical(), 5, disturbances=[Dropout(2.0, 2.1)], on_failure="hold")
    assert [k for k, _ in flight.outer.failures] == [2]
    assert [k for k, _ in flight.inner.failures] == [40, 41]
    assert np.isfinite(flight.inner.references).all()
    assert distance(flight) < 0.5

    class Marking(Dropout):
        def disturb_measurement(self, state, time):
            return np.nan_to_num(super().disturb_measurement(state, time), nan=3.4e38)

    marked = fly(Elliptical(), 5, disturbances=[Marking(2.0, 2.1)], on_failure="hold")
    assert np.array_equal(marked.inner.references, flight.inner.references)
    with pytest.raises(SolverFailure, match="step 2: the state is not finite"):
        fly(Elliptical(), 5, disturbances=[Dropout(2.0, 2.1)])


def test_a_cascade_that_diverges_keeps_what_was_flown():
    class Fleeing(Coupled):
        def derivative(self, x, u):
            return [1e35, *super().derivative(x, u)[1:]]

    gone = [Replaced(System(Fleeing(), 0.05, 1), start=0.2)]
    with pytest.raises(Diverged) as caught:
        fly(Elliptical(), 2, disturbances=gone)
    flown = caught.value.rollout
    assert caught.value.step == len(flown.inputs) == len(flown.inner.inputs) == 4
    assert len(flown.outer.inputs) == 1


def test_a_seed_repeats_a_flight_and_inner_steps_are_reported():
    reported = []
    first = fly(
        Elliptical(),
        2,
        noise=NOISE,
        seed=1,
        on_step=lambda *step: reported.append(step),
    )
    again = fly(Elliptical(), 2, noise=NOISE, seed=1)
    assert np.array_equal(first.states, again.states)
    inner = [step for loop, step in reported if loop == "inner"]
    assert [step.k for step in inner] == list(range(40))
    assert [i for i, (loop, _) in enumerate(reported) if loop == "outer"] == [0, 21]
    assert np.array_equal([step.state for step in inner], first.states[:-1, 6:])


def test_attitudes_follow_the_plan_and_are_approached_slowly():
    class Far:
        horizon = 5

    cascade = Cascade(Far(), Far(), ratio=4, response_time=0.2)
    planned = np.array([[7.0, 0.3, 0.2], [7.0, -0.1, 0.0]])
    angles = np.array([0.05, 0.0, 0.1])
    reference = cascade.attitude_reference(planned, angles, phase=2)
    assert reference.horizon == 5
    for row, direction in zip(
        reference.states, planned[[0, 0, 1, 1, 1, 1], 1:], strict=True
    ):
        assert thrust_direction(row[0], row[2], 0.1) == pytest.approx(direction)
        assert np.allclose(row[1::2], (row[::2] - angles) / 0.2)
    turns = np.array([0.0, 0.0, 4 * np.pi])
    turned = cascade.attitude_reference(planned, angles + turns, phase=2)
    assert np.allclose(turned.states, reference.states)


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (
            lambda: Cascade(OUTER, INNER, ratio=0),
            SettingError,
            "ratio: must be a whole number, 1 or more; got 0",
        ),
        (
            lambda: Cascade(OUTER, INNER, response_time=0),
            SettingError,
            "response_time: must be a number above 0",
        ),
        (
            lambda: fly(Elliptical(), 2, plant=System(Map(Rotational()), 1.0)),
            ShapeError,
            "flies the states and inputs of Coupled",
        ),
        (
            lambda: fly(Elliptical(), 2, on_failure="hope"),
            SettingError,
            "on_failure: must be one of",
        ),
        (
            lambda: fly(Elliptical(), 2, initial=np.zeros(6)),
            ShapeError,
            r"must have shape \(12,\); got \(6,\)",
        ),
        (
            lambda: cascade_loop(PLANT, CASCADE, np.zeros((2, 6)), np.zeros(12), 2),
            ShapeError,
            "need 3 references; got 2",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(build, error, message):
    with pytest.raises(error, match=message):
        build()
