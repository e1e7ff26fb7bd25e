"""A double pendulum with one driven joint: unstable, and wild over a second."""

import numpy as np
import torch

from gpmpc.dynamics import Linearized
from gpmpc.gaussian import Gaussian

MASS, LENGTH, CENTRE, GRAVITY = (0.523, 0.626), 0.2, (0.2, 0.256), 9.81  # [kg], [m], [m], [m/s^2]
INERTIA = (0.0319, 0.0509)  # about the joints [kg m^2]
ACROBOT, PENDUBOT = 1, 0  # the driven joint: elbow, shoulder
UPRIGHT = np.array([np.pi, 0.0, 0.0, 0.0])  # angle from hanging down, relative angle of the second link; rates


def acceleration(q1, q2, v1, v2, u, joint):
    """Of both angles, from the equations of motion M(q) a = torques, without friction."""
    (m1, m2), (r1, r2), (I1, I2), g = MASS, CENTRE, INERTIA, GRAVITY
    h = m2 * LENGTH * r2
    M11, M12, M22 = I1 + I2 + m2 * LENGTH**2 + 2 * h * np.cos(q2), I2 + h * np.cos(q2), I2
    gravity = g * (m1 * r1 + m2 * LENGTH) * np.sin(q1), g * m2 * r2 * np.sin(q1 + q2)
    f1 = (u if joint == PENDUBOT else 0.0) + h * np.sin(q2) * (2 * v1 * v2 + v2**2) - gravity[0] - gravity[1]
    f2 = (u if joint == ACROBOT else 0.0) - h * np.sin(q2) * v1**2 - gravity[1]
    determinant = M11 * M22 - M12**2
    return (M22 * f1 - M12 * f2) / determinant, (M11 * f2 - M12 * f1) / determinant


def successor(x, u, joint, time_step=0.02, substeps=2):
    """The next states (..., 4) by Runge and Kutta's method, of states (..., 4) and torques (..., 1)."""

    def derivative(x):
        q1, q2, v1, v2 = np.moveaxis(x, -1, 0)
        return np.stack([v1, v2, *acceleration(q1, q2, v1, v2, u[..., 0], joint)], axis=-1)

    h = time_step / substeps
    for _ in range(substeps):
        k1 = derivative(x)
        k2 = derivative(x + h / 2 * k1)
        k3 = derivative(x + h / 2 * k2)
        k4 = derivative(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


class DoublePendulum:
    """The pendulum itself as a model without uncertainty, with exact derivatives (by a complex step)."""

    state_dim, output_dim, input_dim, dtype, device = 4, 4, 1, torch.float64, torch.device("cpu")
    noise_covariance = torch.zeros(4, 4)

    def __init__(self, joint):
        self.joint = joint

    def predict(self, state, input):
        mean = torch.as_tensor(successor(state.numpy(), input.numpy(), self.joint))
        return Gaussian(mean, torch.zeros(*mean.shape, 4))

    def linearize(self, states, inputs, covariance=True):
        z = np.concatenate([states, inputs], axis=1)[:, None] + 1e-30j * np.eye(5)  # (K, 5, 5): one direction a row
        J = np.ascontiguousarray(successor(z[..., :4], z[..., 4:], self.joint).imag.swapaxes(1, 2) / 1e-30)
        A, B = np.ascontiguousarray(J[:, :, :4]), np.ascontiguousarray(J[:, :, 4:])
        return Linearized(successor(states, inputs, self.joint), A, B, np.zeros((len(states), 4, 4)))
