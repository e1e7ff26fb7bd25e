import casadi
import numpy as np
import pytest

from gpmpc.exceptions import SettingError
from gpmpc.systems import (
    GRAVITY,
    Coupled,
    Rotational,
    System,
    Translational,
    attitude_for_thrust_direction,
    step,
)

QUARTER = np.pi / 4


def thrust_direction(phi, theta, psi):
    """Where the thrust pulls: the acceleration of a unit mass by a unit thrust."""
    x = np.zeros((12, *np.shape(phi)))
    x[[6, 8, 10]] = phi, theta, psi
    rates = Coupled(mass=1.0).derivative(x, [1.0, 0.0, 0.0, 0.0])
    return rates[1], rates[3], GRAVITY - rates[5]


def test_the_names_are_those_of_the_subsystems():
    assert Coupled.state_names == Translational.state_names + Rotational.state_names
    assert Coupled.input_names == ("U1", "U2", "U3", "U4")


def test_the_attitude_turns_as_the_rotational_subsystem_does(rng):
    rotational = Rotational(inertia=(0.004, 0.005, 0.009))
    x = rng.normal(size=12)
    u = rng.normal(size=4)
    assert Coupled(rotational=rotational).derivative(x, u)[6:] == rotational.derivative(
        x[6:], u[1:]
    )
    whole = System(Coupled(rotational=rotational), time_step=0.05)
    part = System(rotational, time_step=0.05)
    assert np.allclose(step(whole, x, u)[6:], step(part, x[6:], u[1:]), rtol=1e-13)


@pytest.mark.parametrize("mass", [0.74, 1.1])
def test_a_held_attitude_moves_as_the_translational_subsystem(mass, rng):
    for _ in range(20):
        phi, theta, U1 = *rng.uniform(-1.2, 1.2, size=2), rng.uniform(1, 20)
        ux = np.cos(phi) * np.sin(theta)
        uy = -np.sin(phi)
        angles = attitude_for_thrust_direction(np.array(ux), np.array(uy))
        position = rng.normal(size=6)
        x = np.concatenate([position, [angles[0], 0, angles[1], 0, 0, 0]])
        next_state = step(
            System(Coupled(mass=mass), time_step=0.7), x, np.array([U1, 0, 0, 0])
        )
        expected = step(
            System(Translational(mass=mass), time_step=0.7),
            position,
            np.array([U1, ux, uy]),
        )
        assert np.allclose(next_state[:6], expected, atol=1e-9)


def test_the_papers_frozen_attitude_is_this_plant_held_there(rng):
    x = np.zeros(12)
    U1 = 9.0
    x[:6] = rng.normal(size=6)
    x[[6, 8]] = QUARTER
    ux, uy, _ = thrust_direction(QUARTER, QUARTER, 0.0)
    frozen = Translational(frozen_attitude=(QUARTER, QUARTER))
    assert np.allclose(
        Coupled().derivative(x, [U1, 0, 0, 0])[:6],
        frozen.derivative(x, [U1, ux, uy]),
        atol=1e-12,
    )
    assert (ux, uy) == pytest.approx((0.5, -np.sqrt(0.5)))


def test_level_it_hovers_at_its_weight():
    weight = [0.74 * 9.81, 0, 0, 0]
    assert np.allclose(Coupled().derivative(np.zeros(12), weight), 0, atol=1e-15)


def test_the_thrust_direction_is_a_unit_vector_and_yaw_turns_it(rng):
    for phi, theta, psi in rng.uniform(-1.5, 1.5, size=(20, 3)):
        ux, uy, up = thrust_direction(phi, theta, psi)
        assert ux**2 + uy**2 + up**2 == pytest.approx(1)
        level_x, level_y, level_up = thrust_direction(phi, theta, 0.0)
        assert ux == pytest.approx(np.cos(psi) * level_x - np.sin(psi) * level_y)
        assert uy == pytest.approx(np.sin(psi) * level_x + np.cos(psi) * level_y)
        assert up == level_up


def test_the_attitude_for_a_direction_is_found_at_any_yaw(rng):
    phi, theta, psi = rng.uniform(-1.4, 1.4, size=(3, 50))
    ux, uy, _ = thrust_direction(phi, theta, psi)
    assert np.allclose(
        attitude_for_thrust_direction(ux, uy, psi),
        np.column_stack([phi, theta]),
        atol=1e-11,
    )


def test_floats_numpy_and_casadi_pass_through_the_same_formula(rng):
    plant = System(Coupled(), time_step=0.05, substeps=2)
    x = casadi.SX.sym("x", 12)
    u = casadi.SX.sym("u", 4)
    symbolic = casadi.Function("f", [x, u], [casadi.vertcat(*plant.successor(x, u))])
    state = rng.normal(size=12)
    control = rng.normal(size=4)
    assert np.allclose(
        np.array(symbolic(state, control)).ravel(),
        step(plant, state, control),
        rtol=1e-12,
    )
    assert np.allclose(
        plant.successor(state.tolist(), control.tolist()),
        step(plant, state, control),
        rtol=1e-14,
    )


def test_misuse_is_refused_with_the_rule():
    with pytest.raises(
        SettingError, match=r"mass: must be a number above 0 \[kg\]; got -1"
    ):
        Coupled(mass=-1)
