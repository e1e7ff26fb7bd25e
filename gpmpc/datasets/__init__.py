"""Where transitions come from: random inputs, flights of our own, dithered flights, the authors' files."""

from gpmpc.datasets._flights import (
    SUBSYSTEMS,
    DataSource,
    Excitation,
    ExcitedData,
    NMPCData,
    PaperData,
    Tracking,
)
from gpmpc.datasets._random_data import RandomData

__all__ = [
    "SUBSYSTEMS",
    "DataSource",
    "Excitation",
    "ExcitedData",
    "NMPCData",
    "PaperData",
    "RandomData",
    "Tracking",
]
