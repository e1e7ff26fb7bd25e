from functools import partial

import casadi
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gpmpc.exceptions import SettingError
from gpmpc.systems import (
    Map,
    Rotational,
    System,
    Translational,
    attitude_for_thrust_direction,
    step,
)

FROZEN = Translational(frozen_attitude=(np.pi / 4, np.pi / 4))
DYNAMICS = [
    FROZEN,
    Translational(),
    Rotational(),
    Rotational(inertia=(0.004, 0.005, 0.009)),
]


@pytest.mark.parametrize("subsystem", ["trans", "rotate"])
@pytest.mark.parametrize("trajectory", ["Elliptical", "Lorenz"])
def test_the_authors_data_obey_the_map(paper_data, trajectory, subsystem):
    rows = np.loadtxt(paper_data / f"ds_nmpc_{trajectory}_{subsystem}.txt")
    plant = System(Map(FROZEN if subsystem == "trans" else Rotational()), 1.0)
    predicted = np.array([step(plant, row[:6], row[6:9]) for row in rows])
    assert np.abs(predicted - rows[:, 9:]).max() < 1e-6 * np.abs(rows[:, 9:]).max()


def test_the_map_is_the_right_hand_side(rng):
    x = rng.normal(size=6)
    u = rng.normal(size=3)
    m = 0.74
    g = 9.81
    expected = [x[1], u[1] * u[0] / m, x[3], u[2] * u[0] / m, x[5], g - 0.5 * u[0] / m]
    assert np.allclose(step(System(Map(FROZEN), 1.0), x, u), expected, rtol=1e-15)


def test_the_rotational_coefficients_are_the_decoded_ones():
    def column(x, u):
        return np.array(
            Rotational().derivative(np.array(x, dtype=float), np.array(u, dtype=float))
        )

    rest = [0.0] * 6
    assert column(rest, [1, 0, 0])[1] == pytest.approx(42)
    assert column(rest, [0, 1, 0])[3] == pytest.approx(42)
    assert column(rest, [0, 0, 1])[5] == pytest.approx(0.21 / 0.0089)
    assert column([0, 0, 0, 1, 0, 1], [0, 0, 0])[1] == pytest.approx(
        -0.78 + 0.01102
    )  # a1 q r + a2 W q
    assert column([0, 1, 0, 0, 0, 1], [0, 0, 0])[3] == pytest.approx(
        0.78 - 0.01102
    )  # a3 p r - a4 W p
    assert column([0, 1, 0, 1, 0, 0], [0, 0, 0])[5] == 0  # a5 p q


@pytest.mark.parametrize("dynamics", DYNAMICS, ids=repr)
def test_the_integrated_plant_agrees_with_an_adaptive_integrator(dynamics, rng):
    plant = System(dynamics, time_step=0.3, substeps=10)
    for _ in range(5):
        x = rng.normal(size=6)
        u = 0.1 * rng.normal(size=3)
        exact = solve_ivp(
            lambda _, s, u=u: dynamics.derivative(s, u),
            (0, 0.3),
            x,
            rtol=1e-12,
            atol=1e-12,
        ).y[:, -1]
        assert np.abs(step(plant, x, u) - exact).max() < 1e-5 * (
            1 + np.abs(exact).max()
        )


def test_one_substep_is_exact_for_the_translational_subsystem(rng):
    x = rng.normal(size=6)
    u = np.array([8.0, 0.2, -0.1])
    h = 1.3
    vertical = np.sqrt(1 - u[1] ** 2 - u[2] ** 2)
    acceleration = np.array(
        [u[1] * u[0], u[2] * u[0], -vertical * u[0]]
    ) / 0.74 + np.array([0, 0, 9.81])
    next_state = step(System(Translational(), time_step=h, substeps=1), x, u)
    assert np.allclose(
        next_state[::2], x[::2] + h * x[1::2] + h**2 / 2 * acceleration, atol=1e-11
    )
    assert np.allclose(next_state[1::2], x[1::2] + h * acceleration, atol=1e-11)


@pytest.mark.parametrize(
    "plant", [Map, partial(System, time_step=1.0)], ids=["map", "integrated"]
)
@pytest.mark.parametrize("dynamics", DYNAMICS, ids=repr)
def test_casadi_and_numpy_pass_through_the_same_formula(plant, dynamics, rng):
    plant = plant(dynamics)
    x = casadi.SX.sym("x", 6)
    u = casadi.SX.sym("u", 3)
    symbolic = casadi.Function("f", [x, u], [casadi.vertcat(*plant.successor(x, u))])
    for scale in (0.3, 3.0):  # beyond ux^2 + uy^2 = 1 as well
        state = rng.normal(size=6)
        control = scale * rng.normal(size=3)
        assert np.allclose(
            np.array(symbolic(state, control)).ravel(),
            step(plant, state, control),
            rtol=1e-13,
        )


def test_no_thrust_direction_beyond_the_horizontal_exists():
    assert step(
        System(Map(Translational()), 1.0), np.zeros(6), np.array([7.0, 2.0, 2.0])
    )[5] == pytest.approx(9.81, abs=1e-4)


@pytest.mark.parametrize("u", [(7.0, 1.0, 0.0), (7.0, 0.9, 0.9), (0.0, 0.0, 0.0)])
def test_the_derivative_exists_at_and_beyond_a_horizontal_thrust(u):
    x = casadi.SX.sym("x", 6)
    control = casadi.SX.sym("u", 3)
    jacobian = casadi.jacobian(
        casadi.vertcat(*System(Map(Translational()), 1.0).successor(x, control)),
        control,
    )
    assert np.isfinite(
        np.array(casadi.Function("J", [x, control], [jacobian])(np.zeros(6), u))
    ).all()


def test_the_exact_attitude_points_the_thrust_where_it_is_asked(rng):
    phi, theta = rng.uniform(-1.4, 1.4, size=(2, 100))
    ux = np.cos(phi) * np.sin(theta)
    uy = -np.sin(phi)
    assert np.allclose(
        attitude_for_thrust_direction(ux, uy), np.column_stack([phi, theta]), atol=1e-12
    )


def test_the_papers_attitude_has_its_slip_and_saturates():
    angles = attitude_for_thrust_direction(
        np.array([0.3, 0.3, 5.0]), np.array([0.2, -0.2, -4.0]), convention="paper"
    )
    assert np.allclose(angles[:, 0], [-np.arcsin(0.2), np.arcsin(0.2), np.pi / 2])
    assert np.allclose(angles[:, 1], [-np.arcsin(0.3), np.arcsin(0.3), np.pi / 2])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: Translational(mass=0),
            r"mass: must be a number above 0 \[kg\]; got 0",
        ),
        (
            lambda: Translational(frozen_attitude=(1.0,)),
            "frozen_attitude: must be a list of 2 numbers",
        ),
        (lambda: Rotational(inertia=(1, 1, -1)), "inertia: must be a number above 0"),
        (lambda: Rotational(arm=-1), "arm: must be a number above 0"),
        (
            lambda: Rotational(gyroscopic=(1,)),
            "gyroscopic: must be a list of 2 numbers",
        ),
        (
            lambda: System(Rotational(), time_step=0),
            "time_step: must be a number above 0",
        ),
        (
            lambda: System(Rotational(), 1.0, substeps=0),
            "substeps: must be a whole number, 1 or more; got 0",
        ),
        (
            lambda: attitude_for_thrust_direction(
                np.zeros(1), np.zeros(1), convention="papper"
            ),
            "'paper', 'exact'; got 'papper'",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(build, message):
    with pytest.raises(SettingError, match=message):
        build()
