"""A cascade of two controllers: a quadrotor's position is steered through its attitude, which is much faster.

The outer controller, on the translational subsystem, decides the thrust U1 and its direction (ux, uy), once a second
say; the direction, by eq. (2) of Cao, Lai and Alam (2017) inverted, is the attitude that the inner one, on the
rotational subsystem, takes the vehicle to at a rate of its own. (With the plant in the loop an inner loop at 1 Hz is
unworkable; 20 Hz flies well.) The references of the angular rates are those of a first-order approach to the attitude,
(angle_d - angle) / response time.
"""

from dataclasses import dataclass

import numpy as np

from gpmpc.exceptions import SettingError, check_number
from gpmpc.mpc.controller import Controller, Reference
from gpmpc.systems import ATTITUDES, attitude_at_yaw


@dataclass(frozen=True)
class Cascade:
    """An outer and an inner controller, and how the one's inputs are the other's references.

    Attributes:
        outer: On states x, vx, y, vy, z, vz [m, m/s] and inputs U1 [N], ux, uy [-].
        inner: On states phi, p, theta, q, psi, r [rad, rad/s] and inputs U2, U3, U4 [N].
        ratio: Inner steps an outer step.
        attitude: How thrust direction becomes attitude: ``"exact"`` or ``"paper"``; see
            ``attitude_for_thrust_direction``.
        response_time: Of the approach to a new attitude [s].

    Raises:
        SettingError: A ratio below 1, an unknown attitude, or a response time that is not positive.
    """

    outer: Controller
    inner: Controller
    ratio: int = 20
    attitude: str = "exact"
    response_time: float = 0.1  # [s]

    def __post_init__(self) -> None:
        check_number("ratio", self.ratio, least=1, whole=True)
        if self.attitude not in ATTITUDES:
            raise SettingError("attitude", f"must be one of {', '.join(ATTITUDES)}; got {self.attitude!r}")
        check_number("response_time", self.response_time, above=0, unit="[s]")

    def attitude_reference(self, planned: np.ndarray, angles: np.ndarray, phase: int) -> Reference:
        """What the inner controller is to follow.

        Args:
            planned: The outer plan's inputs from the current outer step on (H, 3); the inner horizon looks beyond the
                first where it reaches the next outer step, and holds the last.
            angles: Roll, pitch and yaw now (3,) [rad]; yaw is to be zero.
            phase: Inner steps since the outer step began.

        Returns:
            Over the inner horizon, with no moments as the inputs that belong to it.
        """
        ahead = phase + np.arange(self.inner.horizon + 1)
        direction = planned[np.minimum(ahead // self.ratio, len(planned) - 1)]
        states = np.zeros((len(ahead), 6))
        states[:, [0, 2]] = attitude_at_yaw(direction[:, 1], direction[:, 2], angles[2], self.attitude)
        states[:, 1::2] = (states[:, ::2] - angles) / self.response_time
        return Reference(states, np.zeros((self.inner.horizon, 3)))
