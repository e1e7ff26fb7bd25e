import numpy as np
import pytest
import torch

from gpmpc.bench.pendulums import Pendulums, pendulum_gp, pendulum_plant, pendulum_references
from gpmpc.bench.steps import Answering, Grid, controllers, recorded_questions
from gpmpc.exceptions import SettingError
from gpmpc.systems.plant import step


@pytest.mark.parametrize("n", [2, 6, 12])
def test_the_gps_of_the_pendulums_predict_them(n):
    gp, plant, states = pendulum_gp(n, 300), pendulum_plant(n), pendulum_references(n, 30)
    predicted = gp.predict(torch.from_numpy(states), torch.zeros(30, n // 2, dtype=torch.float64)).mean.numpy()
    true = np.array([step(plant, x, np.zeros(n // 2)) for x in states])
    assert np.abs(predicted - true).max() < 0.3 * np.abs(true - states).max()


def test_one_pendulum_without_damping_would_keep_its_energy_and_with_it_loses_some():
    plant, x = pendulum_plant(2), np.array([1.0, 0.0])
    energies = []
    for _ in range(50):
        energies.append(x[1] ** 2 / 2 - 4.0 * np.cos(x[0]))
        x = step(plant, x, np.zeros(1))
    assert np.all(np.diff(energies) < 0)


def test_springs_pull_neighbours_together():
    rates = Pendulums(3).derivative(np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]), np.zeros(3))
    assert rates[1] == rates[5] == 0.5  # the neighbours of the one that is out
    assert rates[3] == pytest.approx(-4 * np.sin(0.5) - 1.0)


def test_every_cell_has_a_row_for_everything_that_is_compared():
    grid = Grid([2], [5, 8], [1, 3], caches=["hot"], seconds=0.01)
    groups = grid.groups()
    assert len({group.name for group in groups}) == len(groups) == 6
    records = [group.measure() for group in groups]
    rows = grid.rows(records)
    assert grid.rows(records[:2]) == rows[:7]
    steps = {(row["what"], row["N"], row["H"]) for row in rows if row["part"] == "step"}
    assert steps == {(w, N, H) for w in ("paper's form", "zero order", "mean only") for N in (5, 8) for H in (1, 3)}
    assert len(rows) == 12 + 2 * 4
    for row in rows:
        assert 0 < row["median"] <= row["p95"] <= row["p99"] <= row["max"]
        assert row["samples"] >= 10
        assert row.get("unsolved", 0) == 0


def test_what_is_asked_for_twice_is_measured_once():
    assert len(Grid([2, 2], [5, 8, 5], [1, 1], caches=["hot", "hot"]).groups()) == 4


def test_an_answer_is_what_the_controller_decides_from_its_last_one():
    gp = pendulum_gp(2, 30)
    controller = controllers(gp, 3)["zero order"]
    questions = recorded_questions(gp, controller, 4)
    answering = Answering(controller, questions)
    first, second = answering(), answering()
    assert np.array_equal(first.inputs, controller.control(*questions[0], None).inputs)
    assert np.array_equal(second.inputs, controller.control(*questions[1], first).inputs)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"states": [3]}, "states: a pendulum has two states"),
        ({"sizes": []}, "sizes: must be a list with something in it"),
        ({"sizes": 10}, "sizes: must be a list"),
        ({"horizons": [0]}, "horizons"),
        ({"caches": ["cold"]}, "caches: must be among hot, flushed; got 'cold'"),
        ({"seconds": 0}, "seconds"),
    ],
)
def test_a_grid_out_of_range_is_refused(settings, message):
    with pytest.raises(SettingError, match=message):
        Grid(**({"states": [2], "sizes": [5], "horizons": [1]} | settings))
