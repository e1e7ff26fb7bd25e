"""What a flight has taught: the explanations of what was measured."""

from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from gpmpc._dynamics import Array, linearize, to_array
from gpmpc.learning._changed_model import ChangedModel
from gpmpc.mpc._sqp import FAILURES


class Expectation(NamedTuple):
    """Where the plant is."""

    mean: Array  #: of the state (n,)
    covariance: Array  #: of the state (n, n); zero where all sensors are believed

    @classmethod
    def certain(cls, state: Array) -> "Expectation":
        """Returns the expectation of a state (n,) that is known."""
        return cls(mean=state, covariance=np.zeros((len(state), len(state))))

    @property
    def is_certain(self) -> bool:
        """Whether the state is known."""
        return not self.covariance.any()

    def conditioned_on(
        self, error: Array, measured: Array, trusted: NDArray[np.bool_]
    ) -> "Expectation":
        """Returns the expectation where some sensors are known to be right.

        Args:
            error: Measured less expected (n,).
            measured: State (n,).
            trusted: Whether a sensor is right (n,).
        """
        of_trusted = self.covariance[:, trusted]
        gain = of_trusted @ np.linalg.pinv(of_trusted[trusted], hermitian=True)
        gain[trusted] = np.eye(int(np.count_nonzero(trusted)))
        # I - K C, what is left of an error before the trusted sensors are heard
        complement = np.eye(len(error))
        complement[:, trusted] -= gain
        mean = self.mean + gain @ error[trusted]
        mean[trusted] = measured[trusted]
        covariance = complement @ self.covariance @ complement.T
        return Expectation(mean, covariance)


@dataclass(frozen=True, eq=False)
class Explanation:
    """One explanation of all that was measured."""

    model: ChangedModel  #: the model, with the change that this explanation has seen
    expected: Expectation  #: where the plant is
    #: by how much the log density with the change exceeds that without, of the last
    #: steps
    leads: Array
    active: bool = False  #: whether the change is used
    log_weight: float = 0.0  #: over that of the heaviest explanation
    #: time at which the plant became the one that it is [steps]; None if it always was
    began: float | None = None
    #: time at which the plant was last moved by a push [steps]; None if it never was
    pushed: float | None = None
    #: steps for which it has agreed with a heavier one that all sensors are right
    agreed_steps: int = 0

    @classmethod
    def begin(cls, model: ChangedModel, state: Array) -> "Explanation":
        """Returns the explanation of a state (n,) that is the first."""
        return cls(model, Expectation.certain(state), leads=np.empty(0))

    @property
    def planning(self) -> ChangedModel | None:
        """The model that plans by this explanation; None for the one as learned."""
        return self.model if self.active else None

    def later(self, input: Array) -> "Explanation":
        """Returns the same a step later, where nothing was measured.

        Args:
            input: Applied in the step (m,).
        """
        model = self.model
        planning = model if self.active else model.model
        local = linearize(planning, self.expected.mean[None], input[None])
        A = local.A[0]
        moved = A @ self.expected.covariance @ A.T
        noise = to_array(model.noise_covariance)
        covariance = moved + cast(Array, local.covariance)[0] + noise
        expected = Expectation(local.mean[0], covariance)
        return replace(self, model=model.later(1.0), expected=expected)

    def believing(self, state: Array) -> "Explanation":
        """Returns the same where the plant is known to be at a state (n,)."""
        return replace(self, expected=Expectation.certain(state))

    def with_lead(self, lead: float) -> "Explanation":
        """Decides whether the change is used, by its lead over the last steps."""
        settings = self.model.learning
        leads = np.append(self.leads, lead)[-settings.window :]
        total = float(leads.sum())
        active = total >= 0 if self.active else total > settings.margin
        return replace(self, leads=leads, active=active)


@dataclass(frozen=True, eq=False)
class LearningState:
    """What a flight has taught so far.

    The controller plans by the heaviest explanation: with its model (``planning``), and
    from where it says that the plant is (``assumed``, ``planned_state``).
    """

    explanations: tuple[Explanation, ...]  #: heaviest first; one where nothing is odd
    #: measured (n,); where nothing was, what is expected, and NaN of sensors that were
    #: in doubt
    state: Array
    #: what d was in the last step whose start is known, by the heaviest explanation of
    #: that (k,); NaN before the first
    observed_change: Array
    #: likewise in the last step of which all sensors were believed (k,)
    believed_change: Array
    #: squared differences of successive errors over those expected of the model's
    #: noise, of the last steps (w, k)
    noise_ratios: Array
    #: squared errors that d cannot explain over those expected of the model's noise, of
    #: the last steps (w, n); none where d explains all
    further_ratios: Array
    version: int = 0  #: how often the model that plans has changed
    #: what a loop applied at ``state`` in the place of a decision (m,); None where it
    #: was decided, or nobody knows
    input_of_policy: Array | None = None
    is_gap: bool = False  #: whether nothing was measured at ``state``
    #: whether the decision by the heaviest explanation has failed: what is measured is
    #: acted on, with the model as it was learned
    has_failed: bool = False

    @classmethod
    def begin(
        cls, model: ChangedModel, state: Array, version: int = 0
    ) -> "LearningState":
        """Returns the state of a flight that begins at a measured state (n,)."""
        state = np.array(state, dtype=float)
        outputs = len(model.gp_noise)
        return cls(
            explanations=(Explanation.begin(model, state),),
            state=state,
            observed_change=np.full(outputs, np.nan),
            believed_change=np.full(outputs, np.nan),
            noise_ratios=np.empty((0, outputs)),
            further_ratios=np.empty((0, len(state))),
            version=version,
        )

    @property
    def heaviest(self) -> Explanation:
        """The explanation that plans."""
        return self.explanations[0]

    @property
    def model(self) -> ChangedModel:
        """The model with its change, by the heaviest explanation."""
        return self.heaviest.model

    @property
    def active(self) -> bool:
        """Whether the change is used."""
        return self.planning is not None

    @property
    def leads(self) -> Array:
        """Leads of the change, by the heaviest explanation."""
        return self.heaviest.leads

    @property
    def planning(self) -> ChangedModel | None:
        """The model that plans now; None for the one without a change."""
        return None if self.has_failed else self.heaviest.planning

    @property
    def assumed(self) -> Expectation | None:
        """What is planned from in the place of the measurement, where that is wrong."""
        expected = self.heaviest.expected
        return None if self.has_failed or expected.is_certain else expected

    @property
    def planned_state(self) -> Array:
        """The state that is planned from (n,)."""
        return self.state if self.assumed is None else self.assumed.mean

    @property
    def sensors_in_doubt(self) -> NDArray[np.bool_]:
        """Which sensors (n,) show another state than is planned from."""
        return self.planned_state != self.state

    @property
    def size(self) -> int:
        """Number of points of the model that plans."""
        change = self.planning
        return len(self.model.gp) + (0 if change is None else len(change))

    def later(self, input: Array) -> "LearningState":
        """Returns the state a step later, where nothing was measured.

        Args:
            input: Applied in the step (m,).
        """
        try:
            explanations = tuple(one.later(input) for one in self.explanations)
        except FAILURES:  # where the model has no number, or no slope
            return self.after_gap(np.full_like(self.state, np.nan))
        expected_state = explanations[0].expected.mean
        return replace(
            self,
            explanations=explanations,
            state=np.where(self.sensors_in_doubt, np.nan, expected_state),
            is_gap=True,
            version=self.version + self.active,
            input_of_policy=None,
        )

    def with_input_of_policy(self, input: Array) -> "LearningState":
        """Returns the same where a loop applies another input than was decided."""
        return replace(self, input_of_policy=input)

    def with_explanations(
        self, explanations: tuple[Explanation, ...]
    ) -> "LearningState":
        """Returns the state with the explanations of one more step, and after it."""
        return replace(
            self,
            explanations=tuple(
                replace(one, model=one.model.later(1.0)) for one in explanations
            ),
            version=self.version + (self.active or explanations[0].active),
            input_of_policy=None,
        )

    def without_change(self) -> "LearningState":
        """Returns the state after a decision has failed.

        The change is not used for this decision, nor is anything assumed in the place
        of the measurement. The explanations stay: they speak of predictions, and the
        next decision, elsewhere, may succeed.
        """
        return replace(self, version=self.version + 1, has_failed=True)

    def after_gap(self, state: Array) -> "LearningState":
        """Returns the state after a step of which nobody knows what led to its end.

        Args:
            state: Measured there (n,); NaN where nothing was.
        """
        state = np.array(state, dtype=float)
        at_measurement = replace(self, state=state, is_gap=False, has_failed=False)
        return at_measurement.with_explanations((self.heaviest.believing(state),))
