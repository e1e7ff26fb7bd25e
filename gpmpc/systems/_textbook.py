"""Systems of textbooks, from the double integrator to a stirred-tank reactor.

Angles are zero where a pole or a link stands upright, positive anticlockwise; but that
of ``cart_pole`` is positive towards growing positions. Each function makes a system
with a time step [s]; its other arguments are the attributes of the right-hand side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from typing import Any, Literal

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import check_choice, check_number
from gpmpc.systems._elementary import cos, exp, sin
from gpmpc.systems._system import GRAVITY, System


class _Body:
    """Checks that every number is positive; those in ``may_be_zero`` may be zero."""

    may_be_zero: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()  # attributes that are no numbers

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            if key in self.choices:
                continue
            numbers = value if isinstance(value, tuple | list) else [value]
            for number in numbers:
                if key in self.may_be_zero:
                    check_number(key, number, least=0)
                else:
                    check_number(key, number, above=0)


@explains_arguments
@dataclass(frozen=True)
class DoubleIntegrator(_Body):
    """A mass on a line that a force accelerates."""

    mass: float = 1.0  #: [kg]

    state_names = ("position", "velocity")
    input_names = ("force",)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (position, velocity) [m/s, m/s^2]."""
        velocity = x[1]
        force = u[0]
        return [velocity, force / self.mass]


def double_integrator(time_step: float = 0.1, **parameters: float) -> System:
    """Makes a mass on a line.

    >>> double_integrator(mass=2.0).state_names
    ('position', 'velocity')

    See Also:
        ``System`` for one's own.
    """
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


@explains_arguments
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
        angle = x[0]
        rate = x[1]
        inertia = self.mass * self.length**2 / 3
        weight = self.mass * GRAVITY * self.length / 2 * sin(angle)
        friction = self.damping * rate
        torque = weight - friction + u[0]
        return [rate, torque / inertia]


def pendulum(time_step: float = 0.05, **parameters: float) -> System:
    """Makes a pendulum that hangs at first.

    >>> pendulum(mass=1.2).state_names
    ('angle', 'rate')

    See Also:
        ``System`` for one's own; ``cart_pole``; ``acrobot``.
    """
    return System(
        Pendulum(**parameters),
        time_step,
        2,
        name="pendulum",
        units={"angle": "rad", "rate": "rad/s", "torque": "N m"},
        input_lower=[-2.0],
        input_upper=[2.0],
        start=[pi, 0.0],
        # around the whole circle, hanging in the middle
        region=[[-2.0, -8.0], [2 * pi + 2, 8.0]],
        angles=["angle"],
        rates={"rate": "angle"},
    )


@explains_arguments
@dataclass(frozen=True)
class CartPole(_Body):
    """A pole hinged to a cart on a line (Barto, Sutton and Anderson, 1983).

    There is no friction.
    """

    cart_mass: float = 1.0  #: [kg]
    pole_mass: float = 0.1  #: of the uniform pole [kg]
    half_length: float = 0.5  #: from the hinge to the pole's centre of mass [m]

    state_names = ("position", "velocity", "angle", "rate")
    input_names = ("force",)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (position, velocity, angle, rate) [m/s, m/s^2, rad/s, rad/s^2]."""
        velocity = x[1]
        rate = x[3]
        s = sin(x[2])
        c = cos(x[2])
        m = self.pole_mass
        length = self.half_length
        total = self.cart_mass + m
        push = (u[0] + m * length * rate * rate * s) / total
        rate_dot = (GRAVITY * s - c * push) / (length * (4 / 3 - m * c * c / total))
        velocity_dot = push - m * length * rate_dot * c / total
        return [velocity, velocity_dot, rate, rate_dot]


def cart_pole(time_step: float = 0.05, **parameters: float) -> System:
    """Makes a cart-pole whose pole hangs at first.

    Its angle is positive towards growing positions.

    >>> cart_pole().angles
    ('angle',)

    See Also:
        ``System`` for one's own; ``pendulum``.
    """
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
        rates={"velocity": "position", "rate": "angle"},
        # the pole first: a cart at rest under a hanging pole has achieved nothing
        tracked=["angle", "position"],
        lost={"m": 10.0},
    )


@explains_arguments
@dataclass(frozen=True)
class DoublePendulum(_Body):
    """Two links in a vertical plane with a torque at one joint.

    The equations are (1) and (2) of Spong (1995).

    ``shoulder`` is the angle of the first link from upright, ``elbow`` that of the
    second from the first. The numbers are those identified for design C.1, model 1.1 of
    the RealAIGym league (Wiebe et al., 2024; inertias were published about the joints,
    0.031887 and 0.050870), whose second link is 0.3 m long; there is no friction.
    """

    masses: Sequence[float] = (0.5234602302, 0.6255677234)  #: of the links [kg]
    first_length: float = 0.2  #: of the first link [m]
    #: from each link's joint to its centre of mass [m]
    centres: Sequence[float] = (0.2, 0.2556930544)
    #: of the links about their centres of mass [kg m^2]
    inertias: Sequence[float] = (0.0109487904, 0.0099708947)
    #: an acrobot, or a pendubot
    actuated: Literal["elbow", "shoulder"] = "elbow"

    state_names = ("shoulder", "shoulder_rate", "elbow", "elbow_rate")
    input_names = ("torque",)
    choices = ("actuated",)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("actuated", self.actuated, ("elbow", "shoulder"))

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (shoulder, shoulder_rate, elbow, elbow_rate) [rad/s, rad/s^2]."""
        a, a_dot, b, b_dot = x[0], x[1], x[2], x[3]
        m1, m2 = self.masses
        c1, c2 = self.centres
        i1, i2 = self.inertias
        l1 = self.first_length
        # D (a_ddot, b_ddot) = r: the torques less those of speeds and of weights
        coupling = m2 * l1 * c2
        d11 = m1 * c1**2 + m2 * (l1**2 + c2**2) + 2 * coupling * cos(b) + i1 + i2
        d12 = m2 * c2**2 + coupling * cos(b) + i2
        d22 = m2 * c2**2 + i2
        weight1 = (m1 * c1 + m2 * l1) * GRAVITY * sin(a)
        weight2 = -m2 * c2 * GRAVITY * sin(a + b)
        speeds1 = coupling * sin(b) * (2 * a_dot * b_dot + b_dot * b_dot)
        speeds2 = -coupling * sin(b) * a_dot * a_dot
        r1 = speeds1 + weight1 - weight2
        r2 = speeds2 - weight2
        if self.actuated == "elbow":
            r2 = r2 + u[0]
        else:
            r1 = r1 + u[0]
        determinant = d11 * d22 - d12 * d12
        a_ddot = (d22 * r1 - d12 * r2) / determinant
        b_ddot = (d11 * r2 - d12 * r1) / determinant
        return [a_dot, a_ddot, b_dot, b_ddot]


@explains_arguments
def acrobot(
    masses: Sequence[float] = (1.0, 1.0),
    first_length: float = 1.0,
    time_step: float = 0.05,
    torque: float = 10.0,
) -> System:
    """Makes an acrobot that hangs at first (Spong, 1995, and its table).

    ``torque`` is its largest [N m].

    >>> acrobot(torque=8.0).input_upper
    (8.0,)

    See Also:
        ``double_pendulum``, with the numbers of a real one.
    """
    links = DoublePendulum(
        masses, first_length, centres=(0.5, 1.0), inertias=(0.083, 0.33)
    )
    return _two_links(
        "acrobot", links, time_step, substeps=10, torque=torque, rates=(4.0, 6.0)
    )


def double_pendulum(
    actuated: Literal["elbow", "shoulder"] = "elbow",
    time_step: float = 0.02,
    torque: float = 6.0,
    **parameters: Any,
) -> System:
    """Makes the double pendulum of the RealAIGym league, which hangs at first.

    ``torque`` is its largest [N m].

    >>> double_pendulum().input_names
    ('torque',)

    See Also:
        ``acrobot``.
    """
    links = DoublePendulum(actuated=actuated, **parameters)
    return _two_links(
        "double_pendulum",
        links,
        time_step,
        substeps=2,
        torque=torque,
        rates=(20.0, 30.0),
    )


def _two_links(
    name: str,
    links: DoublePendulum,
    time_step: float,
    substeps: int,
    torque: float,
    rates: tuple[float, float],
) -> System:
    """Makes a system of two links; random data start up to ``rates`` [rad/s]."""
    return System(
        links,
        time_step,
        substeps,
        name=name,
        units={
            "shoulder": "rad",
            "shoulder_rate": "rad/s",
            "elbow": "rad",
            "elbow_rate": "rad/s",
            "torque": "N m",
        },
        input_lower=[-torque],
        input_upper=[torque],
        start=[pi, 0.0, 0.0, 0.0],
        region=[[0.0, -rates[0], -pi, -rates[1]], [2 * pi, rates[0], pi, rates[1]]],
        angles=["shoulder", "elbow"],
        rates={"shoulder_rate": "shoulder", "elbow_rate": "elbow"},
    )


@explains_arguments
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
        vx, vy, tilt, tilt_rate = x[1], x[3], x[4], x[5]
        thrust_right = u[0]
        thrust_left = u[1]
        lift = (thrust_right + thrust_left) / self.mass
        vx_dot = -lift * sin(tilt)
        vy_dot = lift * cos(tilt) - GRAVITY
        tilt_rate_dot = self.arm * (thrust_right - thrust_left) / self.inertia
        return [vx, vx_dot, vy, vy_dot, tilt_rate, tilt_rate_dot]


def planar_quadrotor(time_step: float = 0.05, **parameters: float) -> System:
    """Makes a planar quadrotor.

    >>> planar_quadrotor().input_names
    ('right', 'left')

    See Also:
        ``translational`` and ``rotational``, of a whole quadrotor.
    """
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
            "right": "N",
            "left": "N",
        },
        input_lower=[0.0, 0.0],
        input_upper=[weight, weight],  # of each rotor: twice the weight together
        initial_input=[weight / 2, weight / 2],
        start=[1.0, 0.0, -1.0, 0.0, 0.0, 0.0],
        region=[[-2.0, -2.0, -2.0, -2.0, -0.8, -3.0], [2.0, 2.0, 2.0, 2.0, 0.8, 3.0]],
        angles=["tilt"],
        rates={"vx": "x", "vy": "y", "tilt_rate": "tilt"},
        pose={"x": "x", "z": "y"},
        lost=10.0,
    )


@explains_arguments
@dataclass(frozen=True)
class StirredTank(_Body):
    """A stirred tank with an exothermic reaction A -> B, steered by its coolant.

    The reactor of Henson and Seborg (1997, Nonlinear Process Control, chapter 1). Its
    operating point, 0.5 mol/L at 350 K and 300 K of the coolant, is unstable. Times are
    in seconds here, in minutes there.
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
        concentration, temperature, coolant = x[0], x[1], u[0]
        # per minute
        exchange = self.flow / self.volume
        reaction = self.rate * exp(-self.activation / temperature) * concentration
        feeding = exchange * (self.feed_concentration - concentration)
        feed_heating = exchange * (self.feed_temperature - temperature)
        reaction_heating = self.heat / self.capacity * reaction
        transfer = self.transfer / (self.volume * self.capacity)
        coolant_heating = transfer * (coolant - temperature)
        heating = feed_heating + reaction_heating + coolant_heating
        return [(feeding - reaction) / 60, heating / 60]


def stirred_tank(time_step: float = 3.0, **parameters: float) -> System:
    """Makes the reactor, which starts at its stable point of low conversion.

    Its goal is the unstable point.

    >>> stirred_tank().unit
    'K'

    See Also:
        ``System`` for one's own.
    """
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
