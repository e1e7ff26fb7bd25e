"""Learns while flying: every step teaches a GP of what has changed, and a check decides whether it may steer.

    x[k+1] = f(x[k], u[k]) + B d(phi(x[k], u[k]), t[k])

f was learned before, d is the change: a GP over what the model's own GP sees, phi, and over the time t, so that it
forgets in its kernel (a product of kernels in space and time: Bartels, Lahr, Carron and Zeilinger, 2026),

    k_a = share^2 sf2_a exp(-1/2 sum_d (phi_d - phi'_d)^2 / l_ad^2) exp(-1/2 (t - t')^2 / memory^2).

Length-scales and signal variances are the model's: the plant may differ by a share of what was learned. Where nothing
was seen lately d is zero, and with one point it is the estimate of a constant disturbance.

Each step of the flight becomes a point of the change, whether that is used or not. The
model with its change and the one without predict each step before they see it: the
change is used once its log densities, summed over a window of steps, lead by a margin,
and no longer once they trail. The model's noise is scaled by what successive errors
differ by, in the median, where that is more. A decision that fails with the change is
taken without it.

One wrong measurement spoils two transitions, the one into it and the one out of it, and
their errors have opposite signs; those of another plant agree. So a measurement that
neither chance nor the noise of late explains is in doubt: it is held back, and teaches
nothing before the next one has explained it. That one is compared with three
predictions:

* over both steps, from the last state that was trusted: then the measurement between was
  wrong;
* over one step, from the measurement in doubt: then the plant was moved, or its sensor;
* over one step, from the measurement in doubt, by the change that the step into it has
  taught: then the plant is another one. What was seen before is forgotten, and this
  change is used at once.

Where one of the first two holds, both steps are left out. The third has to be better than
these by as much as one step may count for. It needs further confirmations: one for each
step that nothing has explained of late, two at most, as where a sensor is noisy or shows
another unit for a second, and one for every time that its square is ``surprise`` times
what ``share`` expects. A sensor that repeats itself to the last digit while the model
moves the plant confirms nothing. Where nothing holds, the next measurement is in doubt in
its turn, and the model as it was learned plans until one is explained. Steps in doubt may
end the use of a change, and never begin it, with one exception: where several outputs err
in the proportion in which an input acts on them, no single sensor is wrong, and the
change is tried for the one step until it is confirmed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property
from time import perf_counter
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2
from torch import Tensor

from gpmpc._angles import angles_of, state_difference
from gpmpc._dynamics import Array, DynamicsModel, Linearized, linearize, to_array
from gpmpc._kernels import Window
from gpmpc._kernels import linearize as linearize_gps
from gpmpc.exceptions import DataError, SettingError, UnsupportedModel, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, SlidingWindow, Transitions
from gpmpc.gp._online import least_informative
from gpmpc.models import Features
from gpmpc.models._wrapper import Wrapper
from gpmpc.mpc import Decision, Reference
from gpmpc.mpc._controller import check_arguments, check_method
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.signals import Signals
from gpmpc.simulation import Rollout
from gpmpc.status import Status

# differences of errors that say how large the noise is
_FEW = 3
_MANY = 100
_LARGEST = 10.0  # difference of log densities that one step counts for: no outlier decides alone
_MISALIGNED = 0.1  # part of errors that no input explains, in deviations, at most
_PATIENCE = 2  # further confirmations for steps that nothing explained, at most


@dataclass(frozen=True)
class OnlineLearning:
    """How a change is learned while flying; ``SettingError`` where a number is out of range or a rule unknown."""

    points: int = 40  #: of the change, at most; where there would be more, a fifth goes
    #: which go: ``"oldest"`` or ``"least_informative"``; see ``SlidingWindow``
    remove: Literal["oldest", "least_informative"] = "oldest"
    share: float = (
        0.1  #: by how much the plant may differ, as a share of what was learned
    )
    memory: float = 5000.0  #: length-scale of time in the kernel [steps]
    window: int = 20  #: steps over which predictions are compared
    margin: float = (
        20.0  #: lead of the summed log densities from which on the change is used
    )
    #: squared error of an output over its expectation, from which on a step is in doubt
    surprise: float = 30.0

    def __post_init__(self) -> None:
        SlidingWindow(self.points, self.remove)
        check_number("window", self.window, least=1, whole=True)
        for key in ("share", "memory", "surprise"):
            check_number(key, getattr(self, key), above=0)
        check_number("margin", self.margin, least=0)

    def learn(self, learned: "Learned", input: Array, state: Array) -> "Learned":
        """Learns from one step of a flight.

        Args:
            learned: What the steps before have taught.
            input: That was applied (m,).
            state: Measured after it (n,).
        """
        input = np.asarray(input, dtype=float)
        point, error, latent = learned.model.error(learned.state, input, state)
        spread = _with_difference(learned, error)
        seen = learned.with_measurement(state, error, spread)
        if len(spread) < _FEW:
            return seen.later()
        noise = _noise_variance(spread, learned.model)
        step = LearningStep(learned.state, input, state, point, error, latent, noise)
        comparison = learned.model.compare(step)
        if learned.doubt is not None:
            return self._resolve(seen, step, comparison, learned.doubt)
        surprising = comparison.planned(learned.active).largest > self.surprise
        if not (surprising or step.repeats.all()):
            return self._accept(seen, comparison)
        expected = seen.expect(Expectation.certain(learned.state), step)
        if surprising or self._is_frozen(seen, step, expected):
            return self._hold(seen, step, comparison, expected)
        return seen.later()

    def _accept(self, seen: "Learned", comparison: "Comparison") -> "Learned":
        """Makes a step a point of the change, and says whether that is used."""
        unexplained = max(0, seen.unexplained - 1)
        trusted = replace(seen, model=comparison.model, unexplained=unexplained)
        return self._count(trusted, comparison.lead)

    def _count(self, seen: "Learned", lead: float) -> "Learned":
        """Uses the change or not, by its lead over the last steps with this one's."""
        leads = np.append(seen.leads, lead)[-self.window :]
        total = float(leads.sum())
        active = total >= 0 if seen.active else total > self.margin
        version = seen.version + (active or seen.active)
        return replace(seen, leads=leads, active=active, version=version).later()

    def _count_doubtful(self, seen: "Learned", lead: float) -> "Learned":
        """Counts a step in doubt, which may end the use of a change, not begin it."""
        return self._count(seen, lead) if seen.active else seen.later()

    def _hold(
        self,
        seen: "Learned",
        step: "LearningStep",
        comparison: "Comparison",
        expected: "Expectation",
    ) -> "Learned":
        """Holds a measurement back that no prediction explains.

        ``expected`` is where the plant is if all measurements in doubt are wrong.
        """
        unexplained = seen.unexplained
        steps = 1
        spread = seen.spread[:-1]
        if seen.doubt is not None:
            unexplained = min(unexplained + 1, _PATIENCE)
            steps = seen.doubt.steps + 1
            spread = seen.doubt.spread
        change = None
        missing = 1 + unexplained
        if not self._is_frozen(seen, step, expected):
            alone = seen.model.forgotten().compare(step)
            change = alone.model.later(1.0)
            missing += int(alone.with_change.largest / self.surprise)
        plans = change is not None and missing == 1
        if plans:
            innovation = comparison.planned(seen.active)
            reach = seen.model.arrays[1]
            plans = self._acts_like_input(innovation, reach @ expected.by_input)
        doubt = Doubt(expected, spread, change, missing, steps, plans)
        version = seen.version + plans
        held = replace(seen, unexplained=unexplained, doubt=doubt, version=version)
        return self._count_doubtful(held, comparison.lead)

    def _acts_like_input(self, innovation: "Innovation", by_input: Array) -> bool:
        """Whether errors stand in several outputs, and as inputs would act on them.

        One wrong sensor is wrong alone, and several are not wrong in that proportion.

        Args:
            innovation: Of the model that plans.
            by_input: Derivative of what it predicted by the input (k, m).
        """
        deviation = np.sqrt(innovation.variance)
        errors = innovation.error / deviation
        effects = by_input / deviation[:, None]
        shares, _, rank, _ = np.linalg.lstsq(effects, errors, rcond=None)
        several = np.count_nonzero(errors**2 > self.surprise) > 1
        remaining = np.linalg.norm(errors - effects @ shares)
        aligned = remaining <= _MISALIGNED * np.linalg.norm(errors)
        return bool(several and aligned and rank < len(errors))

    def _is_frozen(
        self, seen: "Learned", step: "LearningStep", expected: "Expectation"
    ) -> bool:
        """Whether a sensor repeats itself to the last digit while the plant moves."""
        motion = state_difference(expected.mean, step.state, seen.model.angles)
        moves = motion**2 > self.surprise * np.diagonal(expected.covariance)
        return bool((moves & step.repeats).any())

    def _resolve(
        self,
        seen: "Learned",
        step: "LearningStep",
        comparison: "Comparison",
        doubt: "Doubt",
    ) -> "Learned":
        """Explains the measurement in doubt by the one after it."""
        expected = seen.expect(doubt.expected, step)
        wrong = seen.innovation(expected)
        moved = comparison.planned(seen.active)
        least = max(wrong.log_density, moved.log_density) + _LARGEST
        change = self._confirmed(doubt, step, least)
        if change is not None and doubt.missing == 1:
            return self._adopt(seen, change)
        if change is not None:
            later = change.later(1.0)
            missing = doubt.missing - 1
            steps = doubt.steps + 1
            doubt = Doubt(expected, doubt.spread, later, missing, steps)
            return self._count_doubtful(replace(seen, doubt=doubt), comparison.lead)
        if min(moved.largest, wrong.largest) <= self.surprise:
            trusted = seen.without_doubt(doubt)
            return self._count_doubtful(trusted, comparison.lead)
        return self._hold(seen, step, comparison, expected)

    def _confirmed(
        self, doubt: "Doubt", step: "LearningStep", least: float
    ) -> "ChangedModel | None":
        """The change of a doubt with a step that it explains; None where it does not.

        ``least`` is the log density that it has to exceed.
        """
        if doubt.change is None or step.repeats.all():
            return None
        comparison = doubt.change.compare(step)
        innovation = comparison.with_change
        explains = innovation.largest <= self.surprise
        if explains and innovation.log_density > least:
            return comparison.model
        return None

    def _adopt(self, seen: "Learned", change: "ChangedModel") -> "Learned":
        """Forgets what was seen, and uses the change of another plant."""
        version = seen.version + 1
        leads = seen.leads[:0]
        other = replace(seen, model=change, leads=leads, version=version, doubt=None)
        return replace(other, active=True).later()


class Innovation(NamedTuple):
    """By how much a prediction missed what was measured."""

    error: Array  #: (k,)
    variance: Array  #: that was expected of it (k,)

    @property
    def largest(self) -> float:
        """The largest squared error over its variance."""
        return float((self.error**2 / self.variance).max())

    @property
    def log_density(self) -> float:
        """Of the error, as independent Gaussians, but for a constant."""
        squares = self.error**2 / self.variance
        return -0.5 * float((squares + np.log(self.variance)).sum())


class LearningStep(NamedTuple):
    """A step of a flight, and what it says of the change."""

    state: Array  #: measured before it (n,)
    input: Array  #: applied (m,)
    next_state: Array  #: measured after it (n,)
    point: Array  #: (phi, u, t), where d is seen (d,)
    error: Array  #: of the model alone, as far as a change reaches it (k,)
    latent: Array  #: variance of the model alone (k,)
    noise: Array  #: variance of the noise of this flight (k,)

    @property
    def repeats(self) -> NDArray[np.bool_]:
        """Which sensors show the same as before, to the last digit (n,)."""
        return self.state == self.next_state


class Comparison(NamedTuple):
    """What the model with its change and the one without missed of a step."""

    with_change: Innovation
    without_change: Innovation
    model: "ChangedModel"  #: with the step as a further point of its change

    def planned(self, active: bool) -> Innovation:
        """Of the model that plans."""
        return self.with_change if active else self.without_change

    @property
    def lead(self) -> float:
        """By how much the change's log density is larger, as far as a step counts."""
        lead = self.with_change.log_density - self.without_change.log_density
        return max(-_LARGEST, min(lead, _LARGEST))


class Expectation(NamedTuple):
    """Where the plant is, as far as that is known."""

    mean: Array  #: of the state (n,)
    covariance: Array  #: (n, n)
    by_input: Array  #: derivative of the mean by the last input (n, m)

    @classmethod
    def certain(cls, state: Array) -> "Expectation":
        """Of a state that is known."""
        n = len(state)
        return cls(state, np.zeros((n, n)), np.zeros((n, 0)))


class Doubt(NamedTuple):
    """A measurement that is held back until the next one explains it."""

    expected: Expectation  #: where the plant is if the measurement was wrong
    spread: Array  #: of ``Learned`` without the steps in doubt (w,)
    #: the model whose change only the steps in doubt have taught, in case that the plant
    #: is another one; None where they teach nothing
    change: "ChangedModel | None"
    missing: int  #: steps that have still to confirm that change
    steps: int  #: for which nothing has explained what is measured
    plans: bool = False  #: whether that change is used before it is confirmed


@dataclass(frozen=True)
class ChangedModel(Wrapper):
    """A model and its change.

    Raises:
        UnsupportedModel: Another model, or a ``ResidualModel`` whose B is a function of the state.
    """

    model: DynamicsModel  #: f: a ``GPPosterior`` of next states, or a ``ResidualModel``
    learning: OnlineLearning = field(
        default_factory=OnlineLearning
    )  #: how d is learned
    time: float = 0.0  #: t of all predictions [steps]
    #: further states that are angles, besides those of the model: a sensor may show them within a turn
    further_angles: Sequence[int] = ()

    def __post_init__(self) -> None:
        if (
            not isinstance(self.gp, GPPosterior)
            or self.gp.device.type != "cpu"
            or callable(self.B)
        ):
            rule = "learning while flying needs a GPPosterior or a ResidualModel with a constant B, in host memory"
            raise UnsupportedModel(f"{rule}; got {type(self.model).__name__}")

    @cached_property
    def gp(self) -> GPPosterior:
        """The GP that the model was learned with."""
        known: Any = getattr(self.model, "residual", self.model)
        return known

    @cached_property
    def features(self) -> Features:
        """What d sees of the state and the input."""
        n = self.model.state_dim
        m = self.model.input_dim
        model = cast(Any, self.model)
        return (
            Features(list(range(n)), list(range(m)), [], n, m)
            if self.gp is model
            else model.features
        )

    @cached_property
    def B(self) -> Tensor:
        """Where d acts (n, k)."""
        model = cast(Any, self.model)
        return (
            torch.eye(self.gp.output_dim, dtype=self.gp.dtype)
            if self.gp is model
            else model.B
        )

    @cached_property
    def angles(self) -> list[int]:  # type: ignore[override]
        """Indices of the states that are angles."""
        return sorted({*angles_of(self.model), *self.further_angles})

    @cached_property
    def arrays(self) -> tuple[Array, Array, Array]:
        """B (n, k), its pseudo-inverse, the part of an error of f that d can explain, and the noise of the GP (k,)."""
        B = to_array(self.B)
        return (
            B,
            np.asarray(np.linalg.pinv(B), dtype=np.float64),
            to_array(self.gp.noise_variance),
        )

    @cached_property
    def change(self) -> tuple[Window, Window | None]:
        """d: GPs over (phi, u, t), at first without points; and in the making those without the points that go next."""
        gp = self.gp
        scales = np.column_stack(
            [to_array(gp.lengthscales), np.full(gp.output_dim, self.learning.memory)]
        )
        window = Window.empty(scales, self.signal, gp.state_dim, self.learning.points)
        return window, None

    def __len__(self) -> int:
        return self.change[0].arrays.size

    def later(self, steps: float) -> "ChangedModel":
        """The model some steps later."""
        return self._replaced(time=self.time + steps)

    def _replaced(self, **changes: Any) -> "ChangedModel":
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__ | changes)
        return other

    def error(
        self, state: Array, input: Array, next_state: Array
    ) -> tuple[Array, Array, Array]:
        """The point (phi, u, t) (d,) of a transition, what d was there (k,), and the variance of f there (k,)."""
        states = state[None]
        inputs = input[None]
        reach = self.arrays[1]
        alone = linearize(self.model, states, inputs)
        z, v, _ = self.features.linearize(states, inputs)
        variance = ((reach @ cast(Array, alone.covariance)[0]) * reach).sum(1)
        missed = state_difference(next_state, alone.mean[0], self.angles)
        return np.concatenate([z[0], v[0], [self.time]]), reach @ missed, variance

    def with_point(self, point: Array, target: Array, noise: Array) -> "ChangedModel":
        """The model with a further point (phi, u, t) (d,) of the change, its target (k,) and its noise's variance (k,).

        Raises SettingError where the noise is too small.
        """
        (now, coming), new, most = (
            self.change,
            (point, target, noise),
            self.learning.points,
        )
        gone = max(1, most // 5)
        step = len(self) - (
            most - gone
        )  # of ``gone`` in which the factor without them is made
        if step > 0 and coming is None:
            oldest = self.learning.remove == "oldest"
            coming = now.without(
                range(gone) if oldest else least_informative(self.posterior, gone)
            )
        if coming is not None and step == gone:
            now = coming
            coming = None
        elif (
            coming is not None
        ):  # rows are as much work as their number's square: all steps have the same share
            coming = coming.append(
                *new, rows=int((most - gone) * (step / gone) ** (1 / 3))
            )
        return self._replaced(change=(now.append(*new), coming))

    def forgotten(self) -> "ChangedModel":
        """The model without any point of the change."""
        return replace(self)

    def compare(self, step: LearningStep) -> Comparison:
        """What a step, as the next point of the change, was predicted to be."""
        model = self.with_point(step.point, step.error, step.noise)
        error, variance = model.last_innovation()
        change = variance - step.noise
        remaining = self.remaining(step.latent, change, self.signal)
        with_change = Innovation(error, variance + remaining)
        without_change = Innovation(step.error, step.noise + step.latent)
        return Comparison(with_change, without_change, model)

    def last_innovation(self) -> tuple[Array, Array]:
        """Error and variance (k,) of the prediction of the last point of the change by those before, with its noise.

        With L the factor and v = L^-1 y, L_NN^2 is the variance, and v_N L_NN the error.
        """
        last = self.change[0].columns[:, len(self) - 1]
        root = last[:, len(self) - 1]
        return last[:, -1] * root, root**2

    def remaining(self, latent: Any, variance: Any, signal: Any) -> Any:
        """What the model alone does not know (*batch, k), less what d's points saw.

        Where its ``latent`` variance is more than d's prior variance, the ``signal``,
        it knows nothing, as where an input moves that its data held still. There an
        error teaches both at once, and of the excess as large a part is left as of the
        signal is in d's own ``variance``. All three are NumPy's arrays, or torch's.
        """
        excess = (latent - signal).clip(0.0)
        left = (variance / signal).clip(None, 1.0)
        return latent - excess * (1.0 - left)

    @cached_property
    def signal(self) -> Array:
        """The prior variances of d (k,)."""
        return self.learning.share**2 * to_array(self.gp.signal_variance)

    @property
    def posterior(self) -> GPPosterior:
        """The GPs of d as tensors."""
        gp = self.gp
        now = self.change[0]
        size = len(self)
        arrays, (k, d) = now.arrays, now.arrays.inverse_squares.shape
        parts = (
            arrays.points[:, :size].T,
            now.data[d : d + k, :size].T,
            arrays.inverse_squares**-0.5,
        )
        factor = now.columns[:, :size, :size].transpose(0, 2, 1)
        rest = (
            np.exp(arrays.log_signal),
            self.arrays[2],
            np.zeros(k),
            factor,
            arrays.weights[:, :size],
        )
        names = [field.name for field in fields(GPPosterior)]
        given: dict[str, Any] = dict(
            zip(names, map(torch.from_numpy, parts + rest), strict=False)
        )
        return GPPosterior(**given, input_dim=gp.input_dim + 1, predicts="value")

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations (n, n)."""
        return self.model.noise_covariance

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution at x (*batch, n) and u (*batch, m), without the noise."""
        belief = self.model.predict(state, input)
        if not len(self):
            return belief
        z, v = self.features(state, input)
        d = self.posterior.predict(
            z, torch.cat([v, torch.full_like(state[..., :1], self.time)], dim=-1)
        )
        reach = torch.as_tensor(self.arrays[1]).to(belief.mean)
        latent = ((reach @ belief.covariance) * reach).sum(-1)
        signal = torch.as_tensor(self.signal).to(belief.mean)
        variance = self.remaining(latent, d.variance, signal) + d.variance
        return Gaussian(
            belief.mean + d.mean @ self.B.mT,
            self.B @ torch.diag_embed(variance) @ self.B.mT,
        )

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises at K points (K, n), (K, m), the model and its change each by a method of their own."""
        found = linearize(self.model, states, inputs, covariance)
        change = self.change[0]
        if not len(self):
            return found
        z, v, slope = self.features.linearize(states, inputs)
        at = np.empty((len(v), v.shape[1] + 1))
        at[:, :-1] = v
        at[:, -1] = self.time
        offset = np.zeros(self.gp.output_dim)
        mean, by_state, by_input, variance = linearize_gps(
            change, z, at, covariance, offset, False
        )
        by_state, by_input = self.features.chain(by_state, by_input[..., :-1], slope)
        B, reach, _ = self.arrays
        V = found.covariance
        if V is not None and variance is not None:
            own = np.diagonal(variance, axis1=1, axis2=2)
            latent = ((reach @ V) * reach).sum(-1)
            own = own + self.remaining(latent, own, self.signal)
            V = (B * own[:, None, :]) @ B.T
        return Linearized(
            found.mean + mean @ B.T, found.A + B @ by_state, found.B + B @ by_input, V
        )


@dataclass(frozen=True)
class Learned:
    """What a flight has taught so far."""

    model: ChangedModel  #: with the change
    state: Array  #: measured at the last step (n,)
    error: Array  #: of the model alone in the last step, as far as a change reaches it (k,); NaN for unknown
    spread: Array  #: squared differences of successive errors over those expected of the model's noise (w,)
    leads: Array  #: by how much the log density with the change exceeds that without, of the last steps
    active: bool = False  #: whether the change is used
    version: int = 0  #: how often that model has changed
    #: steps that nothing has explained, less those that went as predicted since then
    unexplained: int = 0
    doubt: Doubt | None = None  #: where the last measurement is held back

    @property
    def planning(self) -> ChangedModel | None:
        """The model that plans now; None for the one without a change."""
        if self.doubt is not None and self.doubt.plans:
            return self.doubt.change
        lasting = self.doubt is not None and self.doubt.steps > 1
        return self.model if self.active and not lasting else None

    @property
    def size(self) -> int:
        """Points of the model that plans."""
        change = self.planning
        return len(self.model.gp) + (0 if change is None else len(change))

    def later(self) -> "Learned":
        """What was learned, a step later."""
        return replace(self, model=self.model.later(1.0))

    def with_measurement(self, state: Array, error: Array, spread: Array) -> "Learned":
        """What was learned, and what a further step has shown."""
        tried = self.doubt is not None and self.doubt.plans
        version = self.version + tried  # a change that was tried for a step ends
        return replace(self, state=state, error=error, spread=spread, version=version)

    def without_change(self) -> "Learned":
        """What was learned, where a decision with the change has failed."""
        doubt = None if self.doubt is None else self.doubt._replace(plans=False)
        version = self.version + 1
        return replace(self, active=False, version=version, doubt=doubt)

    def without_doubt(self, doubt: Doubt) -> "Learned":
        """What was learned, without the steps that were in doubt."""
        unknown = np.full_like(self.error, np.nan)
        return replace(self, error=unknown, spread=doubt.spread, doubt=None)

    def after_gap(self, state: Array) -> "Learned":
        """What was learned, where steps were not measured and a state (n,) is again.

        Nothing is known of the step that led to it.
        """
        error = np.full_like(self.error, np.nan)
        version = self.version + self.active
        other = replace(self, state=state, error=error, version=version, doubt=None)
        return other.later()

    def expect(self, start: Expectation, step: LearningStep) -> Expectation:
        """Where the plant is after a step from ``start``, by the change if it is used."""
        model = self.model if self.active else self.model.model
        local = linearize(model, start.mean[None], step.input[None])
        A = local.A[0]
        B = self.model.arrays[0]
        latent = cast(Array, local.covariance)[0]
        noise = (B * step.noise) @ B.T
        covariance = A @ start.covariance @ A.T + latent + noise
        return Expectation(local.mean[0], covariance, local.B[0])

    def innovation(self, expected: Expectation) -> Innovation:
        """Of the measured state, as far as a change reaches it."""
        reach = self.model.arrays[1]
        error = state_difference(self.state, expected.mean, self.model.angles)
        variance = ((reach @ expected.covariance) * reach).sum(1)
        return Innovation(reach @ error, variance)


class LearningController:
    """Controls by the model of a controller and by what the flight teaches about its change.

    What was learned travels with the decisions (``Decision.learned``): one controller flies any number of flights, and
    a flight begins where there is no decision before.

    Raises:
        SettingError: The controller cannot change its model.
        UnsupportedModel: No change of its model can be learned.
    """

    def __init__(self, controller: GPMPC, learning: OnlineLearning | None = None):
        check_method("controller", controller, "with_model", "GPMPC(...)")
        self.controller = controller
        self.learning = OnlineLearning() if learning is None else learning
        self.problem = controller.problem
        self.horizon = controller.horizon
        self.initial_input = controller.initial_input
        self.signals = controller.signals
        self._model = ChangedModel(
            controller.prediction.model,
            self.learning,
            further_angles=self.problem.cost.angles,
        )

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
    ) -> Decision:
        """Learns from the last step, and decides; see ``Controller.control``."""
        begin = perf_counter()
        check_arguments(belief, reference)
        if belief.names:
            belief = belief.in_order(self.signals.state_names)
        learned = self._learned(to_array(belief.mean).copy(), previous)
        controller = self.controller
        if learned.planning is not None:
            controller = self.controller.with_model(learned.planning)
        known = {} if parameters is None else {"parameters": parameters}
        seconds = perf_counter() - begin
        decision = controller.control(belief, reference, previous, **known)
        if learned.planning is not None and _has_failed(decision):
            seconds += decision.timing.total
            learned = learned.without_change()
            decision = self.controller.control(belief, reference, previous, **known)
        timing = replace(decision.timing, model=decision.timing.model + seconds)
        return replace(decision, timing=timing, learned=learned)

    def _learned(self, state: Array, previous: Decision | None) -> Learned:
        """What the flight has taught up to a measurement (n,)."""
        before = None if previous is None else previous.learned
        if previous is None or before is None:
            return self._begin(state)
        if not np.isfinite(state).all():
            return before.later()
        if not np.array_equal(previous.means[0], before.state):
            return before.after_gap(state)
        try:
            return self.learning.learn(before, previous.input, state)
        except (SettingError, DataError):
            # The points contradict each other beyond double precision.
            return self._begin(state, before.version + 1)

    def _begin(self, state: Array, version: int = 0) -> Learned:
        unknown = np.full(len(self._model.arrays[2]), np.nan)
        return Learned(
            self._model, state, unknown, np.empty(0), np.empty(0), version=version
        )


def _has_failed(decision: Decision) -> bool:
    """Whether a decision on a finite measurement must not be applied."""
    failed = not decision.applicable
    return failed and decision.status is not Status.INVALID_MEASUREMENT


def _with_difference(learned: Learned, error: Array) -> Array:
    """Squared differences of successive errors (w,), with that of an error (k,)."""
    squares = (error - learned.error) ** 2 / learned.model.arrays[2]
    difference = float(squares.mean()) / 2.0
    if not np.isfinite(difference):
        return learned.spread
    return np.append(learned.spread, difference)[-_MANY:]


def _noise_variance(spread: Array, model: ChangedModel) -> Array:
    """The noise (k,) of the model, or of the last steps where that is more.

    What changes slowly has no part in differences of successive errors, and a jump no
    weight in their median.
    """
    noise = model.arrays[2]
    outputs = len(noise)
    middle = float(np.sort(spread)[len(spread) // 2])
    return noise * max(1.0, middle * outputs / _median(outputs))


@cache
def _median(degrees: int) -> float:
    return float(chi2.median(degrees))


@dataclass(frozen=True)
class EpisodicLearning:
    """Learns from one flight to the next: its transitions join the data, and a model is trained anew.

    Flights alone teach little of the derivatives that a controller needs (``gpmpc.datasets.Excitation``), so the
    earlier data stay. A model that predicts better may control worse, so the one whose flight had the smallest error
    flies the flight that counts. Where the plant is another one than that of the data, these contradict the flights:
    there ``OnlineLearning`` helps.
    """

    episodes: int = 2  #: flights before the one that counts: the first with the model of the data, two at least

    def __post_init__(self) -> None:
        check_number("learning.episodes", self.episodes, least=2, whole=True)

    def with_flight(self, data: Transitions, flight: Rollout) -> Transitions:
        """The data and the transitions of a flight, as far as they were measured."""
        known = np.all(np.isfinite(flight.measured), axis=1)
        rows = np.flatnonzero(np.logical_and(known[:-1], known[1:]))
        states = flight.measured[rows]
        inputs = flight.inputs[rows]
        after = flight.measured[rows + 1]
        flown = Signals(time_step=flight.time_step)
        data.signals.check("the data", flown, "the flight")
        return replace(
            data,
            states=torch.cat([data.states, torch.from_numpy(states)]),
            inputs=torch.cat([data.inputs, torch.from_numpy(inputs)]),
            next_states=torch.cat([data.next_states, torch.from_numpy(after)]),
        )
