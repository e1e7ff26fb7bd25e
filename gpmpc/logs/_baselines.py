"""Predictions that cost nothing, beside which a model of a log has to stand."""

from collections.abc import Callable, Sequence

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._fitting import PAST, fit_least_squares
from gpmpc.logs._log import Log
from gpmpc.models._correction import PENALTY, Correction, Prior
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._windows import Windows

CONSTANT_STATE = "constant state"
#: those that a controller could plan with
PLANNABLE_BASELINES = (CONSTANT_STATE, "constant velocity", "least squares")
_RIDGE_WINDOWS = 3000  # to which the ridge regression is fitted


def baseline_errors(
    kinematics: Kinematics, train: Log, windows: Windows, steps: Sequence[int]
) -> dict[str, Array]:
    """Computes the errors (W, steps, e) of each baseline by its name.

    Args:
        kinematics: Have the features, and the movement at a constant velocity.
        train: That the baselines are fitted to.
        windows: W of them, that are predicted.
        steps: After the starts.
    """
    start = windows.states[:, windows.past]

    def errors(predict: Callable[[int], Array]) -> Array:
        columns = []
        for k in steps:
            measured = windows.states[:, windows.past + k]
            columns.append(windows.space.difference(predict(k), measured))
        return np.stack(columns, axis=1)

    def coast(k: int) -> Array:
        return kinematics.coast(start, k * windows.time_step)

    affine = fit_least_squares(kinematics, train)
    with np.errstate(over="ignore", invalid="ignore"):
        affine_errors = windows.errors(affine.rollout(windows, max(steps)), steps)
    inf = np.inf
    return {
        CONSTANT_STATE: errors(lambda k: start),
        "constant velocity": errors(coast),
        "least squares": np.nan_to_num(affine_errors, nan=inf, posinf=inf, neginf=inf),
        "ridge regression": _ridge_errors(kinematics, train, windows, steps),
    }


def _ridge_errors(
    kinematics: Kinematics, train: Log, windows: Windows, steps: Sequence[int]
) -> Array:
    """Computes the errors (W, steps, e) of a ridge regression with history."""
    ahead = max(steps)
    training_windows = train.windows(ahead, PAST, most=_RIDGE_WINDOWS)
    (ridge,) = Correction.fit_each(
        kinematics=kinematics,
        windows=training_windows,
        predicted=_still(training_windows, ahead),
        steps=steps,
        priors=[Prior(PENALTY)],
    )
    return windows.errors(ridge(windows, _still(windows, ahead)), steps)


def _still(windows: Windows, steps: int) -> Array:
    """Returns the starts of windows, repeated (W, steps, n)."""
    start = windows.states[:, windows.past : windows.past + 1]
    return np.repeat(start, steps, axis=1)
