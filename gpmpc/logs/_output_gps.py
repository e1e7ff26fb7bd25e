"""GPs on what the nominal part of a model of a log leaves."""

import warnings

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.gp import Trainer, standardize
from gpmpc.gp._data_checks import ColumnDescriptions
from gpmpc.logs._log import Log
from gpmpc.logs._regression import Standardization
from gpmpc.models._log_model import LogModel, OutputGP
from gpmpc.models._windows import Windows

_WINDOWS = 50_000  # among which rows are chosen, at most
_TOLERANCE = 1e-4  # of the training; rollouts tell no smaller one apart


def train_output_gp(
    model: LogModel,
    log: Log,
    outputs: tuple[int, ...],
    rows: int,
    points: int,
    seed: int,
    sees_memory: bool = False,
) -> OutputGP:
    """Trains a GP on the residual of the nominal part of a model.

    Args:
        model: With fitted parameters.
        log: The data.
        outputs: Those that the GP adds to.
        rows: Consecutive rows over which a target is averaged; its features are those
            of the row in the middle, of an even number the later one of the two.
        points: Rows that the GP is trained on.
        seed: Of the choice of rows, and of the training.
        sees_memory: Whether it sees the regressors of the memory.
    """
    features, residuals = _mean_residuals(model, log, rows, sees_memory)
    chosen = choose_rows(features, points, seed)
    targets = np.ascontiguousarray(residuals[chosen][:, list(outputs)])
    names = model.kinematics.feature_names(
        log.mapping.column_names("inputs"), log.mapping.column_names("context")
    )
    if sees_memory:
        names = model.memory.regressor_names(names, model.kinematics.output_names)
    columns = ColumnDescriptions(
        features=names,
        outputs=[model.kinematics.output_names[output] for output in outputs],
    )
    trainer = Trainer(
        predicts="value",
        scaling=standardize,
        restarts=1,
        tolerance=_TOLERANCE,
        resolution=0.0,  # units are those of the log: there is only round-off
    )
    training = trainer.fit(
        torch.from_numpy(features[chosen]),
        torch.from_numpy(targets),
        0,
        "value",
        seed,
        columns=columns,
    )
    return OutputGP(outputs, training.posterior, sees_memory)


def _mean_residuals(
    model: LogModel, log: Log, rows: int, sees_memory: bool
) -> tuple[Array, Array]:
    """Computes residuals averaged over some rows (N, o), with what a GP sees (N, d).

    It sees the features of the row in the middle, or the regressors of its memory.
    """
    windows = log.windows(rows, past=model.past, most=_WINDOWS)
    start = windows.past
    window_rows = slice(start, start + rows)
    states = windows.states[:, window_rows]
    next_states = windows.states[:, start + 1 : start + rows + 1]
    inputs, _ = model.acting_inputs(windows, window_rows)
    context = windows.context[:, -1:]
    context = np.broadcast_to(context, (*states.shape[:-1], context.shape[-1]))
    kinematics = model.kinematics
    outputs = kinematics.outputs(states, next_states, windows.time_step)
    nominal = model.nominal_outputs(states, inputs, context)
    residuals = outputs - nominal
    features = kinematics.features(states, inputs, context)
    points = features
    if model.weights.size:
        regressors = _regressors(model, windows, features, residuals)
        residuals = residuals - regressors @ model.weights.T
        if sees_memory:
            points = regressors[..., :-1]
    return points[:, rows // 2], residuals.mean(axis=1)


def _regressors(
    model: LogModel, windows: Windows, features: Array, residuals: Array
) -> Array:
    """Computes the regressors (N, rows, r) along rows that were measured."""
    remembered = model.parts(model.recall(windows), windows.inputs.shape[-1]).memory
    regressors = []
    for k in range(features.shape[1]):
        regressors.append(model.memory.regressors(features[:, k], remembered))
        remembered = model.memory.step(remembered, features[:, k], residuals[:, k])
    return np.stack(regressors, axis=1)


def choose_rows(features: Array, count: int, seed: int = 0) -> np.ndarray:
    """Chooses rows nearest to the centres of k-means.

    It begins with farthest points, so that rare states count.

    Args:
        features: (N, d); they are standardised here.
        count: Number of rows; all N where there are no more.
        seed: Of the rows among which the centres are found.

    Raises:
        DataError: There is no row.
    """
    if not len(features):
        raise DataError("no row to choose from")
    if len(features) <= count:
        return np.arange(len(features))
    z = Standardization.of(features)(features)
    sample = z[np.random.default_rng(seed).permutation(len(z))[: 10 * count]]
    farthest = _farthest_points(sample, count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a centre that loses its members stays
        centres = kmeans2(sample, sample[farthest], iter=5, minit="matrix")[0]
    return np.unique(cKDTree(z).query(centres)[1])


def _farthest_points(points: Array, count: int) -> list[int]:
    """Chooses points each of which is farthest from those before (Gonzalez, 1985)."""
    chosen = [0]
    squared_distance = np.full(len(points), np.inf)
    while len(chosen) < count:
        to_last = np.square(points - points[chosen[-1]]).sum(axis=1)
        squared_distance = np.minimum(squared_distance, to_last)
        chosen.append(int(squared_distance.argmax()))
    return chosen
