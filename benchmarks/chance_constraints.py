"""How often a bound is violated that may be with probability 1 - eta, at decisions whose plan touches it.

    .venv/bin/python -m benchmarks.chance_constraints [--steps 1100] [--seeds 20] [--ways ...] [--kinds ...]

The pendulum of ``benchmarks.estimation``, learned from 200 of 600 rows, is to hold an angle beyond an upper bound of
the next state. Its noise is Gaussian, of heavy tails (Student's t, 3 degrees of freedom), or an AR(1) process
(correlation 0.6), of equal variance. Compared: the noise that the GP learned by its evidence; the one estimated from
all rows; the latter with an adaptive conformal tube that begins with a Gaussian's quantiles and aims so low that the
upper limit of all decisions is allowed; and the true noise with its true quantile. Printed for eta = 90, 95 and 99 %:
violations per hundred decisions at an active bound, the exact upper 95 % limit of the rate (Clopper and Pearson, 1934;
for independent decisions), the mean distance of the angle to the bound [mrad], and the mean cost of a step. Writes
``outputs/benchmarks/chance_constraints.json``.
"""

import argparse
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import torch
from scipy.stats import beta, t

from benchmarks.estimation import HORIZON, LIMIT, NOISE, pendulum, random_motion
from benchmarks.timing import write_results
from gpmpc.estimation import AdaptiveTube, ConformalTube, estimate_process_noise
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc.controller import Reference
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.mpc.problem import Box, Problem, Tracking
from gpmpc.propagation import Linearization

UPPER, TARGET, SCORES = 0.6, 0.9, 399
WAYS = ("learned noise", "estimated noise", "estimated noise, adaptive", "true noise")
KINDS = ("Gaussian", "heavy tails", "AR(1)")
Array = np.ndarray


def plant_noise(kind: str, steps: int, rng: np.random.Generator) -> Array:
    """Noise of every step (steps, 2) [rad, rad/s], of the standard deviations ``NOISE``."""
    if kind == "heavy tails":
        return NOISE * rng.standard_t(3, (steps, 2)) / np.sqrt(3)
    white = rng.normal(0, NOISE, (steps, 2))
    if kind == "Gaussian":
        return white
    noise = white.copy()
    for k in range(1, steps):
        noise[k] = 0.6 * noise[k - 1] + 0.8 * white[k]
    return noise


def log(kind: str, steps: int = 600) -> Transitions:
    """Random motion with a kind of noise."""
    _, inputs = random_motion(steps, 0)
    states = [np.zeros(2)]
    for u, w in zip(inputs, plant_noise(kind, steps, np.random.default_rng(1)), strict=True):
        states.append(pendulum(states[-1], u) + w)
    return Transitions(np.array(states[:-1]), inputs, np.array(states[1:]))


def quantile(kind: str, eta: float) -> float:
    """Of the noise of a step, in its standard deviations."""
    return float(t.ppf(eta, 3) / np.sqrt(3)) if kind == "heavy tails" else NormalDist().inv_cdf(eta)


def fly(model: ResidualModel, kind: str, eta: float, way: str, steps: int, seeds: int) -> tuple[int, int, float, float]:
    """Violations, decisions at the bound, mean distance of the angle to it, and mean cost of a step."""
    bound = Box([-np.inf, -np.inf], [UPPER, np.inf], probability=eta, stages=[1])
    problem = Problem(Tracking([10.0, 0.1], [1e-2]), Box([-LIMIT], [LIMIT]), constraints=[bound])
    controller = GPMPC(model, Linearization(process_noise=True), problem, HORIZON, [0.0])
    quantiles = [NormalDist().inv_cdf((i + 1) / (SCORES + 1)) for i in range(SCORES)]
    scores = ConformalTube(np.tile(quantiles, (HORIZON, 1)).T, [[1.0, 0.0]])
    tube = AdaptiveTube(scores, eta, decisions=steps * seeds) if "adaptive" in way else None
    fixed = np.full(HORIZON, quantile(kind, eta) if way == "true noise" else NormalDist().inv_cdf(eta))
    target = np.tile([TARGET, 0.0], (HORIZON + 1, 1))
    violations, distances, costs = 0, [], []
    for seed in range(seeds):
        noise, x, last = plant_noise(kind, steps, np.random.default_rng(seed)), np.array([UPPER - 0.1, 0.0]), None
        for _ in range(HORIZON * (tube is not None)):  # no plan of the flight before is compared with this one
            tube.observe(np.full(2, np.nan))
        for w in noise:
            kappas = fixed if tube is None else tube.observe(x).copy()
            last = controller.control(Gaussian.certain(x), Reference(target, kappas=kappas), last)
            if tube is not None:
                tube.remember(last.means, last.covariances)
            margin = kappas[0] * np.sqrt(last.covariances[1, 0, 0])
            x = pendulum(x, last.input) + w
            costs.append(10.0 * (x[0] - TARGET) ** 2 + 0.1 * x[1] ** 2)
            if last.means[1, 0] >= UPPER - margin - 1e-5:
                violations += int(x[0] > UPPER)
                distances.append(UPPER - x[0])
    return violations, len(distances), float(np.mean(distances)), float(np.mean(costs))


def main() -> None:
    """Learns, flies and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1100)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=WAYS)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results, allowed = [], (0.9, 0.95, 0.99)
    header = "".join(f"{f'{100 * (1 - eta):.0f} % allowed':>40}" for eta in allowed)
    print(f"{'':38}{header}\n{'':38}" + f"{'%':>8}{'limit':>8}{'mrad':>8}{'cost':>8}{'active':>8}" * len(allowed))
    for kind in arguments.kinds:
        rows = log(kind)
        picked = rows[sorted(np.random.default_rng(0).permutation(len(rows))[:200].tolist())]
        learned = ResidualModel.train(Affine.identity(2, 1), picked, angles=[0], trainer=Trainer(restarts=1))
        estimated = replace(learned, noise=torch.diag(estimate_process_noise(learned, rows).variance))
        true = replace(learned, noise=torch.diag(torch.from_numpy(NOISE**2)))
        models = {"learned noise": learned, "true noise": true}
        for way in arguments.ways:
            text = ""
            for eta in allowed:
                model = models.get(way, estimated)
                bad, active, distance, cost = fly(model, kind, eta, way, arguments.steps, arguments.seeds)
                limit = float(beta.ppf(0.95, bad + 1, active - bad)) if bad < active else 1.0
                text += f"{100 * bad / active:8.2f}{100 * limit:8.2f}{1e3 * distance:8.2f}{cost:8.4f}{active:8}"
                row = {"noise": kind, "way": way, "eta": eta, "violations": bad, "active": active}
                results.append(row | {"upper_limit": limit, "distance": distance, "cost": cost})
            print(f"{kind:12}{way:26}{text}", flush=True)
    write_results("chance_constraints", results)


if __name__ == "__main__":
    main()
