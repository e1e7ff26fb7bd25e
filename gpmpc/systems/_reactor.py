"""A continuous stirred-tank reactor with an exothermic reaction, steered by the temperature of its coolant."""

from dataclasses import dataclass
from typing import Any

from gpmpc.exceptions import check_number
from gpmpc.systems.system import System, exp


@dataclass(frozen=True)
class StirredTank:
    """The reactor of Henson and Seborg (1997, Nonlinear Process Control, chapter 1): A -> B at first order.

    Its operating point, 0.5 mol/L at 350 K and 300 K of the coolant, is unstable. Times are in seconds here, in minutes
    there.
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

    state_names, input_names = ("concentration", "temperature"), ("coolant",)

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            check_number(key, value, above=0)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (concentration, temperature) [mol/(L s), K/s]."""
        exchange, reaction = self.flow / self.volume, self.rate * exp(-self.activation / x[1]) * x[0]  # per minute
        cooling = self.transfer / (self.volume * self.capacity) * (u[0] - x[1])
        warming = exchange * (self.feed_temperature - x[1]) + self.heat / self.capacity * reaction + cooling
        return [(exchange * (self.feed_concentration - x[0]) - reaction) / 60, warming / 60]


def stirred_tank(time_step: float = 3.0, **parameters: float) -> System:
    """Makes the reactor, which is to leave its stable point of low conversion for the unstable one.

    Args:
        time_step: [s].
        parameters: Attributes of ``StirredTank``.
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
