"""Training data, checked and with their scalings, and what is constant in them.

Hyperparameters are searched as rows theta = (log l, log sf, log(sf / sn)), one an
output, in scaled units; here they are converted to the units of the data and back.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import check_tensors
from gpmpc.gp._data_checks import ColumnDescriptions, ConstantColumns, column_scales
from gpmpc.gp._posterior import GPPosterior
from gpmpc.gp._prior_scales import (
    PriorLengthscales,
    PriorScales,
    check_prior_settings,
)
from gpmpc.gp._scaling import Scaling
from gpmpc.gp._tensor_checks import Predicts, check_gp_tensors, check_on_host

_log = logging.getLogger(__name__)
_NAMED_COLUMNS = 6  # columns that a line of the log names; of more it says how many


class DataSettings(Protocol):
    """The settings of ``Trainer`` and ``SparseTrainer`` by which data are read."""

    @property
    def scaling(self) -> Callable[[Tensor, Sequence[str]], Scaling]: ...
    @property
    def prior_lengthscale(self) -> PriorLengthscales: ...
    @property
    def prior_deviation(self) -> float | None: ...
    @property
    def resolution(self) -> float: ...


def check_data_settings(settings: DataSettings) -> None:
    """Raises ``SettingError`` unless these settings of a trainer are in range."""
    check_function("scaling", settings.scaling, example="standardize")
    check_prior_settings(
        settings.prior_lengthscale, settings.prior_deviation, settings.resolution
    )


def check_function(key: str, value: Any, example: str) -> None:
    """Raises ``SettingError`` unless a setting is a function."""
    if not callable(value):
        raise SettingError(
            key, f"must be a function such as {example} of gpmpc.gp; got {value!r}"
        )


@dataclass(frozen=True, eq=False)
class TrainingData:
    """What a training learns from, in the units of the data, and how it is scaled."""

    features: Tensor  #: x~ = (x, u) (N, d)
    targets: Tensor  #: (N, k)
    input_dim: int  #: m
    predicts: Predicts  #: what the targets mean
    feature_scaling: Scaling
    target_scaling: Scaling
    columns: ColumnDescriptions  #: names and magnitudes of features and targets
    constant: ConstantColumns
    prior: PriorScales  #: of what is constant

    def __len__(self) -> int:
        return len(self.features)

    @property
    def scaled_targets(self) -> Tensor:
        """Targets (N, k) in scaled units."""
        return self.target_scaling.scale(self.targets)

    @property
    def feature_scales(self) -> NDArray[np.float64]:
        """Scales of the features (d,); see ``column_scales``."""
        return column_scales(self.features.numpy(), self.constant.features)

    @property
    def unsearched_outputs(self) -> NDArray[np.bool_]:
        """Outputs (k,) that are constant and have a prior deviation."""
        return self.constant.outputs & (self.prior.deviations is not None)


def read_training_data(
    features: Tensor,
    targets: Tensor,
    input_dim: int,
    predicts: Predicts,
    columns: ColumnDescriptions | None,
    settings: DataSettings,
) -> TrainingData:
    """Checks and scales training data; the log names what they cannot teach.

    Arguments and errors are those of ``Trainer.fit``.
    """
    check_tensors(features=features, targets=targets)
    check_on_host(features=features, targets=targets)
    check_gp_tensors(features, targets, input_dim, predicts)
    features = features.detach()
    targets = targets.detach()
    d = features.shape[1]
    short_names = [f"x{i + 1}" for i in range(d - input_dim)]
    short_names += [f"u{i + 1}" for i in range(input_dim)]
    output_names = [f"y{a + 1}" for a in range(targets.shape[1])]
    feature_scaling = settings.scaling(features, short_names)
    target_scaling = settings.scaling(targets, output_names)

    if columns is None:
        columns = ColumnDescriptions.of_tensors(features, targets, input_dim, predicts)
    deviation_units = columns.deviation_units
    if deviation_units is None:
        deviation_units = np.ones(targets.shape[1])
    data = TrainingData(
        features=features,
        targets=targets,
        input_dim=input_dim,
        predicts=predicts,
        feature_scaling=feature_scaling,
        target_scaling=target_scaling,
        columns=columns,
        constant=ConstantColumns.find(features, targets, columns, settings.resolution),
        prior=PriorScales.of_settings(
            settings.prior_lengthscale,
            settings.prior_deviation,
            units=deviation_units,
            feature_count=d,
        ),
    )
    _warn_of_constants(data, settings.resolution)
    return data


def restored_theta(
    theta: np.ndarray, feature_scaling: Scaling, target_scaling: Scaling
) -> np.ndarray:
    """Converts theta (k, d + 2) from scaled units to the units of the data."""
    shift = np.zeros_like(theta)
    shift[:, :-2] = feature_scaling.factor.log().numpy()
    shift[:, -2] = target_scaling.factor.log().numpy()
    return theta + shift


def scaled_theta(
    posterior: GPPosterior, feature_scaling: Scaling, target_scaling: Scaling
) -> np.ndarray:
    """Returns theta (k, d + 2) of a posterior in scaled units.

    Raises:
        ShapeError: The posterior has other features or outputs.
    """
    k = len(target_scaling.factor)
    d = len(feature_scaling.factor)
    if posterior.lengthscales.shape != (k, d):
        outputs, features = posterior.lengthscales.shape
        raise ShapeError(
            f"the posterior to start from must have {d} features and {k} outputs; "
            f"got {features} and {outputs}"
        )
    lengthscales = posterior.lengthscales.to("cpu", torch.float64)
    signal_variance = posterior.signal_variance.to("cpu", torch.float64)
    noise_variance = posterior.noise_variance.to("cpu", torch.float64)
    theta = [
        (lengthscales / feature_scaling.factor).log(),
        (signal_variance.sqrt() / target_scaling.factor).log(),
        (signal_variance / noise_variance).log() / 2,
    ]
    return torch.column_stack(theta).numpy(force=True)


def _warn_of_constants(data: TrainingData, resolution: float) -> None:
    """Logs what is constant in the data, and the prior that is taken instead.

    What a setting says is known is not named: a feature of an infinite length-scale,
    and outputs whose deviation the search is to find.
    """
    size = len(data)
    prior = data.prior
    constant_features = data.constant.features & np.isfinite(prior.lengthscales)
    lengthscales = _distinct(prior.lengthscales[constant_features])
    constant_outputs = data.unsearched_outputs
    deviations = ""
    if prior.deviations is not None:
        deviations = _distinct(prior.deviations[constant_outputs])
    if size == 1 and (constant_features.any() or constant_outputs.any()):
        _log.warning(
            "training: one row says nothing of how anything varies. Supposed are "
            "length-scales of %s (prior_lengthscale) and deviations of %s "
            "(prior_deviation)",
            lengthscales or "infinity",
            deviations or "what is found",
        )
        return
    if size < data.features.shape[1] + 2:
        _log.warning(
            "training: %d rows for %d columns of states and inputs: fewer than a plane "
            "needs (%d), so that slopes and noise cannot be told apart. Predictions "
            "stay near the prior; record more",
            size,
            data.features.shape[1],
            data.features.shape[1] + 2,
        )
    if constant_features.any():
        _log.warning(
            "training: never moves by more than %.1g (resolution) in the %d rows: %s. "
            "What it changes is not known: away from that value predictions return to "
            "the prior, over a length-scale of %s (prior_lengthscale; 'no_effect' "
            "where it is known to change nothing)",
            resolution,
            size,
            _listed(data.columns.features, data.features[0], constant_features),
            lengthscales,
        )
    if constant_outputs.any():
        _log.warning(
            "training: never changes by more than %.1g (resolution) in the targets of "
            "the %d rows: %s. How much it varies elsewhere is not known: supposed is a "
            "deviation of %s (prior_deviation)",
            resolution,
            size,
            _listed(data.columns.outputs, data.targets[0], constant_outputs),
            deviations,
        )


def _distinct(values: NDArray[np.float64]) -> str:
    """Lists different numbers in ascending order."""
    return ", ".join(f"{value:.3g}" for value in np.unique(values))


def _listed(names: Sequence[str], values: Tensor, chosen: NDArray[np.bool_]) -> str:
    """Lists the chosen columns with the value that each holds; of many, the first."""
    indices = np.flatnonzero(chosen).tolist()
    texts = [f"{names[i]} ({float(values[i]):.6g})" for i in indices]
    if len(texts) <= _NAMED_COLUMNS:
        return ", ".join(texts)
    further = len(texts) - _NAMED_COLUMNS
    return ", ".join(texts[:_NAMED_COLUMNS]) + f" and {further} more"
