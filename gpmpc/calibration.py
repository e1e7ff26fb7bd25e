"""Checks whether predicted uncertainty can be believed, one step ahead and many.

Held-out recordings are predicted from every one of their states k = 1 to H steps ahead,
with the inputs that were applied, and compared with what was measured, per step and
state: root mean squared error, negative log predictive density (Quinonero-Candela et
al., 2006), how often central intervals hold the measurement (Gneiting, Balabdaoui and
Raftery, 2007), and their width. k = 1 from a certain state is the usual check of the
model alone.

Which noise an interval holds decides whether it can be believed. What scatters the
targets of one step is in all of them, once: what a model has learned of noise. Whether
it moves the state, and adds up from step to step, or is the sensors' alone, shows from
the second step on. By default it moves the state: that is right for wind and for wear,
and cautious where sensors are noisy. Where the sensors' part is known, it is said
apart.

Predictions from neighbouring states overlap, so their errors are correlated: the
effective number of samples is smaller than the count, the more so the larger k.
Intervals of a coverage count those that do not overlap.
"""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gpmpc._angles import angles_of, whole_turns
from gpmpc._arrays import read_array
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel, check_next_states
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_kind,
    check_number,
    check_numbers,
)
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Transitions
from gpmpc.gp._transitions import follows_previous, signals_of_tables
from gpmpc.metrics import (
    binomial_interval,
    interval_coverage,
    mean_squared_error,
    negative_log_predictive_density,
)
from gpmpc.models._past import (
    belief_of_measured,
    knows_starts,
    measured_dim,
    measured_signals,
    rows_before,
    whole_states,
)
from gpmpc.propagation import Propagator, best_propagator
from gpmpc.signals import UNKNOWN, Signals

if TYPE_CHECKING:
    import pandas

# Starts propagated at once: bounds the memory of moment matching at about CHUNK N^2
# numbers.
CHUNK = 64

_log = logging.getLogger(__name__)


@explains_arguments
@dataclass(frozen=True, eq=False)
class Recording:
    """One uninterrupted run at equal time steps.

    Raises:
        ShapeError: There is not one state more than inputs, or no input.
        DataError: An entry is not finite.

    >>> import numpy as np
    >>> len(Recording(states=np.zeros((11, 2)), inputs=np.zeros((10, 1))))
    10
    """

    states: Tensor  #: x[0] to x[K] (K + 1, n)
    inputs: Tensor  #: u[0] to u[K - 1] (K, m)
    #: names and time step, where they are known; those of tables' columns by default
    signals: Signals = UNKNOWN

    if TYPE_CHECKING:  # anything that is an array of numbers

        def __init__(
            self, states: Any, inputs: Any, signals: Signals = UNKNOWN
        ) -> None: ...

    def __post_init__(self) -> None:
        signals = signals_of_tables(self.signals, self.states, self.inputs)
        object.__setattr__(self, "signals", signals)
        column_names = {"states": signals.state_names, "inputs": signals.input_names}
        for name, names in column_names.items():
            array = read_array(f"{name} of a recording", getattr(self, name), names)
            object.__setattr__(self, name, torch.from_numpy(np.array(array)))
        are_tables = self.states.dim() == 2 and self.inputs.dim() == 2
        if not are_tables or not 0 < len(self.inputs) == len(self.states) - 1:
            raise ShapeError(
                "a recording has states (K + 1, n) and inputs (K, m), K of 1 or more; "
                f"got {tuple(self.states.shape)} and {tuple(self.inputs.shape)}"
            )
        signals.check_sizes(self.states.shape[1], self.inputs.shape[1])
        for name in ("states", "inputs"):
            if not bool(torch.isfinite(getattr(self, name)).all()):
                raise DataError(f"{name} of a recording must be finite")

    def __len__(self) -> int:
        return len(self.inputs)

    @classmethod
    def chained(cls, transitions: Transitions) -> list["Recording"]:
        """Finds the runs in transitions.

        A run goes on while a row's next state is the following row's state, up to
        round-off; whole turns of an angle end it.
        """
        last_rows = torch.nonzero(~follows_previous(transitions))[:, 0].tolist()
        ends = [0, *(row + 1 for row in last_rows), len(transitions)]
        recordings = []
        for begin, end in pairwise(ends):
            run = transitions[begin:end]
            states = torch.cat([run.states, run.next_states[-1:]])
            recordings.append(cls(states, run.inputs, run.signals))
        return recordings


@dataclass(frozen=True, eq=False)
class Calibration:
    """A comparison of predictions of 1 to H steps, for n states and L levels."""

    names: tuple[str, ...]  #: of the n states
    levels: tuple[float, ...]  #: of the intervals
    samples: Tensor  #: predictions compared at each step (H,)
    rmse: Tensor  #: root mean squared error (H, n), in the units of each state
    nlpd: Tensor  #: negative log predictive density (H, n); lower is better
    #: part of the measurements inside the central interval of each level (H, n, L)
    coverage: Tensor
    #: root mean predicted variance over the RMSE (H, n): one is honest, less claims too
    #: much
    width: Tensor
    independent: Tensor  #: predictions that do not overlap, at most (H,)
    noise: str = ""  #: which noise the intervals hold, in words

    def coverage_interval(
        self, step: int, state: int, level: int
    ) -> tuple[float, float]:
        """Computes the exact 95 % interval of a coverage from its three indices.

        Clopper and Pearson (1934).
        """
        trials = int(self.independent[step])
        successes = round(float(self.coverage[step, state, level]) * trials)
        return binomial_interval(successes, trials)

    @property
    def horizon(self) -> int:
        """H, the longest prediction in steps."""
        return len(self.samples)

    def to_pandas(self) -> "pandas.DataFrame":
        """Returns a table with a row a step and state.

        Its columns are step, state, samples, rmse, nlpd, width, and coverage_<level>
        for each level.
        """
        import pandas

        n = len(self.names)
        columns: dict[str, Any] = {
            "step": torch.arange(1, self.horizon + 1).repeat_interleave(n),
            "state": self.names * self.horizon,
            "samples": self.samples.repeat_interleave(n),
            "rmse": self.rmse.ravel(),
            "nlpd": self.nlpd.ravel(),
            "width": self.width.ravel(),
        }
        for j, level in enumerate(self.levels):
            columns[f"coverage_{level:g}"] = self.coverage[..., j].ravel()
        return pandas.DataFrame(columns)


@explains_arguments
def calibrate(
    model: DynamicsModel,
    recordings: Sequence[Recording] | Recording,
    propagator: Propagator | None = None,
    horizon: int = 10,
    levels: Sequence[float] = (0.5, 0.9, 0.95),
    names: Sequence[str] = (),
    angles: Sequence[int] | None = None,
    measurement_noise: Sequence[float] | None = None,
) -> Calibration:
    """Predicts held-out recordings from every state, and compares.

    Predictions hold the model's noise once: at each step, where the propagator adds the
    process noise (all do by default), else at the last one alone, as if it were of the
    sensors. Where ``measurement_noise`` says what theirs is, a propagator that adds
    none leaves the model's out. What ``predict`` itself holds, as that of a
    ``NoisyModel``, is in every step. ``Calibration.noise`` says which.

    Args:
        model: What was learned, from other recordings.
        recordings: Measured states and applied inputs. A start counts for the steps
            that its recording still holds.
        propagator: How the belief moves; as ``best_propagator`` of
            ``gpmpc.propagation`` does by default.
        horizon: H, the longest prediction in steps.
        levels: Of the central intervals.
        names: Of the states; by default as the model or the first recording calls them,
            or x1, x2, ...
        angles: Indices of the states that are angles [rad], whose errors are taken
            within half a turn; by default those of the model.
        measurement_noise: Standard deviations of the sensors that the states were
            measured with (n,), where they are known: starts are then as uncertain, and
            what is compared. Without them a start is certain, but of a model of a log
            as uncertain as its rows. The model's noise has to be that of the process
            alone (``gpmpc.estimation.separate_noise``), or it counts theirs once more.

    Raises:
        ShapeError: Recordings, model or names do not belong together.
        SettingError: A level is not between 0 and 1, no recording is as long as the
            horizon, a deviation of the sensors is negative, or the model predicts
            something else than next states.

    See Also:
        ``Recording.chained``, which finds the runs in transitions;
        ``gpmpc.plotting.calibration_figure``.
    """
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    for recording in recordings:
        check_kind("recordings", recording, Recording, "Recording(states, inputs)")
    if not isinstance(levels, Sequence):
        raise SettingError("levels", f"must be a list, such as [0.95]; got {levels!r}")
    propagator = best_propagator(model) if propagator is None else propagator
    names = _state_names(names, model, recordings)
    check_number("horizon", horizon, least=1, whole=True)
    _check(model, recordings, horizon, levels, names)
    turning = angles_of(model) if angles is None else list(angles)
    noise = _assumed_noise(model, propagator, measurement_noise)
    # of each number of steps, less one, those of the chunks of all recordings
    predictions: list[list[_Predictions]] = [[] for _ in range(horizon)]
    with torch.no_grad():
        for recording in recordings:
            for step, compared in _predict_recording(
                model, propagator, recording, horizon, noise, turning
            ):
                predictions[step].append(compared)
    columns = [_columns(_joined(step)) for step in predictions]
    _warn_of_certain(columns, names)
    rmse = _table(columns, lambda c: math.sqrt(mean_squared_error(c.mean, c.observed)))
    deviation = _table(columns, lambda c: math.sqrt(c.variance.mean()))
    independent = [
        sum(max(len(rows) - rows_before(model), 0) // k for rows in recordings)
        for k in range(1, horizon + 1)
    ]
    return Calibration(
        names=names,
        levels=tuple(levels),
        samples=torch.tensor([len(step[0].mean) for step in columns]),
        rmse=rmse,
        nlpd=_table(
            columns,
            lambda c: negative_log_predictive_density(c.mean, c.variance, c.observed),
        ),
        coverage=_table(
            columns,
            lambda c: [
                interval_coverage(c.mean, c.variance, c.observed, level)
                for level in levels
            ],
        ),
        width=deviation / rmse,
        independent=torch.tensor(independent),
        noise=_noise_in_words(model, noise, has_variance=bool(deviation.any())),
    )


class _Noise(NamedTuple):
    """The noise that predictions hold."""

    moves_state: bool  #: whether the propagator adds the process noise at every step
    #: covariance of the states where predictions begin (n, n); None where the model
    #: may know it
    start: Tensor | None
    of_compared: Tensor  #: variances added to predictions of any step (n,)


class _Predictions(NamedTuple):
    """Predictions of one number of steps, and what was measured; all (S, n)."""

    mean: Tensor
    variance: Tensor
    observed: Tensor


def _assumed_noise(
    model: DynamicsModel,
    propagator: Propagator,
    measurement_noise: Sequence[float] | None,
) -> _Noise:
    """Returns the noise of predictions; see ``calibrate``."""
    n = measured_dim(model)
    moves_state = bool(getattr(propagator, "process_noise", False))
    sensors = torch.zeros(n, dtype=model.dtype, device=model.device)
    start = None
    if measurement_noise is not None:
        deviations = list(measurement_noise)
        check_numbers("measurement_noise", deviations, n, least=0)
        sensors = torch.tensor(
            deviations, dtype=model.dtype, device=model.device
        ).square()
        start = torch.diag(sensors)
    of_compared = sensors
    if not moves_state and measurement_noise is None:
        of_compared = model.noise_covariance.diagonal()[:n]
    return _Noise(moves_state=moves_state, start=start, of_compared=of_compared)


def _predict_recording(
    model: DynamicsModel,
    propagator: Propagator,
    recording: Recording,
    horizon: int,
    noise: _Noise,
    angles: Sequence[int],
) -> Iterator[tuple[int, _Predictions]]:
    """Predicts from every state of a recording, some starts at once.

    A model with a past predicts from where the rows before say what it is.

    Yields:
        The number of steps ahead, less one, and predictions of as many steps.
    """
    n = measured_dim(model)
    size = len(recording)
    states = recording.states.to(dtype=model.dtype, device=model.device)
    inputs = recording.inputs.to(dtype=model.dtype, device=model.device)
    states = whole_states(model, states, inputs)
    for first in range(rows_before(model), size, CHUNK):
        mean = states[first : min(first + CHUNK, size)]
        belief = _start(model, mean, noise)
        for k in range(min(horizon, size - first)):
            # From here on k + 1 steps would outlast the recording.
            last = min(first + CHUNK, size - k)
            count = last - first
            belief = Gaussian(belief.mean[:count], belief.covariance[:count])
            control = inputs[first + k : last + k]
            belief = propagator.propagate(model, belief, control).belief
            mean = belief.mean[:, :n].double().cpu()
            variance = (belief.variance[:, :n] + noise.of_compared).double().cpu()
            observed = recording.states[first + k + 1 : last + k + 1].clone()
            observed[:, angles] -= whole_turns((observed - mean)[:, angles])
            yield k, _Predictions(mean=mean, variance=variance, observed=observed)


def _start(model: DynamicsModel, states: Tensor, noise: _Noise) -> Gaussian:
    """Returns what is believed of measured states with their past (S, n + ...)."""
    if noise.start is None:
        return belief_of_measured(model, states)
    further = states.shape[1] - len(noise.start)
    covariance = pad(noise.start, (0, further, 0, further))
    return Gaussian(states, covariance.expand(len(states), *covariance.shape))


def _joined(parts: list[_Predictions]) -> _Predictions:
    """Joins predictions of the same number of steps."""
    return _Predictions(
        mean=torch.cat([part.mean for part in parts]),
        variance=torch.cat([part.variance for part in parts]),
        observed=torch.cat([part.observed for part in parts]),
    )


def _columns(predictions: _Predictions) -> list[_Predictions]:
    """Splits predictions into those of each state (S, 1)."""
    return [
        _Predictions(
            mean=predictions.mean[:, i : i + 1],
            variance=predictions.variance[:, i : i + 1],
            observed=predictions.observed[:, i : i + 1],
        )
        for i in range(predictions.mean.shape[1])
    ]


def _table(
    columns: list[list[_Predictions]], measure: Callable[[_Predictions], Any]
) -> Tensor:
    """Measures the predictions columns[step][state] of each (H, n, ...)."""
    values = [[measure(column) for column in step] for step in columns]
    return torch.tensor(values, dtype=torch.float64)


def _warn_of_certain(columns: list[list[_Predictions]], names: Sequence[str]) -> None:
    """Logs states of which a prediction has no variance, by step and state."""
    certain = [
        names[i]
        for i in range(len(names))
        if any(not step[i].variance.all() for step in columns)
    ]
    if certain:
        _log.warning(
            "calibration: predictions of %s have no variance, at one step or more: "
            "their likelihood is no number, and intervals hold what they hit alone. "
            "Give the model a noise",
            ", ".join(certain),
        )


def _state_names(
    names: Sequence[str], model: DynamicsModel, recordings: list[Recording]
) -> tuple[str, ...]:
    """Returns the names of the states, the model's or the first recording's."""
    if names:
        return tuple(names)
    known = measured_signals(model).state_names
    if not known and recordings:
        known = recordings[0].signals.state_names
    return tuple(known) or tuple(f"x{i + 1}" for i in range(measured_dim(model)))


def _noise_in_words(model: DynamicsModel, noise: _Noise, has_variance: bool) -> str:
    """Says which noise predicted intervals hold."""
    sensors_known = noise.start is not None
    if not has_variance:
        return "no noise, as the model has none"
    if not model.noise_covariance.any():
        words = "what the model itself predicts at every step"
        if sensors_known:
            words += ", the sensors' at the first step and the last"
    elif noise.moves_state and sensors_known:
        words = (
            "the model's noise at every step, the sensors' at the first and the last"
        )
    elif noise.moves_state:
        words = "the model's noise at every step"
    elif sensors_known:
        words = "the sensors' noise at the first step and the last, none in between"
    else:
        words = "the model's noise at the last step alone, as if it were the sensors'"
    if not sensors_known and knows_starts(model):
        words += ", and what the model knows of the sensors' at the first"
    return words


def _check(
    model: DynamicsModel,
    recordings: list[Recording],
    horizon: int,
    levels: Sequence[float],
    names: tuple[str, ...],
) -> None:
    """Raises unless model, recordings, levels and names belong together."""
    _, m = check_next_states(model)
    n = measured_dim(model)
    sizes = {(r.states.shape[1], r.inputs.shape[1]) for r in recordings}
    if sizes != {(n, m)}:
        raise ShapeError(
            f"recordings must have the model's {n} states and {m} inputs; "
            f"got {sizes or 'no recording'}"
        )
    for recording in recordings:
        measured_signals(model).check("the model", recording.signals, "the recording")
    back = rows_before(model)
    longest = max(map(len, recordings)) - back
    if horizon > longest:
        rule = f"must be at most {longest} steps, the longest recording"
        if back:
            rule += f" without the first {back} rows, which the model looks back"
        raise SettingError("horizon", f"{rule}; got {horizon}")
    if len(names) != n:
        raise ShapeError(f"names must name {n} states; got {len(names)}")
    if not levels or not all(0 < level < 1 for level in levels):
        raise SettingError(
            "levels", f"must be one or more between 0 and 1; got {levels}"
        )
