"""The pendulums are what the benchmarks say, and their GPs predict them.

Steps are warm-started as in a loop.
"""

import numpy as np
import pytest
import torch

from benchmarks.pendulums import (
    Pendulums,
    pendulum_gp,
    pendulum_plant,
    pendulum_references,
)
from benchmarks.steps import (
    WarmStarted,
    controllers,
    measure_size,
    record_steps,
    speed_figure,
    table,
)
from gpmpc.plotting import png
from gpmpc.systems import step


@pytest.mark.parametrize("n", [2, 6])
def test_the_gps_of_the_pendulums_predict_them(n):
    gp = pendulum_gp(n, 300)
    plant = pendulum_plant(n)
    states = pendulum_references(n, 30)
    predicted = gp.predict(
        torch.from_numpy(states), torch.zeros(30, n // 2, dtype=torch.float64)
    ).mean.numpy()
    true = np.array([step(plant, x, np.zeros(n // 2)) for x in states])
    assert np.abs(predicted - true).max() < 0.3 * np.abs(true - states).max()


def test_springs_pull_neighbours_together():
    rates = Pendulums(3).derivative(
        np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]), np.zeros(3)
    )
    assert rates[1] == rates[5] == 0.5  # the neighbours of the one that is out
    assert rates[3] == pytest.approx(-4 * np.sin(0.5) - 1.0)


def test_every_cell_shows_all_that_is_compared():
    rows = [
        row | {"cache": "hot"}
        for N in (5, 8)
        for row in measure_size(pendulum_gp(2, N), [1, 3], 0.01, False)
    ]
    steps = {(row["what"], row["N"], row["H"]) for row in rows if row["H"]}
    assert steps == {
        (w, N, H)
        for w in ("paper's form", "zero order", "mean only")
        for N in (5, 8)
        for H in (1, 3)
    }
    assert len(rows) == 2 * (3 + 2 * 3)
    for row in rows:
        assert 0 < row["median"] <= row["p99"]
        assert row["samples"] >= 10
        assert row.get("unsolved", 0) == 0
    shown = table(rows)
    assert all(f"{row['median']:.3g} ({row['p99']:.3g})" in shown for row in rows)
    figure = speed_figure(rows)
    assert [list(line.get_xdata()) for line in figure.axes[0].get_lines()] == [
        [5, 8]
    ] * 3
    assert [list(line.get_xdata()) for line in figure.axes[1].get_lines()] == [
        [1, 3]
    ] * 3
    assert png(figure).startswith(b"\x89PNG")


def test_a_step_starts_from_the_decision_before():
    gp = pendulum_gp(2, 30)
    controller = controllers(gp, 3)["zero order"]
    steps = record_steps(gp, controller, 4)
    stepping = WarmStarted(controller, steps)
    first = stepping()
    second = stepping()
    assert np.array_equal(first.inputs, controller.control(*steps[0], None).inputs)
    assert np.array_equal(second.inputs, controller.control(*steps[1], first).inputs)
