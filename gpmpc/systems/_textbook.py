"""Systems of textbooks: double integrator, pendulums, cart-pole, planar quadrotor and a stirred-tank reactor.

Angles are zero where a pole or a link stands upright, positive anticlockwise. Each function makes a system with a time
step [s]; its other arguments are the attributes of the right-hand side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from typing import Any, Literal

from gpmpc.exceptions import check_choice, check_number
from gpmpc.systems._system import GRAVITY, System, cos, exp, sin


class _Body:
    """Checks that every number is positive, or none below zero where its name stands in ``may_be_zero``."""

    may_be_zero: tuple[str, ...] = ()
    words: tuple[str, ...] = ()  # attributes that are no numbers

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            limits: dict[str, Any] = {
                "least" if key in self.may_be_zero else "above": 0
            }
            numbers = value if isinstance(value, tuple | list) else [value]
            for number in () if key in self.words else numbers:
                check_number(key, number, **limits)


@dataclass(frozen=True)
class DoubleIntegrator(_Body):
    """A mass on a line that a force accelerates."""

    mass: float = 1.0  #: [kg]

    state_names = ("position", "velocity")
    input_names = ("force",)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (position, velocity) [m/s, m/s^2]."""
        return [x[1], u[0] / self.mass]


def double_integrator(time_step: float = 0.1, **parameters: float) -> System:
    """Makes a mass on a line."""
    return System(
        DoubleIntegrator(**parameters),
        time_step,
        1,
        name="double_integrator",
        units={"position": "m", "velocity": "m/s", "force": "N"},
        input_lower=[-1.0],
        input_upper=[1.0],
        start=[1.0, 0.0],
        rates={"velocity": "position"},
        region=[[-2.0, -1.0], [2.0, 1.0]],
        lost=10.0,
    )


@dataclass(frozen=True)
class Pendulum(_Body):
    """A uniform rod on a driven joint; its torque is too weak to lift it at once."""

    mass: float = 1.0  #: [kg]
    length: float = 1.0  #: [m]
    damping: float = 0.05  #: of the joint [N m s]

    state_names = ("angle", "rate")
    input_names = ("torque",)
    may_be_zero = ("damping",)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (angle, rate) [rad/s, rad/s^2]."""
        torque = (
            self.mass * GRAVITY * self.length / 2 * sin(x[0])
            - self.damping * x[1]
            + u[0]
        )
        return [x[1], torque / (self.mass * self.length**2 / 3)]


def pendulum(time_step: float = 0.05, **parameters: float) -> System:
    """Makes a pendulum that hangs at first."""
    return System(
        Pendulum(**parameters),
        time_step,
        2,
        name="pendulum",
        units={"angle": "rad", "rate": "rad/s", "torque": "N m"},
        input_lower=[-2.0],
        input_upper=[2.0],
        start=[pi, 0.0],
        region=[
            [-2.0, -8.0],
            [2 * pi + 2, 8.0],
        ],  # around the whole circle, hanging in the middle
        angles=["angle"],
        rates={"rate": "angle"},
    )


@dataclass(frozen=True)
class CartPole(_Body):
    """A pole hinged to a cart on a line (Barto, Sutton and Anderson, 1983, without friction)."""

    cart_mass: float = 1.0  #: [kg]
    pole_mass: float = 0.1  #: of the uniform pole [kg]
    half_length: float = 0.5  #: from the hinge to the pole's centre of mass [m]

    state_names = ("position", "velocity", "angle", "rate")
    input_names = ("force",)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (position, velocity, angle, rate) [m/s, m/s^2, rad/s, rad/s^2]."""
        total = self.cart_mass + self.pole_mass
        moment = self.pole_mass * self.half_length
        s = sin(x[2])
        c = cos(x[2])
        push = (u[0] + moment * x[3] * x[3] * s) / total
        turn = (GRAVITY * s - c * push) / (
            self.half_length * (4 / 3 - self.pole_mass * c * c / total)
        )
        return [x[1], push - moment * turn * c / total, x[3], turn]


def cart_pole(time_step: float = 0.05, **parameters: float) -> System:
    """Makes a cart-pole whose pole hangs at first; its angle is positive towards growing positions."""
    return System(
        CartPole(**parameters),
        time_step,
        2,
        name="cart_pole",
        units={
            "position": "m",
            "velocity": "m/s",
            "angle": "rad",
            "rate": "rad/s",
            "force": "N",
        },
        input_lower=[-10.0],
        input_upper=[10.0],
        start=[0.0, 0.0, pi, 0.0],
        region=[[-2.0, -3.0, -2.0, -8.0], [2.0, 3.0, 2 * pi + 2, 8.0]],
        angles=["angle"],
        rates={"velocity": "position"},
        lost=10.0,
    )


@dataclass(frozen=True)
class DoublePendulum(_Body):
    """Two links in a vertical plane with a torque at one joint (Spong, 1995, eqs. (1)-(2)).

    ``shoulder`` is the angle of the first link from upright, ``elbow`` that of the second from the first. The numbers
    are those identified for design C.1, model 1.1 of the RealAIGym league (Wiebe et al., 2024; inertias were published
    about the joints, 0.031887 and 0.050870), whose second link is 0.3 m long; there is no friction.
    """

    masses: Sequence[float] = (0.5234602302, 0.6255677234)  #: of the links [kg]
    first_length: float = 0.2  #: of the first link [m]
    centres: Sequence[float] = (
        0.2,
        0.2556930544,
    )  #: from each link's joint to its centre of mass [m]
    inertias: Sequence[float] = (
        0.0109487904,
        0.0099708947,
    )  #: of the links about their centres of mass [kg m^2]
    actuated: Literal["elbow", "shoulder"] = "elbow"  #: an acrobot, or a pendubot

    state_names = ("shoulder", "shoulder_rate", "elbow", "elbow_rate")
    input_names = ("torque",)
    words = ("actuated",)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("actuated", self.actuated, ("elbow", "shoulder"))

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (shoulder, shoulder_rate, elbow, elbow_rate) [rad/s, rad/s^2]."""
        (m1, m2), (c1, c2), (i1, i2), l1 = (
            self.masses,
            self.centres,
            self.inertias,
            self.first_length,
        )
        a = x[0]
        da = x[1]
        b = x[2]
        db = x[3]
        # D (dda, ddb) + h + phi = torques
        coupling = m2 * l1 * c2
        d11 = m1 * c1**2 + m2 * (l1**2 + c2**2) + 2 * coupling * cos(b) + i1 + i2
        d12 = m2 * c2**2 + coupling * cos(b) + i2
        d22 = m2 * c2**2 + i2
        fall = -m2 * c2 * GRAVITY * sin(a + b)
        r1 = (
            coupling * sin(b) * (2 * da * db + db * db)
            + (m1 * c1 + m2 * l1) * GRAVITY * sin(a)
            - fall
        )
        r2 = -coupling * sin(b) * da * da - fall
        r1, r2 = (r1, r2 + u[0]) if self.actuated == "elbow" else (r1 + u[0], r2)
        determinant = d11 * d22 - d12 * d12
        return [
            da,
            (d22 * r1 - d12 * r2) / determinant,
            db,
            (d11 * r2 - d12 * r1) / determinant,
        ]


def acrobot(
    masses: Sequence[float] = (1.0, 1.0),
    first_length: float = 1.0,
    time_step: float = 0.05,
    torque: float = 10.0,
) -> System:
    """Makes an acrobot that hangs at first (Spong, 1995, and its table); ``torque`` is its largest [N m]."""
    links = DoublePendulum(masses, first_length, (0.5, 1.0), (0.083, 0.33))
    return _two_links("acrobot", links, time_step, 10, torque, (4.0, 6.0))


def double_pendulum(
    actuated: Literal["elbow", "shoulder"] = "elbow",
    time_step: float = 0.02,
    torque: float = 6.0,
    **parameters: Any,
) -> System:
    """Makes the double pendulum of the RealAIGym league, which hangs at first; ``torque`` is its largest [N m]."""
    links = DoublePendulum(actuated=actuated, **parameters)
    return _two_links("double_pendulum", links, time_step, 2, torque, (20.0, 30.0))


def _two_links(
    name: str,
    links: DoublePendulum,
    time_step: float,
    substeps: int,
    torque: float,
    rates: tuple[float, float],
) -> System:
    return System(
        links,
        time_step,
        substeps,
        name=name,
        units=dict(
            zip(
                (*links.state_names, "torque"),
                ("rad", "rad/s", "rad", "rad/s", "N m"),
                strict=True,
            )
        ),
        input_lower=[-torque],
        input_upper=[torque],
        start=[pi, 0.0, 0.0, 0.0],
        region=[[0.0, -rates[0], -pi, -rates[1]], [2 * pi, rates[0], pi, rates[1]]],
        angles=["shoulder", "elbow"],
        rates={"shoulder_rate": "shoulder", "elbow_rate": "elbow"},
    )


@dataclass(frozen=True)
class PlanarQuadrotor(_Body):
    """A bar with a rotor at each end, in a vertical plane; y points upwards."""

    mass: float = 0.74  #: [kg]
    arm: float = 0.21  #: from the centre to a rotor [m]
    inertia: float = 0.005  #: [kg m^2]

    state_names = ("x", "vx", "y", "vy", "tilt", "tilt_rate")
    input_names = ("right", "left")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (x, vx, y, vy, tilt, tilt_rate) [m/s, m/s^2, rad/s, rad/s^2]."""
        lift = (u[0] + u[1]) / self.mass
        turn = self.arm * (u[0] - u[1]) / self.inertia
        return [x[1], -lift * sin(x[4]), x[3], lift * cos(x[4]) - GRAVITY, x[5], turn]


def planar_quadrotor(time_step: float = 0.05, **parameters: float) -> System:
    """Makes a planar quadrotor."""
    vehicle = PlanarQuadrotor(**parameters)
    weight = vehicle.mass * GRAVITY
    return System(
        vehicle,
        time_step,
        2,
        name="planar_quadrotor",
        units={
            "x": "m",
            "y": "m",
            "tilt": "rad",
            "vx": "m/s",
            "vy": "m/s",
            "tilt_rate": "rad/s",
        }
        | {"right": "N", "left": "N"},
        input_lower=[0.0, 0.0],
        input_upper=[weight, weight],  # of each rotor: twice the weight together
        initial_input=[weight / 2, weight / 2],
        start=[1.0, 0.0, -1.0, 0.0, 0.0, 0.0],
        region=[[-2.0, -2.0, -2.0, -2.0, -0.8, -3.0], [2.0, 2.0, 2.0, 2.0, 0.8, 3.0]],
        angles=["tilt"],
        rates={"vx": "x", "vy": "y"},
        pose={"x": "x", "z": "y"},
        lost=10.0,
    )


@dataclass(frozen=True)
class StirredTank(_Body):
    """A continuous stirred-tank reactor with an exothermic reaction A -> B at first order, steered by its coolant.

    The reactor of Henson and Seborg (1997, Nonlinear Process Control, chapter 1). Its operating point, 0.5 mol/L at
    350 K and 300 K of the coolant, is unstable. Times are in seconds here, in minutes there.
    """

    flow: float = 100.0  #: of the feed [L/min]
    volume: float = 100.0  #: of the tank [L]
    feed_concentration: float = 1.0  #: of A [mol/L]
    feed_temperature: float = 350.0  #: [K]
    rate: float = 7.2e10  #: k0 of the reaction [1/min]
    activation: float = 8750.0  #: E / R [K]
    heat: float = 5.0e4  #: -dH, of the reaction [J/mol]
    capacity: float = 239.0  #: rho Cp, of the fluid [J/(L K)]
    transfer: float = 5.0e4  #: U A, to the coolant [J/(min K)]

    state_names = ("concentration", "temperature")
    input_names = ("coolant",)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (concentration, temperature) [mol/(L s), K/s]."""
        # per minute
        exchange = self.flow / self.volume
        reaction = self.rate * exp(-self.activation / x[1]) * x[0]
        cooling = self.transfer / (self.volume * self.capacity) * (u[0] - x[1])
        warming = (
            exchange * (self.feed_temperature - x[1])
            + self.heat / self.capacity * reaction
            + cooling
        )
        return [
            (exchange * (self.feed_concentration - x[0]) - reaction) / 60,
            warming / 60,
        ]


def stirred_tank(time_step: float = 3.0, **parameters: float) -> System:
    """Makes the reactor, which is to leave its stable point of low conversion for the unstable one."""
    return System(
        StirredTank(**parameters),
        time_step,
        20,  # a runaway reaction is stiff
        name="stirred_tank",
        units={"concentration": "mol/L", "temperature": "K", "coolant": "K"},
        input_lower=[280.0],
        input_upper=[320.0],
        initial_input=[300.0],
        start=[0.8772, 324.5],
        goal=[0.5, 350.0],
        region=[[0.2, 320.0], [0.95, 370.0]],
        tracked=["temperature"],
    )
