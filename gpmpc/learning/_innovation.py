"""Errors of predictions beside the variances that were expected of them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc._dynamics import Array

#: Largest difference of log densities that one step counts for: no outlier decides
#: alone.
LARGEST_LEAD = 10.0


class Innovation(NamedTuple):
    """The error of a prediction, and the variance that was expected of it."""

    error: Array  #: measured less predicted (k,)
    variance: Array  #: expected of the error (k,)

    @property
    def log_density(self) -> float:
        """Log density of the error, as independent Gaussians, up to a constant."""
        squares = self.error**2 / self.variance
        return -0.5 * float((squares + np.log(self.variance)).sum())


class LearningStep(NamedTuple):
    """A step of a flight, and what it says of the change."""

    state: Array  #: measured before it (n,)
    input: Array  #: applied (m,)
    next_state: Array  #: measured after it (n,)
    point: Array  #: (phi, u, t), where d is seen
    #: what d was there: the error of the model alone, as far as d can explain it (k,)
    observed_change: Array
    unexplained: Array  #: what d cannot explain of that error (n,)
    latent_variance: Array  #: variance of the model alone (k,)
    noise_variance: Array  #: variance of the noise of this flight (k,)
    further_noise: Array  #: variances of what scatters sensors besides (n,)
    follows_gap: bool  #: whether nothing was measured before it

    @property
    def repeats(self) -> NDArray[np.bool_]:
        """Which sensors show the same as before, to the last digit (n,)."""
        return self.state == self.next_state

    @property
    def teaches(self) -> bool:
        """Whether what was measured before and after it says anything of the change."""
        return not (self.follows_gap or self.repeats.all())
