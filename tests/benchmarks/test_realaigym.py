"""The league's experiment.

Interface, equations, what is learned from, what is said without the simulator.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import realaigym
from benchmarks.realaigym import (
    ACTUATED,
    BRAKE,
    PAUSE,
    REPLAN,
    TICKS,
    TORQUE,
    Play,
    board,
    casadi_model,
    fit_body,
    heights,
    league_controller,
    learn,
    main,
    pilot,
    play_script,
    random_record,
    read_model,
    right_hand_side,
    state_of,
    table,
    transitions,
    write_entry,
    wrong_system,
)
from gpmpc.exceptions import SettingError
from gpmpc.models import KnownModel
from gpmpc.systems import double_pendulum, step_many


class Interface:
    """What the league documents of a controller.

    Torques of both joints for angles, rates and a time.
    """

    def get_control_output(self, x, t=None):
        return np.asarray(self.get_control_output_(x, t))


def true_model(robot):
    return KnownModel(casadi_model(double_pendulum(ACTUATED[robot])), 4, 1)


@pytest.mark.parametrize(("robot", "joint"), [("acrobot", 1), ("pendubot", 0)])
def test_the_leagues_controller_plans_at_50_hz_for_one_joint(robot, joint):
    who = pilot(true_model(robot), robot, horizon=25, programs=3, wild=False)
    controller = league_controller(Interface, who)
    rhs = right_hand_side()
    x = np.array([3.15, -0.02, 0.0, 0.1])
    torques = []
    for k in range(40):
        torques.append(controller.get_control_output(x, 0.002 * k))
        x = x + 0.002 * rhs(0.0, x, torques[-1])
    torques = np.array(torques)
    assert len(who.seconds) == 4
    assert who.searched == [True, False, False, False]
    assert not torques[:, 1 - joint].any()
    assert np.abs(torques).max() <= 6.0
    assert len(set(torques[:10, joint])) > 1  # the feedback between plans
    controller.get_control_output(x, 0.5)  # the league had taken it away: a new search
    assert who.searched == [True, False, False, False, True]


def test_without_a_plan_the_motor_brakes_before_the_next_search(
    monkeypatch,
):
    who = pilot(true_model("acrobot"), "acrobot", horizon=10, programs=1, wild=False)
    monkeypatch.setattr(
        who.controller, "criterion", lambda plan, reference: REPLAN + 1.0
    )
    torques = np.array(
        [
            who.torques([0.1, 0.2, 3.0, 2.0 + k], 0.002 * k)
            for k in range(2 * PAUSE * TICKS)
        ]
    )
    assert not torques[:, 0].any()
    held = -BRAKE * (2.0 + TICKS * (np.arange(2 * PAUSE * TICKS) // TICKS))
    assert torques[:, 1] == pytest.approx(np.clip(held, -TORQUE, TORQUE))
    assert who.searched == [True, True]


def test_hanging_is_below_and_upright_above_the_line():
    hanging = state_of([0.0, 0.0, 1.0, 2.0])
    upright = state_of([np.pi, 0.0, 0.0, 0.0])
    assert np.array_equal(hanging, [-np.pi, 1.0, 0.0, 2.0])
    assert heights(np.array([hanging, upright])) == pytest.approx([-0.5, 0.5])


def test_all_parameters_of_the_wrong_body_are_off_by_the_share():
    true = double_pendulum("elbow").dynamics
    bodies = [wrong_system("acrobot", 0.15, seed).dynamics for seed in (0, 1)]
    for body in bodies:
        for key in ("masses", "first_length", "centres", "inertias"):
            ratio = np.array(getattr(body, key)) / np.array(getattr(true, key))
            assert np.allclose(np.abs(ratio - 1), 0.15)
    assert bodies[0] != bodies[1]


def test_calm_transitions_without_passive_torque_are_learned():
    states = np.zeros((101, 4))
    torques = np.zeros((100, 2))
    torques[:, 1] = np.repeat([1.0, 2.5], 50)
    torques[80:, 0] = 1.0
    states[:20, 2] = 30.0
    found = transitions([Play(0.0, states, torques)], "acrobot")
    # of 18 windows of 10 samples, every 5: 4 begin wild, 1 spans the jump, 3 have a
    # torque on the passive joint
    assert len(found.states) == 10
    assert set(found.inputs[:, 0].tolist()) == {1.0, 2.5}


@pytest.mark.parametrize("robot", ["acrobot", "pendubot"])
def test_a_body_fitted_to_five_seconds_predicts_as_the_true_one(
    robot,
):
    wrong = wrong_system(robot, 0.15, 2)
    found = fit_body(robot, wrong, transitions(random_record(robot, 5.0, 0), robot))
    test = transitions(random_record(robot, 5.0, 1), robot)
    wrong_error, error, least = (
        np.sqrt(
            np.square(
                step_many(body, test.states.numpy(), test.inputs.numpy())
                - test.next_states.numpy()
            ).mean()
        )
        for body in (wrong, found, double_pendulum(ACTUATED[robot]))
    )
    assert error < 2 * least < 0.01 * wrong_error


def test_a_residual_of_random_torques_beats_the_wrong_body():
    nominal = casadi_model(wrong_system("pendubot", 0.15, 3))
    data = transitions(random_record("pendubot", 5.0, 0), "pendubot")
    test = transitions(random_record("pendubot", 5.0, 1), "pendubot")
    model = learn(data, nominal, points=80)
    truth = true_model("pendubot").predict(test.states, test.inputs).mean
    assert torch.allclose(truth, test.next_states, atol=0.05)
    errors = [
        (f(test.states, test.inputs) - test.next_states).square().mean()
        for f in (lambda x, u: model.predict(x, u).mean, nominal)
    ]
    assert errors[0] < 0.3 * errors[1]


def test_the_board_is_sorted_and_has_shares_above_the_best():
    rows = [
        {
            "model": "gp",
            "seed": seed,
            "score": score,
            "median": 4.0,
            "p99": 9.0,
            "search": 600.0,
        }
        for seed, score in ((0, 0.7), (1, 0.6))
    ]
    lines = table("acrobot", rows).splitlines()
    assert (
        lines[3]
        == "| gpmpc, gp model | 2 of 2 seeds | 0.650 | 0.600 | 50 % | 4.0, 9.0 | 600 |"
    )
    assert [line.split("|")[1].strip() for line in lines[2:5]] == [
        "AR-EAPO",
        "gpmpc, gp model",
        "VIMPPI",
    ]


def test_what_was_learned_is_not_learned_again_by_the_same_code(monkeypatch, tmp_path):
    data = transitions(random_record("acrobot", 5.0, 0), "acrobot")
    learned = []

    def learned_model(robot, kind, seed):
        learned.append(
            learn(data, casadi_model(wrong_system(robot, 0.15, seed)), points=40)
        )
        return learned[-1], [1.0]

    monkeypatch.setattr(realaigym, "learned_model", learned_model)
    write_entry("acrobot", "residual", 3, tmp_path)
    entry = write_entry("acrobot", "residual", 3, tmp_path)
    found = read_model(
        "acrobot", "residual", entry.with_name("gpmpc_residual_3.safetensors")
    )
    expected = learned[0].predict(data.states[:5], data.inputs[:5])
    assert len(learned) == 1
    assert torch.equal(
        found.predict(data.states[:5], data.inputs[:5]).mean, expected.mean
    )
    code = realaigym.code_fingerprint()
    monkeypatch.setattr(realaigym, "code_fingerprint", lambda: "another")
    write_entry("acrobot", "residual", 3, tmp_path)
    assert len(learned) == 2
    files = {path.name for path in entry.parent.glob("*.safetensors")}
    assert files == {
        "gpmpc_residual_3.safetensors",
        f"gpmpc_residual_3.{code[:8]}.safetensors",
    }


SCRIPT = """
import importlib, pathlib, sys
import numpy as np
name = sys.argv[1].removesuffix(".py")
module = importlib.import_module(name)
state = np.array([np.pi + 0.1, 0.0, 0.0, 0.0])
output = module.controller.get_control_output
torques = [output(state, 0.002 * k) for k in range(3)]
folder = pathlib.Path("data", module.leaderboard_config["csv_path"]).parent
folder.mkdir(parents=True)
entry = f"Controller,RealAI Score\\nGP-MPC,{abs(torques[-1][0])}\\n"
(folder / "leaderboard_entry.csv").write_text(entry)
"""


def test_the_leagues_script_flies_the_file_that_was_written(monkeypatch, tmp_path):
    source = tmp_path / "src" / "python"
    script = tmp_path / "leaderboard" / "pendubot" / "simulation_v3"
    (source / "double_pendulum" / "controller").mkdir(parents=True)
    (source / "double_pendulum" / "__init__.py").write_text("")
    (source / "double_pendulum" / "controller" / "abstract_controller.py").write_text(
        "class AbstractController:\n"
        "    def init(self):\n        pass\n"
        "    def get_control_output(self, x, t):\n        return "
        "self.get_control_output_(x, t)\n"
    )
    script.mkdir(parents=True)
    (script / "calculate_leaderboard_score.py").write_text(SCRIPT)
    root = Path(realaigym.__file__).parents[1]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"src/python:{root}")
    monkeypatch.setattr(sys, "path", [str(source), *sys.path])
    entry = write_entry("pendubot", "true", 0, tmp_path / "kept")
    monkeypatch.setattr(realaigym, "which", lambda program: None)
    with pytest.raises(SettingError, match="board=script needs ffmpeg on PATH"):
        play_script(entry, "pendubot")
    monkeypatch.setattr(realaigym, "which", lambda program: program)
    torque = play_script(entry, "pendubot")
    assert 0 < torque <= 6.0  # the shoulder is driven back upright
    shutil.rmtree(script)
    with pytest.raises(
        SettingError,
        match="board=script needs the repository, not only its package: the league's",
    ):
        play_script(tmp_path / "kept" / "con_gpmpc_true_0.py", "pendubot")


def test_draws_that_were_played_are_read_and_not_played_again(monkeypatch, tmp_path):
    played = []

    def play(who, robot, seed):
        played.append(seed)
        who.seconds = [0.5, 0.002]
        who.searched = [True, False]
        return Play(seed / 1000, np.zeros((1, 4)), np.zeros((0, 2)))

    monkeypatch.setattr(realaigym, "play", play)
    first = board("acrobot", "true", [0], [100, 101], tmp_path)
    again = board("acrobot", "true", [0], [100, 101, 102], tmp_path)
    assert played == [100, 101, 102]
    assert again[:2] == first
    assert [row["score"] for row in again] == [0.1, 0.101, 0.102]
    assert again[0]["search"] == 500.0
    assert again[0]["version"]


def test_draws_of_other_code_are_played_again_beside_them(
    monkeypatch, tmp_path, capsys
):
    scores = iter((0.1, 0.2, 0.3))
    others = dict.fromkeys(("search", "median", "p99"), 0.5)
    monkeypatch.setattr(realaigym, "find_spec", lambda name: name)
    monkeypatch.setattr(
        realaigym,
        "_play",
        lambda model, robot, draw: others | {"score": next(scores)},
    )
    command = ["robot=acrobot", "model=true", f"folder={tmp_path}"]
    assert main([*command, "draws=1"]) == 0
    assert "other code" not in capsys.readouterr().out
    monkeypatch.setattr(realaigym, "code_fingerprint", lambda: "another")
    assert main([*command, "draws=2"]) == 0
    printed = capsys.readouterr().out
    store = tmp_path / "acrobot" / "gpmpc_true_0.json"
    assert f"1 draws of other code are not shown ({store})" in printed
    assert "| 0.250 | 0.200 |" in printed  # the mean and worst of the two new ones
    kept = [(row["draw"], row["score"]) for row in json.loads(store.read_text())]
    assert kept == [(100, 0.1), (100, 0.2), (101, 0.3)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            [],
            "realaigym: simulator: the league's simulator is not installed: git clone "
            "https://github.com/dfki-ric",
        ),
        (
            ["robot=arm"],
            "realaigym: robot: must be one of acrobot, pendubot; got 'arm'",
        ),
        (
            ["model=best"],
            "realaigym: model: must be one of true, residual, gp; got 'best'",
        ),
        (
            ["board=chess"],
            "realaigym: board: must be one of simulation, script, robustness, film; "
            "got 'chess'",
        ),
        (
            ["speed=2"],
            "realaigym: speed: must be one of robot, model, seeds, draws, board, time, "
            "folder",
        ),
        (
            ["board=film", "time=real"],
            "realaigym: time: must be free for board=script and board=film",
        ),
        (["seeds=0,,1"], "realaigym: seeds, draws: must be numbers such as"),
        (["draws=many"], "realaigym: seeds, draws: must be numbers such as"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr(realaigym, "find_spec", lambda name: None)
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(message)
    assert said.count("\n") == 1


def test_our_equations_are_those_of_the_leagues_simulator(rng):
    plants = pytest.importorskip("double_pendulum.model.plant")
    plant = plants.DoublePendulumPlant(
        model_pars=realaigym.league_parameters([6.0, 6.0])
    )
    ours = right_hand_side()
    for _ in range(20):
        x = rng.normal(size=4) * [2.0, 2.0, 10.0, 10.0]
        torques = rng.uniform(-6, 6, 2)
        assert np.allclose(
            ours(0.0, x, torques), plant.rhs(0.0, x, torques), rtol=1e-9, atol=1e-9
        )


@pytest.mark.slow
def test_the_true_model_swings_up_in_the_unmodified_simulation():
    pytest.importorskip("double_pendulum")
    who = pilot(true_model("pendubot"), "pendubot", wild=False)
    found = realaigym.play(who, "pendubot", 0, seconds=3.0, unmodified=True)
    assert found.score > 0.6
