"""A GP for somebody else's project: from a CSV recording to a forecast.

Run as `python examples/reuse_gp.py FOLDER` (the present folder by default); it writes
pendulum.csv, pendulum.safetensors and tube.png there. The recording is a simulated
damped pendulum, pushed at random and measured with noise.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.gp import Transitions, load_posterior, save_posterior, train
from gpmpc.propagation import MomentMatching, rollout

STEP = 0.1  # sampling time [s]
folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
rng = np.random.default_rng(0)


def pendulum(torques: np.ndarray, angle: float, rate: float) -> np.ndarray:
    """Measured angle [rad] and rate [rad/s] (K + 1, 2) under torques [N m] (K,)."""
    states = [(angle, rate)]
    for torque in torques:
        for _ in range(20):  # semi-implicit Euler steps
            rate += STEP / 20 * (torque - 0.4 * rate - 4.0 * np.sin(angle))
            angle += STEP / 20 * rate
        states.append((angle, rate))
    return np.array(states) + rng.normal(0, 0.01, (len(states), 2))


torques = np.repeat(rng.uniform(-4, 4, 34), 3)
log = np.column_stack([pendulum(torques, 0.5, 0.0)[:-1], torques])
np.savetxt(
    folder / "pendulum.csv", log, delimiter=",", header="angle,rate,torque", comments=""
)

# A project with a recording starts here: read it, train, save ...
data = Transitions.from_csv(
    folder / "pendulum.csv", states=["angle", "rate"], inputs=["torque"]
)
units = {"states": {"angle": "rad", "rate": "rad/s"}, "inputs": {"torque": "N m"}}
save_posterior(train(data).posterior, folder / "pendulum.safetensors", metadata=units)

# ... and later, or elsewhere: load, and forecast 20 steps from an uncertain start.
gp = load_posterior(folder / "pendulum.safetensors")
push = np.where(np.arange(20) < 8, 2.5, -1.0)  # [N m]
start = Gaussian(
    torch.tensor([1.0, 0.0]).double(),
    torch.diag(torch.tensor([0.1, 0.2]).double() ** 2),
)
forecast = rollout(MomentMatching(), gp, start, torch.from_numpy(push)[:, None])

plt.style.use("gpmpc.plotting.gpmpc")
(figure, axes), times = (
    plt.subplots(2, 1, sharex=True, figsize=(7, 4.6)),
    STEP * np.arange(21),
)
runs = [pendulum(push, *rng.normal([1.0, 0.0], [0.1, 0.2])) for _ in range(15)]
for i, (axis, label) in enumerate(
    zip(axes, ("angle [rad]", "rate [rad/s]"), strict=True)
):
    mean = np.append(start.mean[i], forecast.mean[:, i])
    reach = 1.96 * np.sqrt(np.append(start.variance[i], forecast.variance[:, i]))
    axis.plot(times, mean, color="C0", linewidth=2, zorder=3, label="forecast")
    axis.fill_between(
        times,
        mean - reach,
        mean + reach,
        color="C5",
        alpha=0.5,
        linewidth=0,
        label="95 % of what may come",
    )
    lines = axis.plot(times, np.array(runs)[:, :, i].T, color="0.35", linewidth=0.6)
    lines[0].set_label("what happens")
    axis.set_ylabel(label)
axes[0].set_title(
    "A pendulum from an uncertain start: 15 runs, and their forecast by moment matching"
)
figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
axes[1].set_xlabel("time [s]")
figure.savefig(folder / "tube.png")
