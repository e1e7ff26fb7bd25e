"""Checks whether the uncertainty that a model and a propagator state can be believed, one step ahead and many.

Held-out recordings are predicted from every one of their states k = 1 to H steps ahead, with the inputs that were
applied, and compared with what was measured, per step and state: root mean squared error, negative log predictive
density (Quinonero-Candela et al., 2006), how often central intervals hold the measurement (Gneiting, Balabdaoui and
Raftery, 2007), and their width. k = 1 from a certain state is the usual check of the model alone.

Which noise an interval holds decides whether it can be believed. What scatters the targets of one step is in all of
them, once: what a model has learned of noise. Whether it moves the state, and adds up from step to step, or is the
sensors' alone, shows from the second step on. By default it moves the state: that is right for wind and for wear, and
cautious where sensors are noisy. Where the sensors' part is known, it is said apart.

Predictions from neighbouring states overlap, so their errors are correlated: the effective number of samples is smaller
than the count, the more so the larger k. Intervals of a coverage count those that do not overlap.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import angles_of, whole_turns
from gpmpc._arrays import names_of, read_array
from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_number,
    check_numbers,
)
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Transitions
from gpmpc.metrics import (
    binomial_interval,
    interval_coverage,
    mean_squared_error,
    negative_log_predictive_density,
)
from gpmpc.propagation import Propagator, best_propagator
from gpmpc.signals import UNKNOWN, Signals, check_signals, signals_of

if TYPE_CHECKING:
    import pandas

CHUNK = 64  # starts propagated at once: bounds the memory of moment matching at about CHUNK N^2 numbers


@dataclass(frozen=True)
class Recording:
    """One uninterrupted run at equal time steps.

    Raises:
        ShapeError: There is not one state more than inputs, or no input.
        DataError: An entry is not finite.
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
        check_signals(self.signals)
        signals = Signals(
            self.signals.state_names or names_of(self.states),
            self.signals.input_names or names_of(self.inputs),
            self.signals.time_step,
        )
        object.__setattr__(self, "signals", signals)
        for name, names in (
            ("states", signals.state_names),
            ("inputs", signals.input_names),
        ):
            array = read_array(f"{name} of a recording", getattr(self, name), names)
            object.__setattr__(self, name, torch.from_numpy(np.array(array)))
        if (
            self.states.dim() != 2
            or self.inputs.dim() != 2
            or not 0 < len(self.inputs) == len(self.states) - 1
        ):
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
        """Finds the runs in transitions: one goes on while a row's next state is the following row's state."""
        goes_on = (
            (transitions.next_states[:-1] == transitions.states[1:]).all(dim=1).tolist()
        )
        ends = [
            0,
            *(k + 1 for k, same in enumerate(goes_on) if not same),
            len(transitions),
        ]
        runs = [transitions[begin:end] for begin, end in pairwise(ends)]
        return [
            cls(torch.cat([run.states, run.next_states[-1:]]), run.inputs, run.signals)
            for run in runs
        ]


@dataclass(frozen=True)
class Calibration:
    """How predictions of k = 1 to H steps fared, for n states and L levels."""

    names: tuple[str, ...]  # of the n states
    levels: tuple[float, ...]  # of the intervals
    samples: Tensor  # (H,) predictions compared at each step
    rmse: Tensor  # (H, n) root mean squared error, in the units of each state
    nlpd: Tensor  # (H, n) negative log predictive density; lower is better
    coverage: Tensor  # (H, n, L) part of the measurements inside the central interval of each level
    width: Tensor  # (H, n) root mean predicted variance over the RMSE: one is honest, less claims too much
    independent: Tensor  # (H,) predictions that do not overlap, at most
    noise: str = ""  # which noise the intervals hold, in words

    def coverage_interval(
        self, step: int, state: int, level: int
    ) -> tuple[float, float]:
        """Computes the exact 95 % interval of a coverage (Clopper and Pearson, 1934), from its three indices."""
        trials = int(self.independent[step])
        return binomial_interval(
            round(float(self.coverage[step, state, level]) * trials), trials
        )

    @property
    def horizon(self) -> int:
        """H, the longest prediction in steps."""
        return len(self.samples)

    def to_pandas(self) -> "pandas.DataFrame":
        """Returns a row a step and state: step, state, samples, rmse, nlpd, width, and coverage_<level> for each."""
        import pandas

        n = len(self.names)
        steps, samples = (
            t.repeat_interleave(n)
            for t in (torch.arange(1, self.horizon + 1), self.samples)
        )
        table: dict[str, Any] = {
            "step": steps,
            "state": self.names * self.horizon,
            "samples": samples,
        }
        table |= {key: getattr(self, key).ravel() for key in ("rmse", "nlpd", "width")}
        table |= {
            f"coverage_{level:g}": self.coverage[..., j].ravel()
            for j, level in enumerate(self.levels)
        }
        return pandas.DataFrame(table)


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

    Predictions hold the model's noise once in every case: at each step, where the propagator adds the process noise
    (all do by default), else at the last one alone, as if it were of the sensors. ``Calibration.noise`` says which.

    Args:
        model: What was learned, from other recordings.
        recordings: Measured states and applied inputs. A start counts for the steps that its recording still holds.
        propagator: How the belief moves; as ``best_propagator`` of ``gpmpc.propagation`` does by default.
        horizon: H, the longest prediction in steps.
        levels: Of the central intervals.
        names: Of the states; by default as the model or the first recording calls them,
            or x1, x2, ...
        angles: Indices of the states that are angles [rad], whose errors are taken within half a turn; by default
            those of the model.
        measurement_noise: Standard deviations of the sensors that the states were measured with (n,), where they are
            known: starts are then as uncertain, and what is compared. The model's noise has to be that of the process
            alone (``gpmpc.estimation.separate_noise``), or it counts theirs once more.

    Raises:
        ShapeError: Recordings, model or names do not belong together.
        SettingError: A level is not between 0 and 1, no recording is as long as the horizon, or a deviation of the
            sensors is negative.
    """
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    propagator = best_propagator(model) if propagator is None else propagator
    own = signals_of(model).state_names
    if not own and recordings:
        own = recordings[0].signals.state_names
    names = tuple(names or own) or tuple(f"x{i + 1}" for i in range(model.state_dim))
    check_number("horizon", horizon, least=1, whole=True)
    _check(model, recordings, horizon, levels, names)
    n = model.state_dim
    turning = angles_of(model) if angles is None else list(angles)
    like: dict[str, Any] = {"dtype": model.dtype, "device": model.device}
    holds_noise = bool(getattr(propagator, "process_noise", False))
    sensors = torch.zeros(n, **like)
    if measurement_noise is not None:
        deviations = list(measurement_noise)
        check_numbers("measurement_noise", deviations, n, least=0)
        sensors = torch.tensor(deviations, **like).square()
    added = sensors
    if not holds_noise and measurement_noise is None:
        added = model.noise_covariance.diagonal()
    start = torch.diag(sensors)

    found: list[list[tuple[Tensor, ...]]] = [[] for _ in range(horizon)]
    with torch.no_grad():
        for recording in recordings:
            x = recording.states.to(**like)
            u = recording.inputs.to(**like)
            K = len(recording)
            for first in range(0, K, CHUNK):
                mean = x[first : min(first + CHUNK, K)]
                belief = Gaussian(mean, start.expand(len(mean), n, n))
                for k in range(min(horizon, K - first)):
                    last = min(
                        first + CHUNK, K - k
                    )  # from here on k + 1 steps would outlast the recording
                    belief = Gaussian(
                        belief.mean[: last - first], belief.covariance[: last - first]
                    )
                    belief = propagator(model, belief, u[first + k : last + k])
                    mean = belief.mean.double().cpu()
                    variance = (belief.variance + added).double().cpu()
                    observed = recording.states[first + k + 1 : last + k + 1].clone()
                    turns = whole_turns((observed - mean)[:, turning])
                    observed[:, turning] -= turns
                    found[k].append((mean, variance, observed))
    steps = [
        tuple(torch.cat(parts) for parts in zip(*step, strict=True)) for step in found
    ]
    columns = [
        [[part[:, i : i + 1] for part in step] for i in range(n)] for step in steps
    ]

    def table(measure: Callable[[Tensor, Tensor, Tensor], Any]) -> Tensor:
        return torch.tensor(
            [[measure(*column) for column in step] for step in columns],
            dtype=torch.float64,
        )

    rmse = table(lambda m, v, y: math.sqrt(mean_squared_error(m, y)))
    return Calibration(
        names,
        tuple(levels),
        torch.tensor([len(mean) for mean, _, _ in steps]),
        rmse,
        table(negative_log_predictive_density),
        table(lambda m, v, y: [interval_coverage(m, v, y, level) for level in levels]),
        table(lambda m, v, y: math.sqrt(v.mean())) / rmse,
        torch.tensor(
            [
                sum(len(recording) // k for recording in recordings)
                for k in range(1, horizon + 1)
            ]
        ),
        _noise_in_words(holds_noise, measurement_noise is not None),
    )


def _noise_in_words(moves_the_state: bool, sensors_known: bool) -> str:
    """Which noise predicted intervals hold."""
    if moves_the_state and sensors_known:
        return "the model's noise at every step, the sensors' at the first and the last"
    if moves_the_state:
        return "the model's noise at every step"
    if sensors_known:
        return "the sensors' noise at the first step and the last, none in between"
    return "the model's noise at the last step alone, as if it were the sensors'"


def _check(
    model: DynamicsModel,
    recordings: list[Recording],
    horizon: int,
    levels: Sequence[float],
    names: tuple[str, ...],
) -> None:
    n = model.state_dim
    m = model.input_dim
    if model.output_dim != n:
        raise ShapeError(
            f"the model must predict its {n} states; it has {model.output_dim} outputs"
        )
    sizes = {
        (recording.states.shape[1], recording.inputs.shape[1])
        for recording in recordings
    }
    if sizes != {(n, m)}:
        raise ShapeError(
            f"recordings must have the model's {n} states and {m} inputs; got {sizes or 'no recording'}"
        )
    for recording in recordings:
        signals_of(model).check("the model", recording.signals, "the recording")
    longest = max(map(len, recordings))
    if horizon > longest:
        raise SettingError(
            "horizon",
            f"must be at most {longest} steps, the longest recording; got {horizon}",
        )
    if len(names) != n:
        raise ShapeError(f"names must name {n} states; got {len(names)}")
    if not levels or not all(0 < level < 1 for level in levels):
        raise SettingError(
            "levels", f"must be one or more between 0 and 1; got {levels}"
        )
