"""What a flight has taught, and the measurement that is in doubt."""

from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from gpmpc._angles import state_difference
from gpmpc._dynamics import Array, DynamicsModel, linearize
from gpmpc.learning._changed_model import ChangedModel
from gpmpc.learning._innovation import Innovation, LearningStep


class Expectation(NamedTuple):
    """A prediction of where the plant is, some steps after a state that is known."""

    mean: Array  #: of the state (n,)
    covariance: Array  #: of the state (n, n)
    #: derivative of the mean by what all inputs since then are off by (n, m)
    by_input: Array
    #: derivative of the mean by a change d that acts since then (n, k)
    by_change: Array

    @classmethod
    def certain(cls, state: Array, change: ChangedModel) -> "Expectation":
        """Returns the expectation of a state (n,) that is known."""
        n = len(state)
        return cls(
            mean=state,
            covariance=np.zeros((n, n)),
            by_input=np.zeros((n, change.model.input_dim)),
            by_change=np.zeros((n, change.gp.output_dim)),
        )

    def conditioned_on(
        self, state: Array, trusted: NDArray[np.bool_], change: ChangedModel
    ) -> "Expectation":
        """Returns the expectation where some sensors are known to be right.

        Args:
            state: Measured (n,).
            trusted: Whether a sensor is right (n,).
            change: Knows which states are angles.
        """
        error = state_difference(state, self.mean, change.angles)
        of_trusted = self.covariance[:, trusted]
        gain = of_trusted @ np.linalg.pinv(of_trusted[trusted], hermitian=True)
        gain[trusted] = np.eye(int(np.count_nonzero(trusted)))
        # I - K C, what is left of an error before the trusted sensors are heard
        complement = np.eye(len(error))
        complement[:, trusted] -= gain
        mean = self.mean + gain @ error[trusted]
        mean[trusted] = state[trusted]
        return Expectation(
            mean=mean,
            covariance=complement @ self.covariance @ complement.T,
            by_input=complement @ self.by_input,
            by_change=complement @ self.by_change,
        )

    def after(
        self, step: LearningStep, model: DynamicsModel, change: ChangedModel
    ) -> "Expectation":
        """Predicts where the plant is after a step.

        Args:
            step: Of the flight; its input and noise count.
            model: That predicts: ``change``, or the one that this changes.
            change: Knows how d acts, and the noise of what is measured.
        """
        local = linearize(model, self.mean[None], step.input[None])
        A = local.A[0]
        B = change.B_array
        latent = cast(Array, local.covariance)[0]
        noise = (B * step.noise_variance) @ B.T + np.diag(change.further_noise)
        # An infinite slope, times what is certain, is no number.
        with np.errstate(invalid="ignore"):
            return Expectation(
                mean=local.mean[0],
                covariance=A @ self.covariance @ A.T + latent + noise,
                by_input=A @ self.by_input + local.B[0],
                by_change=A @ self.by_change + B,
            )


class NewPlant(NamedTuple):
    """Another plant that may explain what is in doubt."""

    model: ChangedModel  #: whose change only steps in doubt have taught
    #: where the plant is by it, if the last measurement is wrong; None if it is right
    expected: Expectation | None
    confirmations_left: int  #: steps that have still to confirm it
    tried: bool  #: whether it plans before it is confirmed

    def after(self, step: LearningStep) -> Expectation:
        """Predicts where the plant is after a step."""
        start = self.expected
        if start is None:
            start = Expectation.certain(step.state, self.model)
        return start.after(step, self.model, self.model)


class Doubt(NamedTuple):
    """A measurement that is held back until the next one explains it."""

    #: where the plant is if the sensors in doubt are wrong, and the others are not
    expected: Expectation
    trusted: NDArray[np.bool_]  #: sensors that show what is expected (n,)
    #: ``noise_ratios`` of the ``LearningState`` before the steps in doubt (w,)
    trusted_noise_ratios: Array
    #: those that the next step may confirm; none where the steps teach nothing
    new_plants: tuple[NewPlant, ...]
    steps_in_doubt: int  #: for which nothing has explained what is measured
    #: whether the controller acts on ``expected`` in the place of the measurement
    bridged: bool = False

    @property
    def tried_plant(self) -> NewPlant | None:
        """The new plant that plans before it is confirmed."""
        return next((plant for plant in self.new_plants if plant.tried), None)

    @property
    def assumed(self) -> Expectation | None:
        """What the controller acts on in the place of the measurement."""
        if self.tried_plant is not None:
            return self.tried_plant.expected
        return self.expected if self.bridged else None


@dataclass(frozen=True)
class LearningState:
    """What a flight has taught so far.

    Its model's time moves on once a step: every path through ``learn_from_step`` ends
    in one ``later``, and each new plant moves on where it is stored.

    What plans (``planning``) and from where (``assumed``, ``planned_state``):

    ===========================  ====================================  =================
    last measurement             model                                 state
    ===========================  ====================================  =================
    not in doubt                 with its change where it is active    measured
    in doubt, bridged            likewise                              expected
    in doubt, a new plant tried  the new plant's                       measured, or its
                                                                       expected one
    else, in doubt for one step  with its change where it is active    measured
    else, in doubt for longer    as it was learned                     measured
    ===========================  ====================================  =================
    """

    model: ChangedModel  #: the model with its change
    state: Array  #: the last one that was measured (n,)
    #: what d was in the last step (k,); NaN where it is unknown
    observed_change: Array
    #: squared differences of successive errors over those expected of the model's
    #: noise, of the last steps (w,)
    noise_ratios: Array
    #: by how much the log density with the change exceeds that without, of the last
    #: steps
    leads: Array
    #: whether the leads speak for the change; ``planning`` says what plans
    active: bool = False
    version: int = 0  #: how often the model that plans has changed
    #: steps that nothing has explained, less those that went as predicted since then
    unexplained_steps: int = 0
    doubt: Doubt | None = None  #: where the last measurement is held back
    #: what a loop applied at ``state`` in the place of a decision that failed there
    #: (m,); None where no decision failed, or ``state`` is older than a step
    input_of_policy: Array | None = None

    @classmethod
    def begin(
        cls, model: ChangedModel, state: Array, version: int = 0
    ) -> "LearningState":
        """Returns the state of a flight that begins at a measured state (n,)."""
        return cls(
            model=model,
            state=np.array(state, dtype=float),
            observed_change=np.full(len(model.gp_noise), np.nan),
            noise_ratios=np.empty(0),
            leads=np.empty(0),
            version=version,
        )

    @property
    def planning(self) -> ChangedModel | None:
        """The model that plans now; None for the one without a change.

        The model plans as it was learned from a second measurement that nothing
        explains, where that is not bridged.
        """
        doubt = self.doubt
        if doubt is None:
            return self.model if self.active else None
        if doubt.tried_plant is not None:
            return doubt.tried_plant.model
        unexplained = doubt.steps_in_doubt > 1 and not doubt.bridged
        return self.model if self.active and not unexplained else None

    @property
    def assumed(self) -> Expectation | None:
        """What is planned from in the place of the measurement, where that is wrong."""
        return None if self.doubt is None else self.doubt.assumed

    @property
    def planned_state(self) -> Array:
        """The state that is planned from (n,)."""
        return self.state if self.assumed is None else self.assumed.mean

    @property
    def sensors_in_doubt(self) -> NDArray[np.bool_]:
        """Which sensors (n,) show another state than is planned from."""
        return self.planned_state != self.state

    @property
    def _tries_new_plant(self) -> bool:
        """Whether another plant's model plans before it is confirmed."""
        return self.doubt is not None and self.doubt.tried_plant is not None

    @property
    def size(self) -> int:
        """Number of points of the model that plans."""
        change = self.planning
        return len(self.model.gp) + (0 if change is None else len(change))

    def later(self) -> "LearningState":
        """Returns the same a step later."""
        return replace(self, model=self.model.later(1.0), input_of_policy=None)

    def with_input_of_policy(self, input: Array) -> "LearningState":
        """Returns the same where a loop applies another input than was decided."""
        return replace(self, input_of_policy=input)

    def with_measurement(
        self, state: Array, observed_change: Array, noise_ratios: Array
    ) -> "LearningState":
        """Returns the state after a further measurement (n,)."""
        return replace(
            self,
            state=state,
            observed_change=observed_change,
            noise_ratios=noise_ratios,
            # Another model plans next, where a change was tried for a step.
            version=self.version + self._tries_new_plant,
        )

    def without_change(self) -> "LearningState":
        """Returns the state after a decision has failed.

        The change is not used for this decision, nor is anything assumed in the place
        of the measurement. The leads stay: they speak of predictions, and the next
        decision, elsewhere, may succeed with the change.
        """
        doubt = self.doubt
        if doubt is not None:
            plants = tuple(plant._replace(tried=False) for plant in doubt.new_plants)
            doubt = doubt._replace(new_plants=plants, bridged=False)
        return replace(self, active=False, version=self.version + 1, doubt=doubt)

    def without_doubt(self, doubt: Doubt) -> "LearningState":
        """Returns the state without the steps that were in doubt."""
        return replace(
            self,
            observed_change=np.full_like(self.observed_change, np.nan),
            noise_ratios=doubt.trusted_noise_ratios,
            doubt=None,
        )

    def after_gap(self, state: Array) -> "LearningState":
        """Returns the state after steps without a measurement, at the next one (n,).

        Nothing is known of the step that led to it.
        """
        after = replace(
            self,
            state=np.array(state, dtype=float),
            observed_change=np.full_like(self.observed_change, np.nan),
            # A change that is used, or was tried, is another one after the gap.
            version=self.version + (self.active or self._tries_new_plant),
            doubt=None,
        )
        return after.later()

    def expect(self, start: Expectation, step: LearningStep) -> Expectation:
        """Predicts where the plant is after a step from ``start``.

        The model is the one with the change if that is used.
        """
        model = self.model if self.active else self.model.model
        return start.after(step, model, self.model)

    def innovation(self, expected: Expectation) -> Innovation:
        """Computes the innovation of the measured state, as far as d can explain it."""
        error = state_difference(self.state, expected.mean, self.model.angles)
        return Innovation(
            error=self.model.B_inverse @ error,
            variance=self.model.explainable_variance(expected.covariance),
        )
