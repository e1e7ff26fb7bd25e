"""Finds by how many rows the inputs of a log act late, to try models that know it.

What moves a state in a step is regressed on the state and on the inputs of an earlier
row, once for each delay; the delay that leaves least is the likely one. A first-order
lag looks like a delay as well: which of the two it is, or both, rollouts decide.
"""

import numpy as np

from gpmpc.exceptions import DataError
from gpmpc.logs._log import Log
from gpmpc.logs._regression import fit_affine
from gpmpc.models._kinematics import Kinematics

MOST_ROWS = 15  # that are sought
_WINDOWS = 6000
_SIGNIFICANT = 20.0  # twice the logarithm of the likelihood ratio that says something


def likely_delay(log: Log, kinematics: Kinematics, most: int) -> int:
    """Returns by how many rows the inputs are likely to act late; zero for none.

    There is none either where one more row than is sought explains most: what is slower
    than all that is sought is no delay.

    Args:
        log: All runs.
        kinematics: Have the features, and the outputs that move a state.
        most: Rows that are sought.
    """
    if not log.input_names or most < 1:
        return 0
    longest = most + 1
    try:
        windows = log.windows(1, past=longest, most=_WINDOWS)
    except DataError:
        return 0
    states = windows.states[:, longest]
    next_states = windows.states[:, longest + 1]
    context = windows.context[:, longest]
    outputs = kinematics.outputs(states, next_states, log.time_step)
    moves = outputs.std(axis=0) > 0
    if not moves.any():
        return 0
    logarithms = []  # of the residuals' variances, by delay
    for rows in range(longest + 1):
        inputs = windows.inputs[:, longest - rows]
        features = kinematics.features(states, inputs, context)
        logarithms.append(_unexplained(features, outputs[:, moves]))
    best = int(np.argmin(logarithms))
    gain = len(outputs) * (logarithms[0] - logarithms[best])
    return best if best <= most and gain > _SIGNIFICANT else 0


def _unexplained(features: np.ndarray, outputs: np.ndarray) -> float:
    """Returns the logarithm of what a regression leaves of outputs, summed over them.

    Args:
        features: Of the rows (N, d).
        outputs: None of which is constant (N, k).
    """
    centred = features - features.mean(axis=0)
    weights = fit_affine(centred, outputs)
    residuals = outputs - centred @ weights[:-1] - weights[-1]
    exact = 1e-20 * outputs.var(axis=0)
    variances = np.maximum(np.square(residuals).mean(axis=0), exact)
    return float(np.log(variances).sum())
