"""Times the training of six GPs.

GPyTorch's automatic differentiation and the paper's seconds stand beside it.

    .venv/bin/python -m benchmarks.training [--repeats 15] [--sizes 10 50 100 189]

One process, one thread. For every trajectory, subsystem and size the closed-form
trainer (as ``gpmpc tables`` runs it: four starts a GP) and GPyTorch's likelihood under
the same search take turns on the same rows; the ratio is paired. Writes
``outputs/benchmarks/training.json``.
"""

import argparse
import time
from unittest.mock import patch

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from benchmarks.gpytorch_likelihood import GPyTorchLikelihood
from benchmarks.timing import write_results
from gpmpc.cli._settings import config_folder
from gpmpc.experiments.tables import Tables
from gpmpc.gp import Trainer
from gpmpc.studies.study import random_rows

PAPER_SECONDS = {10: 1.12, 189: 4.01}  # stated by Cao, Lai and Alam (2017)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--repeats", type=int, default=15, help="runs of the closed form a cell"
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 50, 100, 189])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with initialize_config_dir(version_base="1.3", config_dir=str(config_folder())):
        config = compose("tables")
    parts = {
        key: instantiate(config[key], _convert_="all")
        for key in ("data", "trajectory", "model")
    }
    trainer = parts["model"]
    experiment = Tables(
        parts["data"],
        parts["trajectory"],
        ("translational", "rotational"),
        trainer,
        None,
        sizes=arguments.sizes,
        draws=1,
    )
    results = []
    print(
        "six GPs, one thread; process time in seconds; ratio: GPyTorch's likelihood "
        "over the closed form"
    )
    print(
        f"{'data':28}{'N':>5}{'median':>9}{'p99':>9}"
        f"{'GPyTorch':>10}{'ratio':>8}{'paper':>8}"
    )
    for trial in experiment.trials():
        everything = trial.condition.data
        size = trial.labels["size"]
        data = everything[random_rows(len(everything), size, trial.seed)]
        trainer(data, seed=0)
        seconds = [
            process_seconds(trainer, data, seed) for seed in range(arguments.repeats)
        ]
        with patch(
            "gpmpc.gp._search.NegativeLogMarginalLikelihood", GPyTorchLikelihood
        ):
            other = [
                process_seconds(trainer, data, seed)
                for seed in range(min(3, arguments.repeats))
            ]
        ratio = float(np.median([b / a for a, b in zip(seconds, other, strict=False)]))
        name = f"{trial.labels['trajectory']} {trial.labels['subsystem']}"
        result = {
            "data": name,
            "size": size,
            "median": float(np.median(seconds)),
            "p99": float(np.quantile(seconds, 0.99)),
            "max": max(seconds),
            "gpytorch_median": float(np.median(other)),
            "ratio": ratio,
            "paper": PAPER_SECONDS.get(size),
        }
        results.append(result)
        paper = PAPER_SECONDS.get(size, "")
        print(
            f"{name:28}{size:5}{result['median']:9.3f}{result['p99']:9.3f}"
            f"{result['gpytorch_median']:10.2f}{ratio:8.1f}{paper:>8}",
            flush=True,
        )
    write_results("training", results)


def process_seconds(trainer: Trainer, data, seed: int) -> float:
    """CPU time of one training."""
    start = time.process_time()
    trainer(data, seed=seed)
    return time.process_time() - start


if __name__ == "__main__":
    main()
