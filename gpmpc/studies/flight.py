"""Flies one trial of a system with a learned model, and measures it.

    data -> a random subset -> training -> controller -> closed loop -> metrics

``Experiment`` holds everything that the numbers follow from, as objects; files and
settings are not among them. ``run_trial`` flies it, ``metrics`` measures the flight as
plain data, and ``summary`` says the metrics in words.
"""

from gpmpc.studies._experiment import Experiment
from gpmpc.studies._metrics import metrics
from gpmpc.studies._outlook import Outlook
from gpmpc.studies._summary import summary
from gpmpc.studies._trial import Flown, run_trial

__all__ = ["Experiment", "Flown", "Outlook", "metrics", "run_trial", "summary"]
