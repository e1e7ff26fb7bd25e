"""Where the transitions of an experiment come from: flights of our own, dithered flights, the authors' files."""

from gpmpc.datasets.attitudes import rotational_states_along
from gpmpc.datasets.excitation import Excitation, ExcitedData
from gpmpc.datasets.flights import SUBSYSTEMS, DataSource, NMPCData, PaperData, Subsystem, Tracking

__all__ = [
    "SUBSYSTEMS",
    "DataSource",
    "Excitation",
    "ExcitedData",
    "NMPCData",
    "PaperData",
    "Subsystem",
    "Tracking",
    "rotational_states_along",
]
