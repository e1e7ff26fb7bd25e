"""The flights of section 5.2 on small settings, from command line to figures."""

import csv
import json
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hydra import compose, initialize_config_dir

from gpmpc.datasets import PaperData
from gpmpc.exceptions import SettingError
from gpmpc.experiments import figures_drawing
from gpmpc.experiments.figures import Figures, Row
from gpmpc.experiments.figures_tables import LOOP_TITLES, paper_seconds, summarise
from gpmpc.gp import SoftLimits, identity, train
from gpmpc.mpc import NonlinearGPMPC, Reference
from gpmpc.propagation import MomentMatching
from gpmpc.trajectories import Elliptical, Lorenz
from tests.cli.command import forked

CONF = Path(__file__).resolve().parents[2] / "conf"
BOUNDS = {
    "model": {
        "elliptical": {"lower": [0, -0.2, -0.2], "upper": [100, 0.2, 0.2]},
        "lorenz": {"lower": [-45, -2, -2], "upper": [0, 2, 2]},
    },
    "plant": {"lower": [0, -0.7, -0.7], "upper": [100, 0.7, 0.7]},
}
OURS = {"loop": "model", "controller": "convex", "horizon": 10, "R": [0.1, 1000, 1000]}
OURS["settings"] = {"prediction": {"form": "trajectory", "covariance": "none"}}
FREE = {"loop": "model", "controller": "nonlinear", "R": [1e-10] * 3, "bounded": False}
TINY = [
    "steps=3",
    "samples=15",
    "trials=1",
    "model.restarts=0",
    "flying.restarts=0",
    "workers=1",
    "trajectory=lorenz",
]
TINY += ["subsystem=[translational,rotational]", "folder=out"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures")
    return folder, forked("figures", *TINY, cwd=folder)


def test_one_command_writes_all_tables_and_figures(finished):
    folder, run = finished
    assert run.returncode == 0, run.stderr
    written = {path.name for path in (folder / "out").iterdir()}
    assert {
        "figures.md",
        "figures.csv",
        "figures.json",
        "config.yaml",
        "trials.jsonl",
    } <= written
    assert {
        "figure3.png",
        "figure4.png",
        "figure3-plant.png",
        "figure4-plant.png",
    } <= written
    rows = list(csv.DictReader((folder / "out/figures.csv").read_text().splitlines()))
    kinds = {(row["loop"], row["controller"], row["horizon"]) for row in rows}
    assert kinds >= {
        ("plant", c, h)
        for c in ("nmpc", "nonlinear", "convex")
        for h in ("1", "5", "10")
    }
    assert ("model", "convex", "10") in kinds
    assert all(float(row["input_excess"] or 0) <= 1e-8 for row in rows)
    assert "The paper's reading" in run.stdout
    assert "The plant in the loop" in run.stdout


def test_a_run_goes_on_where_it_stopped(finished):
    folder, _ = finished
    flights = folder / "out/trials.jsonl"
    lines = flights.read_text().splitlines()
    flights.write_text("\n".join(lines[:-3]) + '\n{"fingerprint": "cut sho')
    before = {json.loads(line)["fingerprint"] for line in lines}
    again = forked("figures", *TINY, cwd=folder, trials_here=True)
    assert again.returncode == 0, again.stderr
    after = [line for line in flights.read_text().splitlines() if line.endswith("}")]
    assert {json.loads(line)["fingerprint"] for line in after} == before
    assert len(after) == len(lines)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["trialz=1"], "unknown setting 'trialz' (did you mean 'trials'?)"),
        (
            ["study=horizons"],
            "study: no such option 'horizons'; available are confidence, flights, "
            "horizon",
        ),
        (["loop=plane"], "loop: must be among model, plant; got 'plane'"),
        (["trials=0"], "trials: must be a whole number, 1 or more; got 0"),
        (["noise=-1"], "noise: must be a number, 0 or more; got -1"),
        (["data=paper", "data.folder=nowhere"], "nowhere: no such folder"),
        (
            ["subsystem=rotational", "loop=plant"],
            "subsystem: no row flies it in the chosen loops; got rotational",
        ),
        (
            ["trajectory=hover", "loop=model"],
            "bounds: must hold lower and upper of the model on hover, translational",
        ),
        (
            ["study=confidence", "trajectory=hover"],
            "state_bounds: must hold lower and upper of the plant on hover",
        ),
        (
            ["bounds.plant=null"],
            "bounds: must hold lower and upper of the plant on elliptical, "
            "translational; got none",
        ),
        (
            ["bounds.plant.lower=[5,5]"],
            "upper: must be a list of 2 numbers, or one by stage; got [100",
        ),
        (
            ["rows.ours_convex.subsystems=[rolling]"],
            "subsystems: must be among translational, rotational; got 'rolling'",
        ),
        (
            ["+rows.convex.settings.foo=1"],
            "settings.foo: controller convex takes no such setting",
        ),
        (
            ["samples=15", "steps=3", "+rows.ours_convex.size=16"],
            "size: must be at most 15, the rows of the data",
        ),
    ],
)
def test_a_mistake_is_answered_in_one_line_before_training(
    tmp_path, arguments, message
):
    run = forked("figures", *arguments, cwd=tmp_path)
    assert run.returncode == 2
    assert message in run.stderr
    assert len(run.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.rglob("models"))


@pytest.mark.parametrize("subsystem", ["translational", "rotational"])
def test_one_subsystem_alone_is_flown_and_drawn(subsystem, tmp_path):
    left_out = [
        f"rows.{name}=null"
        for name in (
            "authors_nonlinear",
            "timed_nonlinear",
            "timed_slsqp",
            "timed_convex",
        )
    ]
    run = forked(
        "figures",
        *TINY,
        f"subsystem={subsystem}",
        "loop=model",
        *left_out,
        cwd=tmp_path,
        trials_here=True,
    )
    assert run.returncode == 0, run.stderr
    rows = list(csv.DictReader((tmp_path / "out/figures.csv").read_text().splitlines()))
    assert {(row["name"], row["subsystem"]) for row in rows} == {
        ("convex GPMPC, as the authors", subsystem),
        ("convex GPMPC, ours", subsystem),
    }
    assert (tmp_path / "out/figure3.png").exists()
    assert (tmp_path / "out/figure4.png").exists() == (subsystem == "translational")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"loop": "wind"}, "loop: must be one of model, plant; got 'wind'"),
        (
            {"controller": "pid"},
            "controller: must be one of nmpc, nonlinear, slsqp, convex; got 'pid'",
        ),
        ({"controller": "nmpc"}, "controller: nmpc knows the true plant"),
        ({"horizon": [1, 0]}, "horizon: must be a whole number, 1 or more; got 0"),
    ],
)
def test_a_row_that_means_nothing_is_refused(changes, message):
    with pytest.raises(SettingError, match=message):
        Row(**(OURS | changes))


def test_lists_of_settings_make_a_row_for_every_combination():
    rows = Row(**(OURS | {"horizon": [1, 5], "confidence": [0.9, 0.95]})).variants()
    assert [(row.horizon, row.confidence) for row in rows] == [
        (1, 0.9),
        (1, 0.95),
        (5, 0.9),
        (5, 0.95),
    ]


@pytest.mark.parametrize(
    ("study", "trials"), [("flights", 50), ("horizon", 5), ("confidence", 12)]
)
def test_the_command_line_overrules_a_studys_number_of_trials(study, trials):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        assert compose("figures", [f"study={study}"]).trials == trials
        assert compose("figures", [f"study={study}", "trials=2"]).trials == 2


def test_bounds_are_counted_over_all_and_over_bounded_steps(tmp_path):
    bounded = [
        "study=confidence",
        "steps=20",
        "rows.once=null",
        "rows.without_noise=null",
        "loop=plant",
    ]
    bounded += [
        "rows.convex.horizon=1",
        "rows.convex.confidence=[0.9,0.99]",
        "state_bounds.lorenz.upper=[-1,null,4,null,null,null]",
    ]
    run = forked("figures", *TINY, *bounded, cwd=tmp_path, trials_here=True)
    assert run.returncode == 0, run.stderr
    assert "State bounds that may be broken" in run.stdout
    assert (tmp_path / "out/confidence.png").exists()
    assert not (tmp_path / "out/horizon.png").exists()
    rows = list(csv.DictReader((tmp_path / "out/figures.csv").read_text().splitlines()))
    assert [float(row["confidence"]) for row in rows] == [0.9, 0.99]
    for row in rows:
        assert int(row["steps"]) == 20
        assert 0 < int(row["steps_at_bound"]) <= 20
        assert int(row["violations_at_bound"]) <= int(row["violations"]) < 20


def test_the_papers_seconds_are_those_of_section_5_2():
    assert paper_seconds()[("nonlinear", "elliptical")] == 220
    assert paper_seconds()[("convex", "lorenz")] == 56


def on_the_authors_data(folder, rows):
    model = partial(train, penalty=SoftLimits(), scaling=identity)
    return Figures(
        rows={name: Row(**row) for name, row in rows.items()},
        data={"data": PaperData(folder)},
        trajectories={"elliptical": Elliptical(), "lorenz": Lorenz()},
        subsystems="translational",
        models={"model": model, "plant": model},
        model_settings={"model": "paper", "plant": "paper"},
        bounds=BOUNDS,
        state_bounds={},
        workers=1,
    )


def test_on_the_authors_data_tracking_is_as_printed(paper_data, tmp_path):
    experiment = on_the_authors_data(paper_data, {"ours": OURS, "free": FREE})
    records = [
        {**t.labels, **experiment.run_trial(t)} for t in experiment.trials(tmp_path)
    ]
    found = {(row.name, row.trajectory): row for row in summarise(records).itertuples()}
    # The authors' stored runs: 2.98 and 0.884; one step at a time on the map, at best
    # 2.604 and 0.115. Without bounds and one step ahead any reference can be met, but
    # where the Lorenz curve is almost free fall (steps 100 to 107: thrust near zero, so
    # tilts beyond 1.4 rad) the program has local minima 0.2 to 0.3 away from it.
    for trajectory, limit, free in (
        ("elliptical", 2.75, 0.001),
        ("lorenz", 0.20, 0.05),
    ):
        assert found["ours", trajectory].total <= limit
        assert found["ours", trajectory].input_excess <= 1e-8
        assert found["ours", trajectory].failed_steps == 0
        assert found["free", trajectory].total <= free


def test_the_nonlinear_controller_starts_from_reference_inputs():
    """Starts at the reference's inputs.

    From the last input held, a nearly flat direction of this GP takes it hundreds of
    iterations.
    """
    from gpmpc.gaussian import Gaussian
    from gpmpc.gp import Transitions
    from gpmpc.mpc import Problem, Tracking

    rng = np.random.default_rng(0)
    states = rng.normal(size=(40, 2))
    inputs = rng.normal(size=(40, 1))
    after = states * 0.5 + inputs * [[1.0, 0.3]]
    import torch

    gp = train(Transitions(*map(torch.tensor, (states, inputs, after)))).posterior
    problem = Problem(Tracking([1, 1], [1e-8], penalized="deviations"))
    controller = NonlinearGPMPC(gp, MomentMatching(), problem, 1, [5.0])
    wanted = gp.predict(torch.tensor(states[0]), torch.tensor(inputs[0])).mean.numpy()
    decision = controller.control(
        Gaussian.certain(states[0]),
        Reference(np.stack([states[0], wanted]), inputs[:1]),
    )
    assert decision.status.solved
    assert decision.iterations <= 2
    assert np.allclose(decision.inputs, inputs[:1], atol=1e-3)


def test_titles_keep_their_capital_letters(monkeypatch):
    titles = []
    monkeypatch.setattr(figures_drawing, "_shown", list)
    monkeypatch.setattr(figures_drawing, "_state_groups", lambda flights, _: flights)
    monkeypatch.setattr(figures_drawing, "_input_groups", lambda _: [])
    monkeypatch.setattr(figures_drawing, "_setting_images", lambda _: {})
    monkeypatch.setattr(
        figures_drawing, "tracking", lambda _, title: titles.append(title)
    )
    monkeypatch.setattr(figures_drawing, "png", lambda _: b"")
    record = {"drawn": {}, "loop": "model", "trajectory": "elliptical"}
    assert [*figures_drawing.draw_all(pd.DataFrame(), [record])] == ["figure2.png"]
    assert titles == ["elliptical trajectory: the GP rolled on itself"]


def test_the_page_has_a_line_for_every_row_of_the_csv_file(
    finished,
):
    folder, _ = finished
    rows = list(csv.DictReader((folder / "out/figures.csv").read_text().splitlines()))
    _, *sections = (folder / "out/figures.md").read_text().split("\n## ")
    lines = {
        section.split("\n")[0]: [
            line for line in section.splitlines() if line[:1] == "|"
        ]
        for section in sections
    }
    for loop, title in LOOP_TITLES.items():
        flown = [row for row in rows if row["loop"] == loop]
        assert len(lines[title]) == 2 + len(flown) > 2
        for line, row in zip(lines[title][2:], flown, strict=True):
            assert line.split("|")[1].strip().startswith(row["name"].split("_")[0])
