"""A system says everything of itself, and what cannot be flown is refused where it is
made."""

from dataclasses import replace

import casadi
import numpy as np
import pytest

from gpmpc.datasets import RandomData
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.systems import (
    GRAVITY,
    System,
    acrobot,
    cart_pole,
    coupled,
    double_integrator,
    double_pendulum,
    dynamic_bicycle,
    kinematic_bicycle,
    pendulum,
    planar_quadrotor,
    rotational,
    sin,
    step,
    step_many,
    stirred_tank,
    translational,
)
from gpmpc.trajectories import Hover, Step, Waypoints

ALL = [
    make()
    for make in (
        acrobot,
        cart_pole,
        coupled,
        double_integrator,
        double_pendulum,
        pendulum,
        planar_quadrotor,
        rotational,
        stirred_tank,
        translational,
    )
]


class Spring:
    state_names = ("position", "speed")
    input_names = ("force",)

    def __init__(self, derivative=lambda x, u: [x[1], u[0] - sin(x[0])]):
        self.derivative = derivative


LIMITED = System(Spring(), 0.1, input_lower=[-1], input_upper=[1])
ENDLESS = Spring(
    lambda x, u: [x[1], 1e308 * (u[0] + 100 * abs(u[0]))]
)  # at rest it stays


@pytest.mark.parametrize("system", ALL, ids=lambda system: system.name)
def test_one_formula_takes_floats_arrays_and_symbols(system, rng):
    n = len(system.state_names)
    m = len(system.input_names)
    start = np.array(system.goal if system.start is None else system.start)
    states = start + 0.01 * rng.normal(size=(5, n))
    inputs = np.array(system.initial_input) + 0.01 * rng.normal(size=m)
    x = casadi.SX.sym("x", n)
    u = casadi.SX.sym("u", m)
    symbolic = casadi.Function("f", [x, u], [casadi.vertcat(*system.successor(x, u))])
    many = step_many(system, states, np.tile(inputs, (5, 1)))
    for state, after in zip(states, many, strict=True):
        assert np.allclose(step(system, state, inputs), after, rtol=1e-13, atol=1e-15)
        assert np.allclose(
            np.array(symbolic(state, inputs)).ravel(), after, rtol=1e-12, atol=1e-14
        )


def energy(system, x):
    d = system.dynamics
    if system.name == "pendulum":
        return d.mass * d.length**2 / 6 * x[
            1
        ] ** 2 + d.mass * GRAVITY * d.length / 2 * np.cos(x[0])
    if system.name == "cart_pole":
        across = x[1] + d.half_length * x[3] * np.cos(x[2])
        up = d.half_length * x[3] * np.sin(x[2])
        turning = d.pole_mass * (2 * d.half_length) ** 2 / 24 * x[3] ** 2
        moving = d.cart_mass * x[1] ** 2 / 2 + d.pole_mass * (across**2 + up**2) / 2
        return moving + turning + d.pole_mass * GRAVITY * d.half_length * np.cos(x[2])
    (m1, m2), (c1, c2), (i1, i2), l1 = d.masses, d.centres, d.inertias, d.first_length
    a, da, b, db = x
    squared = (
        (l1 * da) ** 2
        + (c2 * (da + db)) ** 2
        + 2 * l1 * c2 * da * (da + db) * np.cos(b)
    )
    moving = (m1 * c1**2 + i1) * da**2 / 2 + m2 * squared / 2 + i2 * (da + db) ** 2 / 2
    return moving + GRAVITY * (
        m1 * c1 * np.cos(a) + m2 * (l1 * np.cos(a) + c2 * np.cos(a + b))
    )


@pytest.mark.parametrize(
    ("system", "start"),
    [
        (pendulum(damping=0), [2.0, 1.0]),
        (cart_pole(), [0.0, 1.0, 0.5, -1.0]),
        (acrobot(), [2.0, 1.0, 0.5, -1.0]),
        (double_pendulum("shoulder"), [2.0, 1.0, 0.5, -1.0]),
    ],
    ids=["pendulum", "cart_pole", "acrobot", "double_pendulum"],
)
def test_without_input_and_friction_energy_is_conserved(system, start):
    state = np.array(start)
    system = replace(system, substeps=20)
    for _ in range(40):
        state = step(system, state, np.zeros(1))
    assert energy(system, state) == pytest.approx(energy(system, start), rel=1e-7)


@pytest.mark.parametrize(("actuated", "joint"), [("shoulder", 1), ("elbow", 3)])
def test_a_motor_adds_torque_times_joint_rate_to_the_energy(actuated, joint):
    system = double_pendulum(actuated)
    state = np.array([2.0, 1.0, 0.5, -1.0])
    torque = np.array([1.5])
    system = replace(system, time_step=1e-4)
    after = step(system, state, torque)
    work = torque[0] * (state[joint] + after[joint]) / 2 * 1e-4
    assert energy(system, after) - energy(system, state) == pytest.approx(
        work, rel=1e-5
    )


def test_the_reactors_operating_point_is_an_unstable_equilibrium():
    system = stirred_tank()
    point = np.array([0.5, 350.0])
    assert step(system, point, np.array([300.0])) == pytest.approx(point, rel=1e-5)
    state = np.array([0.5, 350.5])
    for _ in range(60):
        state = step(system, state, np.array([300.0]))
    assert abs(state[1] - 350) > 5


def test_a_trajectory_gives_the_tracked_states_and_their_rates():
    moving = Waypoints([0.0, 1.0], [[0.0], [1.0]])
    states = double_integrator(time_step=0.1).reference_states(moving, 11)
    assert np.array_equal(states[:, 0], moving(np.linspace(0, 1, 11))[:, 0])
    assert np.array_equal(states[:, 1], moving.velocity(np.linspace(0, 1, 11))[:, 0])
    assert np.array_equal(
        stirred_tank().reference_states(None, 3), np.tile([0.5, 350.0], (3, 1))
    )
    assert np.array_equal(
        stirred_tank().reference_states(Step([350.0], [351.0], 3.0), 2),
        [[0.5, 350], [0.5, 351]],
    )


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        (
            {"dynamics": Spring(lambda x, u: [x[1]])},
            ShapeError,
            "derivative must give 2 entries, one for each of",
        ),
        (
            {"dynamics": Spring(lambda x, u: 3.0)},
            ShapeError,
            "derivative must give 2 entries.*got float",
        ),
        (
            {"dynamics": Spring(lambda x, u: [x[1], np.nan])},
            SettingError,
            "must be finite at state .*is nan after it",
        ),
        (
            {"dynamics": Spring(lambda x, u: [x[1], x[7]])},
            SettingError,
            "must step from state .*got IndexError",
        ),
        (
            {"dynamics": object()},
            SettingError,
            "dynamics.state_names: must be a list of different names; got None",
        ),
        (
            {"units": {"torque": "N m"}},
            SettingError,
            "units: must be of position, speed, force; got torque",
        ),
        (
            {"tracked": ["velocity"]},
            SettingError,
            "tracked: must name states, position, speed; got 'velocity'",
        ),
        (
            {"lost": {"rad": 1.0}},
            SettingError,
            "lost: must be of units of tracked states, m; got 'rad'",
        ),
        (
            {"rates": {"speed": "place"}},
            SettingError,
            "rates: must name states, position, speed; got 'place'",
        ),
        (
            {"rates": {"position": "speed", "speed": "position"}},
            SettingError,
            "rates: must not go round in circles; got position of speed of position",
        ),
        ({"angles": ["position "]}, SettingError, "angles: must name states"),
        ({"input_lower": [1.0], "input_upper": [-1.0]}, SettingError, "must not cross"),
        (
            {"input_lower": [0.0, 0.0]},
            SettingError,
            "input_lower: must be a list of 1 numbers",
        ),
        ({"start": [0.0]}, SettingError, "start: must be a list of 2 numbers; got"),
        (
            {"region": [[0.0, 0.0]]},
            SettingError,
            "region: must be the smallest and the largest states",
        ),
        ({"region": 3.0}, SettingError, "region: must be the smallest and the largest"),
        (
            {"nominal": pendulum()},
            SettingError,
            "nominal: must have the states, inputs and time step .*position",
        ),
        ({"lost": 0.0}, SettingError, "lost: must be a number above 0"),
        (
            {"units": {"position": "mm"}, "pose": {"x": "position"}},
            SettingError,
            r"pose: must be in m and rad; got position \[mm\] for x",
        ),
    ],
)
def test_misuse_is_refused_where_the_system_is_made(settings, error, message):
    defaults = {
        "dynamics": Spring(),
        "time_step": 0.1,
        "units": {"position": "m", "speed": "m/s"},
    }
    with pytest.raises(error, match=message):
        System(**(defaults | settings))


def test_a_car_turns_the_other_way_backwards_and_not_at_rest():
    car = dynamic_bicycle().dynamics
    assert car.derivative([0.0] * 6, [0.3, 0.0]) == pytest.approx([0.0] * 6)
    forwards = car.derivative([0.0, 0.0, 0.0, 2.0, 0.0, 0.0], [0.3, 0.0])
    backwards = car.derivative([0.0, 0.0, 0.0, -2.0, 0.0, 0.0], [0.3, 0.0])
    assert backwards[4:] == pytest.approx([-rate for rate in forwards[4:]])
    assert forwards[5] > 10


def test_curvature_is_of_a_unit_of_steering():
    scale = np.pi / 180  # steering in degrees
    car = kinematic_bicycle(curvature=scale / 0.3, steering_scale=scale).dynamics
    yaw_rate = car.derivative([0.0, 0.0, 0.0, 1.0], [10.0, 0.0])[2]
    assert yaw_rate == pytest.approx(np.tan(10 * scale) / 0.3)
    with pytest.raises(SettingError, match=r"steering_scale: must not be 0 \[rad\]"):
        kinematic_bicycle(steering_scale=0.0)


def test_a_trajectory_of_another_number_of_positions_is_refused():
    with pytest.raises(
        ShapeError,
        match="trajectory: must prescribe angle of pendulum; "
        "got positions of 3 numbers",
    ):
        pendulum().reference_states(Hover([0, 0, 0]), 3)


def test_a_quadrotor_of_another_mass_begins_with_its_own_weight():
    assert coupled().initial_input[0] == translational().initial_input[0] == 7.26
    assert coupled(mass=1.0).initial_input[0] == pytest.approx(9.81, rel=1e-3)
    assert translational(mass=1.0).initial_input[0] == pytest.approx(9.81, rel=1e-3)


def test_a_system_keeps_what_it_was_checked_with():
    rates = {"speed": "position"}
    system = System(Spring(), 0.1, rates=rates)
    rates["speed"] = "nothing"
    assert system.rates == {"speed": "position"}


@pytest.mark.parametrize("inputs", [0.0, [0.0], [[0.0, 1.0]]])
def test_many_steps_take_tables_alone(inputs):
    with pytest.raises(ShapeError, match=r"must be \(T, 4\) and \(T, 1\)"):
        step_many(cart_pole(), [[0.0] * 4], inputs)


def test_random_data_are_the_systems_own_within_its_limits():
    system = cart_pole()
    data = RandomData(samples=53, episode=7, hold=2, seed=3).transitions(system)
    states, inputs, after = (
        part.numpy() for part in (data.states, data.inputs, data.next_states)
    )
    assert len(data) == 53
    assert np.abs(step_many(system, states, inputs) - after).max() < 1e-12
    assert (np.abs(inputs) <= 10).all()
    assert np.abs(inputs).max() > 9
    inside = (np.array(system.region[0]) <= states[::7]) & (
        states[::7] <= system.region[1]
    )
    assert inside.all()
    assert np.array_equal(states[1:7], after[:6])
    assert np.array_equal(inputs[0], inputs[1])
    again, other = (
        RandomData(samples=53, episode=7, hold=2, seed=seed).transitions(system)
        for seed in (3, 4)
    )
    assert np.array_equal(again.states, data.states)
    assert not np.array_equal(other.states, data.states)


def test_noise_and_starts_of_random_data_are_as_asked_for():
    system = pendulum()
    data = RandomData(
        samples=400, starts="start", episode=2, noise=[0.01, 0.1]
    ).transitions(system)
    left = data.next_states.numpy() - step_many(
        system, data.states.numpy(), data.inputs.numpy()
    )
    assert left.std(axis=0) == pytest.approx([0.01, 0.1], rel=0.15)
    assert (data.states.numpy()[::2] == system.start).all()


@pytest.mark.parametrize(
    ("system", "settings", "error", "message"),
    [
        (
            System(Spring(), 0.1),
            {},
            SettingError,
            "random inputs need limits; force of Spring has none",
        ),
        (
            System(Spring(), 0.1, input_lower=[-1], input_upper=[1]),
            {},
            SettingError,
            "data.starts: Spring has no region",
        ),
        (
            pendulum(),
            {"noise": [0.1]},
            ShapeError,
            "data.noise must have 2 deviations; got 1",
        ),
        (
            replace(LIMITED, dynamics=ENDLESS),
            {"starts": "start", "episode": 100},
            DataError,
            "only . of 200 random",
        ),
    ],
)
def test_random_data_that_there_cannot_be_are_refused(system, settings, error, message):
    with pytest.raises(error, match=message):
        RandomData(**settings).transitions(system)
