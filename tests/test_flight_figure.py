"""The figure of a flight says what every line is, in which unit."""

from dataclasses import replace

import numpy as np
import pytest

from gpmpc.exceptions import ShapeError
from gpmpc.mpc import Timing
from gpmpc.plotting import flight_figure
from gpmpc.simulation import Rollout
from gpmpc.status import Status
from gpmpc.systems import System, cart_pole, pendulum

STEPS = 5


class Arm:
    state_names = ("shoulder", "elbow", "load")
    input_names = ("lift",)

    def derivative(self, x, u):
        return [u[0], -x[1], -x[2]]


def rollout(n, m, statuses=(Status.SOLVED,) * STEPS):
    """Returns a flight of n states and m inputs that climb."""
    climb = np.linspace(0.0, 1.0, STEPS + 1)[:, None]
    return Rollout(
        states=climb * np.arange(1, n + 1),
        covariances=np.zeros((STEPS + 1, n, n)),
        measured=np.zeros((STEPS, n)),
        inputs=climb[:-1] * np.ones(m),
        references=np.ones((STEPS + 1, n)),
        predicted_means=np.zeros((STEPS, n)),
        predicted_covariances=np.zeros((STEPS, n, n)),
        statuses=statuses,
        iterations=np.ones(STEPS),
        timings=(Timing(),) * STEPS,
        time_step=0.1,
    )


def labels(figure):
    return [axis.get_ylabel() for axis in figure.axes]


def test_each_unit_has_a_panel_and_every_axis_a_name():
    figure = flight_figure(rollout(4, 1), cart_pole())
    assert labels(figure) == [
        "position [m]",
        "velocity [m/s]",
        "angle [rad]",
        "rate [rad/s]",
        "force [N]",
    ]
    assert figure.axes[-1].get_xlabel() == "time [s]"


def test_signals_of_one_unit_share_a_panel_with_a_legend():
    units = {"shoulder": "rad", "elbow": "rad"}
    figure = flight_figure(rollout(3, 1), System(Arm(), 0.1, units=units))
    assert labels(figure) == ["[rad]", "load", "lift"]
    names = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert names == ["shoulder", "elbow"]
    assert figure.axes[0].get_legend().get_lines()[1].get_color() != (
        figure.axes[0].get_legend().get_lines()[0].get_color()
    )


class Chain:
    state_names = tuple(f"m{i}" for i in range(10))
    input_names = ("lift",)

    def derivative(self, x, u):
        return [-value for value in x]


def test_each_of_many_lines_of_one_unit_has_its_name_and_look():
    system = System(Chain(), 0.1, units=dict.fromkeys(Chain.state_names, "rad"))
    axis, *_ = flight_figure(rollout(10, 1), system).axes
    legend = axis.get_legend()
    assert [text.get_text() for text in legend.get_texts()] == [*Chain.state_names]
    states = [line for line in axis.lines if not line.get_label().startswith("ref")]
    assert [line.get_ydata()[-1] for line in states] == [*range(1, 11)]
    looks = [(line.get_color(), line.get_linestyle()) for line in legend.get_lines()]
    assert looks == [(line.get_color(), line.get_linestyle()) for line in states]
    assert len({*looks}) == 10
    references = [line for line in axis.lines if line not in states]
    assert references
    assert not {line.get_color() for line in references} & {look[0] for look in looks}


def test_an_input_holds_until_its_step_ends_between_its_bounds():
    figure = flight_figure(rollout(2, 1), pendulum())
    applied, *bounds = figure.axes[-1].lines
    assert applied.get_xdata()[-1] == pytest.approx(0.5)
    assert applied.get_ydata()[-1] == applied.get_ydata()[-2]
    assert sorted(line.get_ydata()[0] for line in bounds) == [-2.0, 2.0]


def test_steps_that_the_policy_decided_are_marked():
    statuses = (Status.SOLVED, Status.INFEASIBLE, *[Status.SOLVED] * 3)
    figure = flight_figure(rollout(2, 1, statuses), pendulum())
    marks = [line for line in figure.axes[0].lines if "failed" in line.get_label()]
    assert [line.get_xdata()[0] for line in marks] == [pytest.approx(0.1)]


def test_an_angle_a_turn_from_its_goal_is_on_it():
    flight = rollout(2, 1)
    flight = replace(flight, references=flight.states + 2 * np.pi)
    reference, flown = flight_figure(flight, pendulum()).axes[0].lines
    assert reference.get_ydata() == pytest.approx(flown.get_ydata())


def test_names_of_a_vehicle_are_those_of_its_pose_alone():
    class Motor(Arm):
        state_names = ("theta", "psi", "z")
        input_names = ("U1",)

    kinds = {"theta": "rad", "psi": "Wb", "z": "m", "U1": "V"}
    figure = flight_figure(rollout(3, 1), System(Motor(), 0.1, units=kinds))
    assert labels(figure) == ["theta [rad]", "psi [Wb]", "z [m]", "U1 [V]"]
    flying = System(
        Motor(), 0.1, units=kinds, pose={"pitch": "theta", "z": "z"}, z_down=True
    )
    figure = flight_figure(rollout(3, 1), flying)
    said = ["pitch [rad]", "psi [Wb]", "z, downwards [m]", "thrust U1 [V]"]
    assert labels(figure) == said


def test_a_flight_of_another_system_is_refused():
    with pytest.raises(ShapeError, match="has 4 states and 1 inputs; the flight has 2"):
        flight_figure(rollout(2, 1), cart_pole())
