"""Sources of transitions.

They are random inputs, our own flights, dithered flights, and the authors' files.
"""

from gpmpc.datasets._flights import (
    DataSource,
    Excitation,
    ExcitedData,
    NMPCData,
    PaperData,
    Tracking,
)
from gpmpc.datasets._random_data import RandomData

__all__ = [
    "DataSource",
    "Excitation",
    "ExcitedData",
    "NMPCData",
    "PaperData",
    "RandomData",
    "Tracking",
]
