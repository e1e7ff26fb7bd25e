"""Estimates what is not measured: states, disturbances, delays and noise.

``KalmanFilter`` filters with any model and propagator, and ``smooth`` smooths a log.
``estimate_delay``, ``estimate_process_noise``, ``estimate_varying_noise`` and
``separate_noise`` find in a log what a model has to know. ``ConformalTube`` and
``AdaptiveTube`` say how far predictions can be believed.
"""

from gpmpc.estimation._conformal import AdaptiveTube, ConformalTube
from gpmpc.estimation._consistency import (
    Consistency,
    autocorrelation,
    estimation_errors,
    normalized_errors,
)
from gpmpc.estimation._delay import DelayEstimate, estimate_delay
from gpmpc.estimation._kalman import (
    FilterRun,
    KalmanFilter,
    LateMeasurements,
    Measurement,
    Update,
    smooth,
)
from gpmpc.estimation._noise import (
    ProcessNoise,
    VaryingNoise,
    estimate_process_noise,
    estimate_varying_noise,
    with_process_noise,
)
from gpmpc.estimation._separation import SeparatedNoise, separate_noise

__all__ = [
    "AdaptiveTube",
    "ConformalTube",
    "Consistency",
    "DelayEstimate",
    "FilterRun",
    "KalmanFilter",
    "LateMeasurements",
    "Measurement",
    "ProcessNoise",
    "SeparatedNoise",
    "Update",
    "VaryingNoise",
    "autocorrelation",
    "estimate_delay",
    "estimate_process_noise",
    "estimate_varying_noise",
    "estimation_errors",
    "normalized_errors",
    "separate_noise",
    "smooth",
    "with_process_noise",
]
