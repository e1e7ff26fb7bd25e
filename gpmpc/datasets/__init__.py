"""Sources of transitions to learn from.

``RandomData`` steps a system under random inputs. ``ExcitedData`` flies the quadrotor
with dithered inputs, ``NMPCData`` flies it as in the paper's experiment, and
``PaperData`` reads the files that the paper's authors published.
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
