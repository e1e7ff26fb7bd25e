"""Estimation of what is not measured: states, disturbances, delays, noise; and how far predictions can be believed."""

from gpmpc.estimation.consistency import Consistency, autocorrelation, estimation_errors, normalized_errors
from gpmpc.estimation.kalman import FilterRun, KalmanFilter, LateMeasurements, Update, smooth
from gpmpc.estimation.measurement import Measurement

__all__ = [
    "Consistency",
    "FilterRun",
    "KalmanFilter",
    "LateMeasurements",
    "Measurement",
    "Update",
    "autocorrelation",
    "estimation_errors",
    "normalized_errors",
    "smooth",
]
