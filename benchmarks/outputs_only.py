"""What ``gpmpc learn`` makes of records whose states are not measured.

    .venv/bin/python -m benchmarks.outputs_only [--seeds 3]

Two synthetic records, each learned from one run and judged on another by free
simulation, from the first rows on with nothing but the inputs: two tanks one above the
other, of which the lower level alone is measured (outflows by the square root, the
upper one overflows into the lower one), and a converter that is linear, then clipped,
then linear again. Beside it the best linear ARX model of 1 to 15 rows, fitted one step
ahead to the same rows, with the order that is best **on the run that it is judged on**.
RMSE in units of the output. Writes ``outputs/benchmarks/outputs_only.json``.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.timing import write_results
from gpmpc.logs import Log, LogMapping, judge, learn
from gpmpc.logs._log import LogRun
from gpmpc.models import LogModel

PAST = 45  # rows before a free simulation
ORDERS = range(1, 16)
MAPPING = LogMapping.from_dict(
    {"rest": "use", "states": {"y": ["y"]}, "inputs": {"u": ["u"]}}
)


class Record(NamedTuple):
    """Inputs and outputs of one run."""

    inputs: np.ndarray  # (K,)
    outputs: np.ndarray  # (K,)
    time_step: float  # [s]

    @property
    def log(self) -> Log:
        """The run as a log."""
        last = self.time_step * (len(self.inputs) - 1)
        run = LogRun(
            name="run",
            time=np.linspace(0, last, len(self.inputs)),
            states=self.outputs[:, None],
            inputs=self.inputs[:, None],
            context=np.empty((len(self.inputs), 0)),
        )
        return Log(MAPPING, self.time_step, (run,))


def tanks(seed: int, rows: int = 1024, noise: float = 0.02) -> Record:
    """Two tanks in cascade, of which the upper one overflows."""
    rng = np.random.default_rng(seed)
    dt = 4.0
    t = dt * np.arange(rows)
    u: np.ndarray = np.full(rows, 3.0)
    for frequency in np.linspace(1e-4, 0.0144, 30):
        phase = rng.uniform(0, 2 * np.pi)
        u += 0.6 * rng.normal() * np.sin(2 * np.pi * frequency * t + phase)
    u = np.clip(u, 0, 8)
    upper = lower = 4.0
    levels = []
    h = dt / 20
    for pumped in u:
        levels.append(lower)
        for _ in range(20):
            through = 0.05 * np.sqrt(upper)
            upper += h * (0.03 * pumped - through)
            spilled = 0.5 * max(upper - 10.0, 0.0)
            upper = min(max(upper, 0.0), 10.0)
            lower += h * (through - 0.05 * np.sqrt(lower)) + spilled
            lower = min(max(lower, 0.0), 10.0)
    return Record(u, np.array(levels) + noise * rng.normal(size=rows), dt)


def converter(seed: int, rows: int = 4000, noise: float = 0.005) -> Record:
    """A linear filter, a clipped gain, and another linear filter."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=rows)
    for k in range(1, rows):
        u[k] = 0.9 * u[k - 1] + np.sqrt(1 - 0.9**2) * u[k]
    before = [0.0, 0.0]
    after = [0.0, 0.0]
    outputs = []
    for value in u:
        outputs.append(after[0])
        clipped = max(before[0], -0.6) + 0.2 * np.tanh(2 * before[0])
        after = [1.7 * after[0] - 0.76 * after[1] + 0.06 * clipped, after[0]]
        before = [1.6 * before[0] - 0.68 * before[1] + 0.08 * value, before[0]]
    return Record(u, np.array(outputs) + noise * rng.normal(size=rows), 0.002)


RECORDS: dict[str, Callable[[int], Record]] = {"tanks": tanks, "converter": converter}


def linear_rmse(train: Record, test: Record, order: int) -> float:
    """Simulates a linear model of so many rows freely; returns its RMSE."""

    def seen(record: Record, outputs: Any, k: int) -> np.ndarray:
        return np.r_[outputs[k - order : k], record.inputs[k - order : k], 1.0]

    rows = range(order, len(train.outputs))
    regressors = np.array([seen(train, train.outputs, k) for k in rows])
    weights: Any = np.linalg.lstsq(regressors, train.outputs[order:], rcond=None)[0]
    simulated = test.outputs.copy()
    for k in range(PAST + 1, len(simulated)):
        predicted = seen(test, simulated, k) @ weights
        simulated[k] = np.clip(predicted, -1e6, 1e6)
    errors = (simulated - test.outputs)[PAST + 1 :]
    return float(np.sqrt(np.mean(errors**2)))


def model_rmse(model: LogModel, test: Record) -> float:
    """Simulates a learned model freely; returns its RMSE."""
    windows = test.log.windows(len(test.inputs) - 1 - PAST, past=PAST)
    return float(np.sqrt(np.mean(model.rollout_errors(windows) ** 2)))


def main() -> None:
    """Learns, simulates and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    results = []
    for name, record in RECORDS.items():
        for seed in range(parser.parse_args().seeds):
            train = record(2 * seed)
            test = record(2 * seed + 1)
            begin = time.process_time()
            learned = learn(train.log)
            seconds = time.process_time() - begin
            judgement = judge(learned, test.log, train.log)
            means = {key: mean.ravel().tolist() for key, mean in judgement.mean.items()}
            chosen = next(one.name for one in learned.candidates if one.chosen)
            linear = min(linear_rmse(train, test, order) for order in ORDERS)
            rmse = model_rmse(learned.model, test)
            best = np.min([mean for key, mean in means.items() if key != "model"], 0)
            ratios = " ".join(f"{ratio:.2f}" for ratio in means["model"] / best)
            print(f"{name}, seed {seed}: {rmse:.3f}, linear {linear:.3f};", end=" ")
            print(f"1, 10, 50 steps over the best baseline {ratios}; {seconds:.0f} s")
            print(f"    {chosen}")
            results.append(
                {"record": name, "seed": seed, "rmse": rmse, "linear": linear}
                | {"mean": means, "seconds": seconds, "chosen": chosen}
            )
    write_results("outputs_only", results)


if __name__ == "__main__":
    main()
