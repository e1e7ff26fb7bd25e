"""A double pendulum with one driven joint: unstable, and wild over a second."""

import numpy as np
import torch
from numba import njit

from gpmpc.gaussian import Gaussian
from gpmpc.models import Linearized

# [kg], [m], [m], [m/s^2]
MASS = (0.523, 0.626)
LENGTH = 0.2
CENTRE = (0.2, 0.256)
GRAVITY = 9.81
INERTIA = (0.0319, 0.0509)  # about the joints [kg m^2]
# the driven joint: shoulder, elbow
PENDUBOT = 0
ACROBOT = 1
UPRIGHT = np.array(
    [np.pi, 0.0, 0.0, 0.0]
)  # angle from hanging down, relative angle of the second link; their rates
STEP = 1e-30


@njit
def derivative(x, u, joint):
    """From the equations of motion M(q) a = torques, without friction; complex numbers
    allowed."""
    (m1, m2), (r1, r2), (I1, I2) = MASS, CENTRE, INERTIA
    q1, q2, v1, v2 = x
    h = m2 * LENGTH * r2
    M11 = I1 + I2 + m2 * LENGTH**2 + 2 * h * np.cos(q2)
    M12 = I2 + h * np.cos(q2)
    M22 = I2
    gravity1 = GRAVITY * (m1 * r1 + m2 * LENGTH) * np.sin(q1)
    gravity2 = GRAVITY * m2 * r2 * np.sin(q1 + q2)
    f1 = (
        h * np.sin(q2) * (2 * v1 * v2 + v2 * v2)
        - gravity1
        - gravity2
        + (0.0 * u if joint == ACROBOT else u)
    )
    f2 = -h * np.sin(q2) * v1 * v1 - gravity2 + (u if joint == ACROBOT else 0.0 * u)
    determinant = M11 * M22 - M12 * M12
    return np.array(
        [
            v1,
            v2,
            (M22 * f1 - M12 * f2) / determinant,
            (M11 * f2 - M12 * f1) / determinant,
        ]
    )


@njit
def advance(x, u, joint):
    """The state 20 ms later, by Runge and Kutta's method."""
    h = 0.01
    for _ in range(2):
        k1 = derivative(x, u, joint)
        k2 = derivative(x + h / 2 * k1, u, joint)
        k3 = derivative(x + h / 2 * k2, u, joint)
        k4 = derivative(x + h * k3, u, joint)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


@njit
def expand_at(states, inputs, joint):
    """Next states, and their exact derivatives, by a complex step in each direction."""
    K = len(states)
    mean = np.empty((K, 4))
    A = np.empty((K, 4, 4))
    B = np.empty((K, 4, 1))
    for k in range(K):
        mean[k] = advance(states[k] + 0j, inputs[k, 0] + 0j, joint).real
        for j in range(4):
            x = states[k] + 0j
            x[j] += STEP * 1j
            A[k, :, j] = advance(x, inputs[k, 0] + 0j, joint).imag / STEP
        B[k, :, 0] = (
            advance(states[k] + 0j, inputs[k, 0] + STEP * 1j, joint).imag / STEP
        )
    return mean, A, B


class DoublePendulum:
    """The pendulum itself as a model without uncertainty."""

    state_dim = 4
    output_dim = 4
    input_dim = 1
    dtype = torch.float64
    device = torch.device("cpu")
    noise_covariance = torch.zeros(4, 4)

    def __init__(self, joint):
        self.joint = joint

    def predict(self, state, input):
        mean = expand_at(
            state.reshape(-1, 4).numpy(), input.reshape(-1, 1).numpy(), self.joint
        )[0]
        return Gaussian(
            torch.as_tensor(mean).reshape(state.shape), torch.zeros(*state.shape, 4)
        )

    def linearize(self, states, inputs, covariance=True):
        return Linearized(
            *expand_at(states, inputs, self.joint), np.zeros((len(states), 4, 4))
        )

    def successor(self, x, u):
        """x+ (4,) of a state (4,) and a torque (1,)."""
        return advance(x + 0j, u[0] + 0j, self.joint).real
