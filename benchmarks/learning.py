"""What learning while flying is worth.

A vehicle that becomes a fifth heavier, a wind that changes, and nothing at all.

    .venv/bin/python -m benchmarks.learning [--seeds 20] [--figure
    docs/figures/learning.png] .venv/bin/python -m benchmarks.learning --faults [--seeds
    10]

The translational quadrotor with the plant in the loop, GPs of 189 dithered transitions,
convex GP-MPC with H = 10, one step a second. At 20 s it becomes 20 % heavier, or a wind
begins, which turns at 50 s; or nothing happens. Compared: the model as learned, without
and with the controller's own disturbance estimate (gain 0.5), online learning, and a
model that was trained on the plant that flies after the change (on the plant without
wind where the wind changes), which flies that plant all along. RMSE of the position [m]
from 5 s after a change on, pooled over the seeds; ``ratio`` is to the last of these,
``lost`` counts flights farther than 5 m away then. Also by how much a decision takes
longer. Each cell is kept in ``outputs/benchmarks/learning.json`` and not flown again by
the same code.

With ``--faults`` its sensors fail on the ellipse, in calm air and in the wind: glitches
of one state at a time, steps without a measurement, and a second in which all of them
are frozen, or positions are in another unit. RMSE over the same steps, without and with
online learning; "sound" is the ratio to online learning in the same air with sound
sensors. Without learning the controller acts on a wrong measurement, and what that
costs stands in the columns "as learned"; with it, a sensor in doubt is not acted on.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure

from benchmarks.quadrotor import (
    DATA,
    HOVER,
    NOISE,
    OUTER,
    TRAINER,
    TRAJECTORIES,
    problem,
    trained,
)
from benchmarks.timing import own_source, write_results
from gpmpc._files import write_whole
from gpmpc.gp import GPPosterior
from gpmpc.learning import LearningController, OnlineLearning
from gpmpc.mpc import GPMPC, Controller, PredictionSettings
from gpmpc.plotting import png
from gpmpc.propagation import Linearization
from gpmpc.simulation import (
    Disturbance,
    Gust,
    Noise,
    Replaced,
    Rollout,
    closed_loop,
)
from gpmpc.studies.study import fingerprint
from gpmpc.systems import translational
from gpmpc.trajectories import states_along

HORIZON = 10
STEPS = 80
CHANGE = 20
TURN = 50
LOST = 5.0
POSITION = [0, 2, 4]
HEAVY = translational(mass=1.2 * 0.74)
CHANGES: dict[str, tuple] = {
    "none": (),
    "20 % heavier": (Replaced(HEAVY, CHANGE),),
    "wind": (
        Gust({"vx": 0.5, "vy": -0.3}, CHANGE, TURN),
        Gust({"vx": -0.4, "vz": 0.3}, TURN),
    ),
}
NOISES = {"process 0.01": NOISE, "measured 0.01": Noise(measurement=[0.01] * 6)}
WAYS = ("as learned", "disturbance estimate", "online", "trained on the new plant")
STORE = Path("outputs/benchmarks/learning.json")
# of glitches [m or m/s]
COUNTS = (1, 5, 20)
SIZES = (0.05, 0.5, 2.0)
FAULTS = (
    "none",
    *(f"{count} glitches of {size}" for count in COUNTS for size in SIZES),
    "1 % missing",
    "5 % missing",
    "frozen",
    "times 1000",
    "degrees",
)


class FaultySensor(Disturbance):
    """A sensor of the six states with one of ``FAULTS``, for one flight."""

    def __init__(self, fault: str, seed: int):
        random = np.random.default_rng(seed)
        self.offset = np.zeros((STEPS + 1, 6))
        self.factor = np.ones((STEPS + 1, 6))
        self.frozen = np.zeros(STEPS + 1, dtype=bool)
        self.shown = np.zeros(6)
        start = int(random.integers(30, 40))
        lasting = slice(start, start + 1)
        if "glitches" in fault:
            count, _, _, size = fault.split()
            steps = random.choice(np.arange(5, STEPS - 5), int(count), replace=False)
            states = random.integers(0, 6, len(steps))
            self.offset[steps, states] = random.choice([-1, 1], len(steps)) * float(
                size
            )
        elif "missing" in fault:
            part = float(fault.split()[0]) / 100
            self.offset[random.random(STEPS + 1) < part] = np.nan
        elif fault == "frozen":
            self.frozen[lasting] = True
        elif fault != "none":
            unit = {"times 1000": 1000.0, "degrees": 180 / np.pi}[fault]
            self.factor[lasting, POSITION] = unit

    def disturb_measurement(self, state: np.ndarray, time: float) -> np.ndarray:
        """What the sensor shows of a state (6,) at a time [s]."""
        step = round(time)
        if not self.frozen[step]:
            self.shown = state.copy()
        return self.factor[step] * self.shown + self.offset[step]


def controller_of(way: str, model: GPPosterior) -> Controller:
    """One way to control with a model."""
    gain = 0.5 if way == "disturbance estimate" else 0.0
    plain = GPMPC(
        model,
        Linearization(),
        problem(),
        HORIZON,
        HOVER,
        PredictionSettings(disturbance_gain=gain),
    )
    return LearningController(plain, OnlineLearning()) if way == "online" else plain


def flights(
    way: str, trajectory: str, change: str, noise: str, seeds: int, fault: str = "none"
) -> list[Rollout]:
    """One a seed."""
    disturbances = CHANGES[change]
    model = trained(trajectory)
    if way == "trained on the new plant":
        if change == "20 % heavier":
            data = DATA.transitions(HEAVY, TRAJECTORIES[trajectory])
            model = TRAINER(data, seed=0).posterior
            disturbances = (Replaced(HEAVY),)
        else:
            disturbances = ()
    controller = controller_of(way, model)
    references = states_along(
        TRAJECTORIES[trajectory], np.arange(STEPS + HORIZON + 1.0)
    )
    return [
        closed_loop(
            OUTER,
            controller,
            references,
            references[0],
            STEPS,
            noise=NOISES[noise],
            disturbances=(*disturbances, FaultySensor(fault, seed)),
            on_failure="previous_plan",
            seed=seed,
        )
        for seed in range(seeds)
    ]


def later(change: str) -> np.ndarray:
    """The steps that count: from 5 s after a change on.

    All of them where there is none.
    """
    k = np.arange(STEPS + 1)
    after = (k > CHANGE + 5) & ((k <= TURN) | (k > TURN + 5) | (change != "wind"))
    return after if change != "none" else k > 0


def measured(flown: list[Rollout], change: str) -> dict[str, Any]:
    """RMSE [m], lost flights, and median time of a decision [ms]."""
    away = np.array(
        [
            np.linalg.norm(
                (f.states - f.references)[later(change)][:, POSITION], axis=1
            )
            for f in flown
        ]
    )
    return {
        "rmse": float(np.sqrt(np.mean(away**2))),
        "lost": int((away.max(1) > LOST).sum()),
        "decision_ms": 1e3
        * float(np.median(np.concatenate([f.seconds for f in flown]))),
        "fastest_ms": 1e3 * float(min(f.seconds[5:].min() for f in flown)),
    }


def fault_table(seeds: int) -> None:
    """Flies with faulty sensors, and prints what learning makes of that."""
    noise = "process 0.01"
    print(
        f"{'':20}"
        + "".join(
            f"{air + ': as learned':>28}{'online':>10}{'ratio':>8}{'sound':>8}"
            for air in ("calm", "wind")
        )
    )
    sound: dict[str, float] = {}
    rows: list[dict[str, Any]] = []
    for fault in FAULTS:
        text = f"{fault:20}"
        for change in ("none", "wind"):
            plain, online = (
                measured(
                    flights(way, "elliptical", change, noise, seeds, fault), change
                )["rmse"]
                for way in ("as learned", "online")
            )
            sound.setdefault(change, online)
            rows.append(
                {"fault": fault, "change": change, "plain": plain, "online": online}
            )
            text += f"{plain:28.4f}{online:10.4f}{online / plain:8.2f}"
            text += f"{online / sound[change]:8.2f}"
        print(text, flush=True)
    write_results("learning_faults", rows)


def main() -> None:
    """Flies, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, help="flights a cell; 20, faults 10")
    parser.add_argument("--faults", action="store_true", help="of sensors")
    parser.add_argument(
        "--figure", type=Path, default=Path("outputs/benchmarks/learning.png")
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.faults:
        fault_table(arguments.seeds or 10)
        return
    arguments.seeds = arguments.seeds or 20
    rows = json.loads(STORE.read_text())["results"] if STORE.exists() else []
    print(f"{'':46}" + "".join(f"{way:>28}" for way in WAYS))
    for trajectory in TRAJECTORIES:
        for noise in NOISES:
            for change in CHANGES:
                cell: dict[str, dict] = {}
                for way in WAYS:
                    key: dict[str, Any] = {
                        "trajectory": trajectory,
                        "noise": noise,
                        "change": change,
                        "way": way,
                    }
                    key["seeds"] = arguments.seeds
                    key["code"] = fingerprint(own_source(__file__))
                    row_of_case = next(
                        (row for row in rows if key.items() <= row.items()), None
                    )
                    if row_of_case is None:
                        row_of_case = key | measured(
                            flights(*(way, trajectory, change, noise, arguments.seeds)),
                            change,
                        )
                        rows.append(row_of_case)
                        write_results("learning", rows)
                    cell[way] = row_of_case
                best = cell[WAYS[-1]]["rmse"]
                text = "".join(
                    f"{one['rmse']:10.4f} x{one['rmse'] / best:7.3f} lost "
                    f"{one['lost']:2}"
                    for one in cell.values()
                )
                print(f"{trajectory:12}{noise:16}{change:18}{text}", flush=True)
    keys = "fastest_ms", "decision_ms"
    unchanged = [row for row in rows if row["change"] == "none"]
    plain, online = (
        [min(row[key] for row in unchanged if row["way"] == way) for key in keys]
        for way in WAYS[::2]
    )
    more = [after - before for before, after in zip(plain, online, strict=True)]
    print(
        f"a decision with online learning takes {more[0]:.2f} ms more (fastest), "
        f"{more[1]:.2f} ms (median)"
    )
    arguments.figure.parent.mkdir(parents=True, exist_ok=True)
    write_whole(arguments.figure, png(figure()))
    print(f"written to {arguments.figure}")


def figure() -> Figure:
    """How far the vehicle is from its reference, one seed."""
    plt.style.use("gpmpc.plotting.gpmpc")
    drawn, panels = plt.subplots(1, 2, sharey=True, figsize=(8, 3.6))
    for axis, change in zip(panels, ("20 % heavier", "wind"), strict=True):
        for way, look in zip(WAYS, ("C6-.", "C1", "C0", "C2:"), strict=True):
            (flown,) = flights(way, "elliptical", change, "process 0.01", 1)
            away = np.linalg.norm(
                (flown.states - flown.references)[:, POSITION], axis=1
            )
            axis.semilogy(flown.times[1:], away[1:], look, label=way)
        axis.set(title=f"at 20 s: {change}", xlabel="time [s]")
    panels[0].set_ylabel("distance to the reference [m]")
    drawn.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4
    )
    return drawn


if __name__ == "__main__":
    main()
