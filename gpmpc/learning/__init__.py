"""Learning what has changed: within a flight, step by step, or from flight to flight.

Online learning (``OnlineLearning``, ``LearningController``) estimates the change d of
the plant since its model f was learned:

    x[k+1] = f(x[k], u[k]) + B d(phi(x[k], u[k]), t[k])

d is a GP over what the model's own GP sees, phi, and over the time t, so that it
forgets in its kernel (a product of kernels in space and time: Bartels, Lahr, Carron and
Zeilinger, 2026),

    k_a = share^2 sf2_a exp(-1/2 sum_d (phi_d - phi'_d)^2 / l_ad^2)
          exp(-1/2 (t - t')^2 / memory^2).

Length-scales and signal variances are the model's: the plant may differ by a share of
what was learned. Where nothing was seen lately d is zero, and with one point it is the
estimate of a constant disturbance.

Each step of the flight becomes a point of the change, whether the change is used or
not, but for the first three, those at which all sensors repeat themselves, and those in
doubt. The model with its change and the one without predict each step before they see
it: the change is used once its log densities, summed over a window of steps, lead by a
margin, and ceases to be used once they trail. The model's noise is scaled by what
successive errors differ by, in the median, where that is more. A decision that fails
with the change is taken without it.

One wrong measurement spoils two transitions, the one into it and the one out of it, and
their errors have opposite signs; those of another plant agree. So a measurement that
neither chance nor the noise of late explains is in doubt: it is held back, and teaches
nothing before the next one has explained it. That one is compared with three
predictions:

* over both steps, from the last state that was trusted: then the measurement between
  was wrong;
* over one step, from the measurement in doubt: then the plant was moved, or its sensor;
* over one step, from the measurement in doubt, by the change that the step into it has
  taught: then the plant is another one. What was seen before is forgotten, and this
  change is used at once.

Where one of the first two holds, both steps are left out. The third has to be better
than these by as much as one step may count for. It needs further confirmations: one for
each step that nothing has explained of late, two at most, as where a sensor is noisy or
shows another unit for a second, and one for every time that its square is ``surprise``
times what ``share`` expects. A sensor that repeats itself to the last digit while the
model moves the plant confirms nothing. Where nothing holds, the next measurement is in
doubt in its turn. A wrong measurement may fall together with a change: so the change of
another plant is also sought over the steps in doubt, as if it began with the first or
the last of them, and one that has been found is given a second step to be confirmed in.

Sensors are wrong one by one. Those that show what is expected are trusted, and the
others are in doubt; where other sensors are in doubt than a step before, another doubt
has begun. A measurement that only one sensor's word stands for is believed a step
later than one that several agree on.

The controller does not act on a sensor in doubt: it plans from where the model expects
the plant, given the trusted sensors, with the covariance of that, for two steps at
most. After them it acts on what is measured, with the model as it was learned, until
that is explained.
Where several outputs err in the proportion in which an input acts on them, no single
sensor is wrong: such a measurement is acted on, and the change that it shows is tried
until it is confirmed, or given up; so is one that then explains all outputs but one.
Steps in doubt may else end the use of a change, and
never begin it.

``_step`` holds this procedure, ``_changed_model`` the model f + B d, ``_state`` what
one step hands to the next.

Learning between flights (``EpisodicLearning``) adds their transitions to the data.
"""

from gpmpc.learning._changed_model import ChangedModel
from gpmpc.learning._controller import LearningController
from gpmpc.learning._episodic import EpisodicLearning
from gpmpc.learning._settings import OnlineLearning
from gpmpc.learning._state import LearningState
from gpmpc.learning._step import learn_from_step

__all__ = [
    "ChangedModel",
    "EpisodicLearning",
    "LearningController",
    "LearningState",
    "OnlineLearning",
    "learn_from_step",
]
