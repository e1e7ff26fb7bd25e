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

The model with the change and the one without predict each step before they see it: the
change is used once its log densities, summed over a window of steps, lead by a margin,
and ceases to be used once they trail. A decision that fails with the change is taken
without it. The model's noise is scaled by what successive errors differ by, in the
median, where that is more; likewise the noise of states that d does not reach, by what
it leaves of errors.

What is measured may be wrong, and the plant may become another one. So the flight is
explained in several ways at once, each with its weight (a multiple-hypothesis filter:
Reid, 1979). An explanation holds where the plant is, and the change it has seen. At
each measurement it may go on in these ways:

* all sensors are right: the step becomes a point of the change;
* some sensors are wrong: each alone, or several, and always those that repeat
  themselves to the last digit while the model moves the plant. Where the plant is
  follows from the prediction and the others, with the covariance of that;
* the plant is another one: what was seen before is forgotten, and this change is used
  at once. It acts like an input, as other masses, actuators and winds do, or on each
  output for itself;
* the plant was moved: that teaches nothing.

Each way multiplies the weight by its likelihood: the density of what the trusted
sensors show, a broad density for each wrong one (``surprise``), and the prior
probability of what happened. The heaviest few go on; without a measurement, as they
predict. The controller plans by the heaviest one: with its model, from where it says
that the plant is. A choice that was wrong is corrected by the next measurements, with
what it has taught. Mostly nothing is odd, and there is one explanation.

What is assumed of sensors: their noise is white; what is wrong of them is wrong by more
than some four deviations, and in fewer than half of the last nine steps. More often it
counts as noise. An error that grows slowly is believed. One that stays the same for
some steps is taken for a plant that was moved: the loop then follows what is shown. The
first five measurements are believed, and always those of a sensor of which the model
says no noise. Where these are wrong, or a sensor drifts, a flight may be worse than
without learning. Nothing is learned where no two measurements follow each other, and a
late one counts as if it were not.

``_continuations`` weighs the ways to go on, ``_step`` keeps the heaviest and learns,
``_changed_model`` is the model f + B d, ``_state`` what one step hands to the next.

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
