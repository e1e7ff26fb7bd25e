"""Plays the double pendulum of the RealAIGym league (simulation board of 2025).

Swing up from anywhere, and stay there.

``python -m benchmarks.realaigym robot=acrobot model=residual seeds=0,1 draws=3`` learns
a model, lets the league's own classes disturb and simulate, and prints the board with a
row of ours. Models: ``true`` (the published equations and parameters), ``residual`` (a
rigid body, each of whose parameters is 15 % wrong at first, is fitted by least squares,
and a GP learns what is left) and ``gp`` (a GP alone). They are learned from 60 s: 20 s
of random torque, then four times 10 s of the league's own test under the model learned
so far. They are kept in ``folder=``, with a file ``con_gpmpc_*.py`` that flies them in
the league's own scripts; ``board=script`` runs the league's unmodified one.
``board=robustness`` flies as many values of each quantity of the robustness board as
``draws=`` says (league: 21). ``board=film`` draws 8 s as a GIF. With ``time=real`` what
is computed takes effect as much later as it took (``realaigym_real_time``).

The league's simulator: github.com/dfki-ric-underactuated-lab/double_pendulum, its
``src/python`` on PYTHONPATH.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import casadi
import numpy as np
import pandas
import torch
from scipy.optimize import least_squares

from gpmpc._files import write_whole
from gpmpc._provenance import code_fingerprint, provenance
from gpmpc.exceptions import GpmpcError, SettingError
from gpmpc.gp import (
    Trainer,
    Transitions,
    informative_points,
    load_metadata,
    standardize,
)
from gpmpc.models import (
    Affine,
    CasadiFunction,
    Features,
    KnownModel,
    ResidualModel,
    RollOut,
    load_model,
    save_model,
)
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Decision,
    ManyStarts,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
    dlqr,
)
from gpmpc.propagation import Linearization
from gpmpc.systems import System, double_pendulum, step, step_many

Array = np.ndarray

ACTUATED = {"acrobot": "elbow", "pendubot": "shoulder"}
JOINTS = {"acrobot": 1, "pendubot": 0}
RATES = {"acrobot": 0.1, "pendubot": 0.02}  # weights of rates [s^2/rad^2]
TURNS = {
    "acrobot": (2, 3),
    "pendubot": (3, 4),
}  # of both joints, that a search without a clock takes for goals
# simulation board of 2025: mean score of the best entries, acados with the true model,
# and MC-PILCO (GP)
PUBLISHED = {
    "acrobot": {
        "AR-EAPO": 0.658,
        "VIMPPI": 0.648,
        "acados MPC": 0.630,
        "MC-PILCO": 0.307,
    },
    "pendubot": {
        "VIMPPI": 0.799,
        "AR-EAPO": 0.759,
        "acados MPC": 0.726,
        "MC-PILCO": 0.509,
    },
}
INSTALL = (
    "the league's simulator is not installed: git clone "
    "https://github.com/dfki-ric-underactuated-lab/double_pendulum, "
    "put its src/python on PYTHONPATH, and pip install dill tabulate lxml filterpy "
    "pyyaml sympy"
)
# time steps of plans and of torques [s]
PLAN = 0.02
INPUT = 0.002
TICKS = round(PLAN / INPUT)  # inputs in a plan's time step
# limit [N m], height to be above [m], length of a test [s]
TORQUE = 6.0
LINE = 0.45
DURATION = 60.0
LENGTHS = 0.2, 0.3  # [m]
WILD = 25.0, 38.0  # rates beyond which transitions are not learned from [rad/s]
REPLAN = 5.0  # predicted time below the line above which a plan is given up [s]
BRAKE = 0.3  # torque against the actuated joint's rate without a plan [N m s/rad]
# plans' time steps that the joint is braked for after a search that found no way up
PAUSE = 10


def state_of(x: Any) -> Array:
    """Returns our state (shoulder from upright, its rate, elbow, its rate).

    The league's (angles, rates) hang at zero.
    """
    return np.array([x[0] - np.pi, x[2], x[1], x[3]], dtype=float)


def heights(states: Array) -> Array:
    """Height of the tip (...,) over the shoulder [m]."""
    return LENGTHS[0] * np.cos(states[..., 0]) + LENGTHS[1] * np.cos(
        states[..., 0] + states[..., 2]
    )


def upright(states: Array) -> Reference:
    """Returns upright states (H + 1, n) in the turns nearest to a plan's end."""
    goal = np.zeros_like(states)
    goal[:, [0, 2]] = 2 * np.pi * np.round(states[-1, [0, 2]] / (2 * np.pi))
    return Reference(goal)


def casadi_model(system: System) -> CasadiFunction:
    """The step of a system as a function that can be linearised."""
    x = casadi.SX.sym("x", len(system.state_names))
    u = casadi.SX.sym("u", len(system.input_names))
    return CasadiFunction(
        casadi.Function("successor", [x, u], [casadi.vertcat(*system.successor(x, u))])
    )


def fine_model(robot: str, body: list[float] | None = None) -> KnownModel:
    """A rigid body over 2 ms; by default the true one."""
    system = (
        double_pendulum(ACTUATED[robot])
        if body is None
        else _with_parameters(robot, np.array(body))
    )
    return KnownModel(casadi_model(replace(system, time_step=INPUT, substeps=1)), 4, 1)


def wrong_system(robot: str, error: float, seed: int) -> System:
    """Returns the pendulum with all parameters wrong by a share, at random."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], 7)
    return _with_parameters(robot, _parameters(double_pendulum()) * (1 + error * signs))


def fit_body(robot: str, start: System, data: Transitions) -> System:
    """Fits masses, lengths and inertias to transitions.

    It takes least squares on their logarithms from ``start`` on.

    Five combinations of the seven decide the motion, and only these are found: the
    second moments about both joints, the coupling of the links, and the weights' two
    moments.
    """
    x = data.states.numpy()
    u = data.inputs.numpy()
    after = data.next_states.numpy()

    def errors(logarithms: Array) -> Array:
        return (
            step_many(_with_parameters(robot, np.exp(logarithms)), x, u) - after
        ).ravel()

    return _with_parameters(
        robot, np.exp(least_squares(errors, np.log(_parameters(start))).x)
    )


def _parameters(system: System) -> Array:
    d = system.dynamics
    return np.array([*d.masses, d.first_length, *d.centres, *d.inertias])


def _with_parameters(robot: str, values: Array) -> System:
    m1, m2, length, c1, c2, i1, i2 = map(float, values)
    parts = {
        "masses": (m1, m2),
        "first_length": length,
        "centres": (c1, c2),
        "inertias": (i1, i2),
    }
    return double_pendulum(ACTUATED[robot], **parts)


@dataclass
class Pilot:
    """Flies a plan at 50 Hz and its feedback at 500 Hz.

    It searches anew when the league takes the pendulum away.

    Where no start leads up, the motor brakes its joint before the next search: flown
    on, such plans spin the links faster and faster, beyond what a model was learned
    from.

    Attributes:
        controller: Of plans.
        joint: With the motor: 0, 1.
        gain: Share of the feedback that is applied between plans.
        seconds: Time of each decision [s].
        searched: Decisions that began without a plan.
    """

    controller: ManyStarts
    joint: int
    gain: float = 1.0
    seconds: list[float] = field(default_factory=list)
    searched: list[bool] = field(default_factory=list)
    _loop: ControlLoop | None = None
    _last: float = -1.0
    _count: int = 0  #: inputs since the last decision
    _held: float = 0.0  #: torque of the last decision [N m]
    _pause: int = 0  #: decisions that are left to brake

    def torques(self, x: Any, t: float) -> Array:
        """Returns the torques of both joints (2,) at a state and a time [s]."""
        state = state_of(x)
        if abs(t - self._last) > 1.5 * INPUT:
            self._loop = None
            self._count = 0
            self._pause = 0
        self._last = t
        torque = self._held
        if self._count == 0:
            torque = self._held = self._decide(state)
        elif self._loop is not None and self.gain > 0:
            between = float(
                self._loop.input_between(state, self._count * INPUT / PLAN)[0]
            )
            torque += self.gain * (between - torque)
        self._count = (self._count + 1) % TICKS
        out = np.zeros(2)
        out[self.joint] = np.clip(torque, -TORQUE, TORQUE)
        return out

    def _decide(self, state: Array) -> float:
        """The torque of the next plan, or one that brakes."""
        brake = -BRAKE * float(state[1 + 2 * self.joint])
        if self._pause > 0:
            self._pause -= 1
            return brake
        begin = perf_counter()
        without = self._loop is None
        loop = ControlLoop(self.controller) if self._loop is None else self._loop
        torque = float(loop.input(state, Reference(np.zeros(4)))[0])
        if not (without or self._leads_up(loop)):  # a search may find a better plan
            loop = ControlLoop(self.controller)
            torque = float(loop.input(state, Reference(np.zeros(4)))[0])
        self.seconds.append(perf_counter() - begin)
        self.searched.append(without)
        if not self._leads_up(loop):
            self._loop = None
            self._pause = PAUSE - 1
            return brake
        self._loop = loop
        return torque

    def _leads_up(self, loop: ControlLoop) -> bool:
        """Whether the plan of the last decision is worth following."""
        plan = loop.last.decision
        if not plan.applicable:
            return False
        return self.controller.criterion(plan, upright(plan.means)) <= REPLAN


class Flies(Protocol):
    """What flies the pendulum."""

    def torques(self, x: Any, t: float) -> Array:
        """Returns the torques of both joints (2,) at a state and a time [s]."""
        ...


def league_controller(base: type, pilot: Flies) -> Any:
    """A controller in the league's interface that a pilot flies."""

    class GPMPCController(base):
        def get_control_output_(self, x: Any, t: float | None = None) -> Array:
            return pilot.torques(x, 0.0 if t is None else t)

    return GPMPCController()


ENTRY = '''\
"""GP-MPC in the league's interface.

This file and the model beside it stand in leaderboard/{robot}/simulation_v3.
"""

from pathlib import Path

from double_pendulum.controller.abstract_controller import AbstractController
from benchmarks.realaigym import league_controller, pilot, read_model

leaderboard_config = {{
    "csv_path": "{name}/sim_swingup.csv",
    "name": "{name}",
    "simple_name": "GP-MPC ({kind})",
    "short_description": "MPC from many starts on {described}.",
    "readme_path": "readmes/{name}.md",
    "username": "gpmpc",
}}
model = read_model("{robot}", "{kind}", Path(__file__).with_name("{name}.safetensors"))
controller = league_controller(AbstractController, pilot(model, "{robot}"))
controller.init()
'''
DESCRIBED = {
    "true": "the true model",
    "residual": "a fitted rigid body and a GP of its error from 60 s of interaction",
    "gp": "a GP from 60 s of interaction",
}


def read_model(robot: str, kind: str, path: Path) -> Any:
    """The model of a file, or the true one."""
    return (
        KnownModel(casadi_model(double_pendulum(ACTUATED[robot])), 4, 1)
        if kind == "true"
        else load_model(path)
    )


def write_entry(robot: str, kind: str, seed: int, folder: Path) -> Path:
    """Writes a controller file for the league's scripts, and beside it the model.

    The model is learned first where there is none that this code has learned; one that
    other code has learned stays under another name.

    Returns the path of the controller file, ``con_gpmpc_*.py``.
    """
    name = f"gpmpc_{kind}_{seed}"
    model = folder / robot / f"{name}.safetensors"
    entry = folder / robot / f"con_{name}.py"
    entry.parent.mkdir(parents=True, exist_ok=True)
    if kind != "true" and not _was_learned_by_this_code(model):
        begin = perf_counter()
        learned, body = learned_model(robot, kind, seed)
        about = {"robot": robot, "seed": seed, "body": body}
        save_model(learned, model, about | {"code": code_fingerprint()})
        _say(f"  learned in {perf_counter() - begin:.0f} s: {model}")
    write_whole(
        entry,
        ENTRY.format(robot=robot, kind=kind, name=name, described=DESCRIBED[kind]),
    )
    return entry


def _was_learned_by_this_code(model: Path) -> bool:
    """Whether there is a model of this code; one of other code is renamed."""
    if not model.exists():
        return False
    code = load_metadata(model)["metadata"].get("code", "older")
    if code == code_fingerprint():
        return True
    other_name = model.with_name(f"{model.stem}.{code[:8]}{model.suffix}")
    model.replace(other_name)
    _say(f"  learned by other code, and now called {other_name.name}: {model.name}")
    return False


def beside(entry: Path, ending: str) -> Path:
    """The file that an entry shares its name with, such as its model."""
    return entry.with_name(entry.stem.removeprefix("con_") + ending)


def play_robustness(entry: Path, robot: str, kind: str, size: int) -> str:
    """Returns the parts of the league's robustness board as a table.

    Each quantity takes a number of values.
    """
    from double_pendulum.controller.abstract_controller import AbstractController

    from benchmarks.realaigym_robustness import Watchful, robustness

    path = beside(entry, ".safetensors")
    model = read_model(robot, kind, path)
    fine = fine_model(
        robot, None if kind == "true" else load_metadata(path)["metadata"]["body"]
    )
    who = Watchful(_real_time_pilot(model, robot), RollOut(fine), JOINTS[robot])
    store = beside(entry, f"_robustness_{size}_{code_fingerprint()[:8]}.json")
    successes_by_part = robustness(
        league_controller(AbstractController, who), robot, size, store
    )
    shares = {
        part: float(np.mean(successes)) for part, successes in successes_by_part.items()
    }
    lines = [
        f"| {robot}, robustness 2, {kind} model | flights | up after 10 s |",
        "|---|---|---|",
    ]
    lines += [
        f"| {part} | {len(successes_by_part[part])} | {share:.3f} |"
        for part, share in shares.items()
    ]
    return "\n".join([*lines, f"| mean | | {np.mean(list(shares.values())):.3f} |"])


def play_film(entry: Path, robot: str, kind: str) -> Path:
    """Writes the first 8 s of draw 100 as a GIF beside an entry."""
    from benchmarks.realaigym_film import film

    path = beside(entry, ".gif")
    model = read_model(robot, kind, beside(entry, ".safetensors"))
    film(play(pilot(model, robot), robot, 100, 8.0), JOINTS[robot], path)
    return path


def play_script(entry: Path, robot: str) -> float:
    """Returns the score by the league's script, which draws without a seed."""
    package = find_spec("double_pendulum")
    where = (
        Path(str(package and package.origin)).resolve().parents[3]
        / "leaderboard"
        / robot
        / "simulation_v3"
    )
    if not where.is_dir():
        raise SettingError(
            "simulator",
            f"board=script needs the repository, not only its package: {INSTALL}",
        )
    if which("ffmpeg") is None:
        raise SettingError(
            "simulator",
            "board=script needs ffmpeg on PATH: the league's script draws a video",
        )
    results = where / "data" / beside(entry, "").name
    (results / "sim_swingup.csv").unlink(
        missing_ok=True
    )  # the script would score it again
    search_paths = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    paths = [
        str(Path(path).resolve()) for path in (entry.parent, *search_paths)
    ]  # the script runs in its own folder
    command = [sys.executable, "calculate_leaderboard_score.py", entry.name]
    subprocess.run(
        command,
        cwd=where,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        check=True,
    )
    return float(
        pandas.read_csv(results / "leaderboard_entry.csv")["RealAI Score"].iloc[0]
    )


class Parts(NamedTuple):
    """What a pilot is made of."""

    controller: GPMPC  #: improves a plan from decision to decision
    #: takes several programs a start, with the fitted body alone where there is one
    planner: GPMPC
    guesses: list[Array | None]  #: to start from: the straight line, the drift, kicks
    criterion: Callable[
        [Decision, Reference], float
    ]  #: predicted time below the line, more where the end is off [s]


def make_parts(
    model: Any,
    rate: float,
    horizon: int = 40,
    programs: int = 20,
    wild: bool = True,
    kept: int = 1,
) -> Parts:
    """Makes the parts of a pilot.

    Args: model: Predicts the state 20 ms later. rate: Weight of both rates [s^2/rad^2];
        angles have 10 [1/rad^2]. horizon: H, stages of 20 ms. programs: Of each start.
        wild: Whether starts with kicks are taken besides the straight line and the
        drift. kept: Programs of a decision from a plan.
    """
    Q = np.diag([10.0, rate, 10.0, rate])
    R = np.array([[0.01]])
    still = model.linearize(np.zeros((1, 4)), np.zeros((1, 1)), False)
    P = _cost_to_go(still.A[0], still.B[0], Q, R)
    problem = Problem(
        Tracking(Q, R, 10.0 * P, penalized="inputs", angles=(0, 2)),
        inputs=Box([-TORQUE], [TORQUE]),
    )

    def time_below(decision: Decision, reference: Reference) -> float:
        off = decision.means[-1] - reference.states[-1]
        below = PLAN * float(np.sum(heights(decision.means[1:]) < LINE))
        return below + min(10.0, float(off @ P @ off) / 15.0)

    def make(iterations: int) -> GPMPC:
        settings = PredictionSettings(covariance="none", rolled_out=True)
        return GPMPC(
            model,
            Linearization(),
            problem,
            horizon,
            [0.0],
            settings,
            iterations=iterations,
            tolerance=1e-2,
        )

    guesses: list[Array | None] = [None, np.zeros((horizon, 1))]
    if wild:
        for sign in (0.5, -0.5):
            kick = np.zeros((horizon, 1))
            kick[: horizon // 6] = sign * TORQUE
            kick[horizon // 6 : horizon // 3] = -sign * TORQUE
            guesses.append(kick)
    nominal = getattr(model, "nominal", None)
    quick = (
        model if getattr(nominal, "tape", None) is None else KnownModel(nominal, 4, 1)
    )
    return Parts(make(kept), make(programs).with_model(quick), guesses, time_below)


def pilot(model: Any, robot: str, gain: float = 1.0, **settings: Any) -> Pilot:
    """Makes the pilot of a model that takes all the time it likes.

    Settings are those of ``make_parts``.
    """
    controller, planner, guesses, criterion = make_parts(
        model, RATES[robot], **settings
    )
    return Pilot(
        ManyStarts(controller, planner, guesses, TURNS[robot], criterion),
        JOINTS[robot],
        gain,
    )


def _cost_to_go(A: Array, B: Array, Q: Array, R: Array) -> Array:
    K = dlqr(A, B, Q, R)
    closed = A - B @ K
    P = Q + K.T @ R @ K
    total = np.zeros_like(A)
    for _ in range(5000):
        total = total + P
        P = closed.T @ P @ closed
    return (total + total.T) / 2


@dataclass
class Play:
    """One test of the league's, or its beginning.

    Attributes:
        score: Share of the time with the tip above the line.
        states: The league's, every 2 ms (T + 1, 4).
        torques: Applied (T, 2).
    """

    score: float
    states: Array
    torques: Array


def play(
    who: Flies,
    robot: str,
    seed: int,
    seconds: float = DURATION,
    unmodified: bool = False,
) -> Play:
    """Runs the league's simulation and disturbances, drawn from a seed.

    Args: who: Flies. robot: ``"acrobot"`` or ``"pendubot"``. seed: Of the disturbances.
        seconds: Of 60. unmodified: Also the plant's right-hand side is the league's
        code, which takes ten times longer than ours.
    """
    from double_pendulum.analysis.leaderboard import get_uptime
    from double_pendulum.controller.abstract_controller import AbstractController
    from double_pendulum.controller.global_policy_testing_controller import (
        GlobalPolicyTestingControllerV2,
    )
    from double_pendulum.model.plant import DoublePendulumPlant
    from double_pendulum.simulation.simulation import Simulator

    limited, unlimited = (
        league_parameters(limits) for limits in (torque_limits(robot), [TORQUE, TORQUE])
    )
    plant = DoublePendulumPlant(model_pars=unlimited)
    if not unmodified:
        plant.rhs = right_hand_side()
    np.random.seed(seed)  # noqa: NPY002 (the league draws from it)
    controller = GlobalPolicyTestingControllerV2(
        league_controller(AbstractController, who),
        goal=[np.pi, 0.0, 0.0, 0.0],
        n_disturbances=15,
        t_max=DURATION,
        reset_length=0.2,
        mpar=unlimited,
    )
    times, states, torques = Simulator(plant=plant).simulate(
        0.0, [0.0] * 4, seconds, INPUT, controller, "runge_kutta"
    )
    times = np.array(times)
    states = np.array(states)
    return Play(
        get_uptime(times, states, mpar=limited) / seconds,
        states,
        np.array(torques)[:, :2],
    )


def league_parameters(limits: list[float]) -> Any:
    """Returns the league's parameters of design C.1, model 1.1, from our system.

    Friction and motor inertia are left out.
    """
    from double_pendulum.model.model_parameters import model_parameters

    d = double_pendulum().dynamics
    parameters = model_parameters()
    parameters.set_mass(list(d.masses))
    parameters.set_length(list(LENGTHS))
    parameters.set_com(list(d.centres))
    parameters.set_inertia(
        [i + m * r * r for i, m, r in zip(d.inertias, d.masses, d.centres, strict=True)]
    )
    parameters.set_gravity(9.81)
    parameters.set_motor_inertia(0.0)
    parameters.set_damping([0.0, 0.0])
    parameters.set_cfric([0.0, 0.0])
    parameters.set_torque_limit(limits)
    return parameters


def torque_limits(robot: str) -> list[float]:
    """Largest torques of both joints [N m]."""
    return [0.0, TORQUE] if robot == "acrobot" else [TORQUE, 0.0]


def right_hand_side() -> Callable[[float, Array, Array], Array]:
    """d/dt of the league's state under two torques, by our own equations."""
    shoulder, elbow = (
        double_pendulum(ACTUATED[robot]).dynamics for robot in ("pendubot", "acrobot")
    )

    def derivative(t: float, x: Array, tau: Array) -> Array:
        state = [x[0] - np.pi, float(x[2]), float(x[1]), float(x[3])]
        first = shoulder.derivative(state, [float(tau[0])])
        second = elbow.derivative(state, [0.0])
        driven = elbow.derivative(state, [float(tau[1])])
        return np.array(
            [x[2], x[3], *(first[i] + driven[i] - second[i] for i in (1, 3))]
        )

    return derivative


def random_record(robot: str, seconds: float, seed: int) -> list[Play]:
    """Returns records of 2 s, hanging at first, under random torques.

    The torques are drawn anew every 0.1 s.
    """
    system = replace(double_pendulum(ACTUATED[robot], time_step=INPUT), substeps=1)
    rng = np.random.default_rng(seed)
    joint = JOINTS[robot]
    records = []
    for _ in range(round(seconds / 2)):
        state = np.array([np.pi, 0.0, 0.0, 0.0])
        states = []
        torques = []
        for k in range(1000):
            torque = rng.uniform(-TORQUE, TORQUE) if k % 50 == 0 else torques[-1][joint]
            states.append([state[0] + np.pi, state[2], state[1], state[3]])
            torques.append(np.eye(2)[joint] * torque)
            state = step(system, state, np.array([torque]))
        states.append([state[0] + np.pi, state[2], state[1], state[3]])
        records.append(Play(0.0, np.array(states), np.array(torques)))
    return records


def transitions(records: list[Play], robot: str, spread: float = 0.05) -> Transitions:
    """Returns transitions over 20 ms.

    The torque changed by at most ``spread`` [N m], and there is none on the passive
    joint.
    """
    joint = JOINTS[robot]
    count = round(PLAN / INPUT)
    states = []
    inputs = []
    after = []
    for record in records:
        for i in range(0, len(record.torques) - count, count // 2):
            u = record.torques[i : i + count]
            ends = [state_of(record.states[j]) for j in (i, i + count)]
            calm = np.abs(ends)[:, [1, 3]].max(axis=0) < WILD
            if (
                np.ptp(u[:, joint]) <= spread
                and not u[:, 1 - joint].any()
                and calm.all()
            ):
                states.append(ends[0])
                inputs.append([u[:, joint].mean()])
                after.append(ends[1])
    return Transitions(np.array(states), np.array(inputs), np.array(after))


def learn(
    data: Transitions, nominal: Any, before: Any = None, points: int = 700
) -> ResidualModel:
    """Learns what a nominal model misses from the most informative transitions.

    The hyperparameters are trained from those of the model ``before`` on.
    """
    scales = torch.tensor(
        [1.5, 1.5, 9.0, 1.5, 1.5, 9.0, 9.0], dtype=torch.float64
    )  # sine, cosine, rate, ..., torque
    trainer = Trainer(
        predicts="value",
        scaling=standardize,
        restarts=0,
        subset=None,
        tolerance=1e-6,
        signal_to_noise_limit=3e3,
    )
    x = data.states
    u = data.inputs
    learned_data = (
        torch.cat(Features(range(4), [0], (0, 2), 4, 1)(x, u), dim=1),
        data.next_states - nominal(x, u),
    )
    one = torch.ones(1, dtype=torch.float64)
    noise = torch.full((1,), 1e-8, dtype=torch.float64)
    rows = informative_points(learned_data[0], (scales[None], one, noise), points)
    features, targets = (part[rows] for part in learned_data)
    posterior = trainer.fit(
        features, targets, 1, start=None if before is None else before.residual
    ).posterior
    return ResidualModel(
        nominal, posterior, torch.eye(4, dtype=torch.float64), range(4), [0], 1, (0, 2)
    )


def learned_model(
    robot: str, kind: str, seed: int, error: float = 0.15
) -> tuple[Any, list[float]]:
    """Returns the model and its body.

    They come from 20 s of random torque and four times 10 s of the league's test.
    """
    nominal: Any = Affine.identity(4, 1)
    nominal.A[[0, 2], [1, 3]] = PLAN  # an angle moves by its rate
    body = wrong_system(robot, error, seed)
    model = None
    records = random_record(robot, 20.0, seed)
    for round_ in range(5):
        data = transitions(records, robot)
        if kind == "residual":
            body = fit_body(robot, body, data)
            nominal = casadi_model(body)
        model = learn(data, nominal, model)
        if round_ < 4:
            who = pilot(model, robot, wild=False, gain=0.0)
            records.append(play(who, robot, 5000 + 100 * seed + round_, 10.0))
            _say(
                f"  round {round_ + 1}: {30 + 10 * round_} s of interaction, score "
                f"{records[-1].score:.3f}"
            )
    return model, _parameters(body).tolist()


def board(
    robot: str,
    kind: str,
    seeds: list[int],
    draws: list[int],
    folder: Path,
    real_time: bool = False,
) -> list[dict[str, Any]]:
    """Plays a number of draws with the model of each seed.

    Prints and returns one row for each play.

    Rows that the folder holds already are read, not played again. Those of other code
    stay in their file and are none of them.
    """
    rows = []
    code = code_fingerprint()
    for seed in seeds:
        entry = write_entry(robot, kind, seed, folder)
        store = beside(entry, "_real_time.json" if real_time else ".json")
        played = json.loads(store.read_text()) if store.exists() else []
        model = read_model(robot, kind, beside(entry, ".safetensors"))
        of_other_code = sum(row.get("code") != code for row in played)
        if of_other_code:
            _say(f"  {of_other_code} draws of other code are not shown ({store})")
        for draw in draws:
            if not any(
                (row["draw"], row.get("code")) == (draw, code) for row in played
            ):
                played.append(
                    {
                        "robot": robot,
                        "model": kind,
                        "seed": seed,
                        "draw": draw,
                        "version": _version(),
                        "code": code,
                    }
                )
                played[-1] |= (
                    _play_in_real_time(model, robot, draw)
                    if real_time
                    else _play(model, robot, draw)
                )
                write_whole(store, json.dumps(played, indent=1))
            rows += [
                row for row in played if (row["draw"], row.get("code")) == (draw, code)
            ]
            _say(
                "  "
                + "  ".join(
                    f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}"
                    for k, v in rows[-1].items()
                    if k != "code"
                )
            )
    return rows


def _version() -> str:
    """Returns the commit of the checkout, or the version of the package."""
    origin = provenance()
    return (
        origin["versions"]["gpmpc"]
        if origin["git"] is None
        else origin["git"]["commit"]
    )


def _play(model: Any, robot: str, draw: int) -> dict[str, Any]:
    who = pilot(model, robot)
    flight = play(who, robot, draw)
    ms = 1e3 * np.array(who.seconds)
    search = np.array(who.searched)
    return {
        "score": flight.score,
        "searches": int(search.sum()),
        "search": float(np.median(ms[search])),
        "median": float(np.median(ms[~search])),
        "p99": float(np.quantile(ms[~search], 0.99)),
    }


def _play_in_real_time(model: Any, robot: str, draw: int) -> dict[str, Any]:
    who = _real_time_pilot(model, robot)
    flight = play(who, robot, draw)
    ms = 1e3 * np.array(who.seconds)
    between = 1e3 * np.array(who.between)
    return {
        "score": flight.score,
        "searches": len(who.searched),
        "search": 1e3 * float(np.median(who.searched)),
        "median": float(np.median(ms)),
        "p99": float(np.quantile(ms, 0.99)),
        "late decisions": float(np.mean(ms > 1e3 * PLAN)),
        "late inputs": float(np.mean(between > 1e3 * INPUT)),
    }


def _real_time_pilot(model: Any, robot: str) -> Any:
    """The pilot of a model in real time.

    Few starts have converged after their programs: with one program a decision 60 % of
    their plans are lost.
    """
    from benchmarks.realaigym_real_time import real_time_pilot

    return real_time_pilot(make_parts(model, RATES[robot], kept=3), JOINTS[robot])


def table(robot: str, rows: list[dict[str, Any]]) -> str:
    """The league's board with rows of ours: a line for each model."""
    best = max(PUBLISHED[robot].values())
    lines = [
        f"| {robot}, simulation 2025 | draws | mean | worst | above the best | "
        "decision ms (median, p99) | search ms |"
    ]
    lines += ["|---|---|---|---|---|---|---|"]
    ours = {}
    for kind in dict.fromkeys(row["model"] for row in rows):
        mine = [row for row in rows if row["model"] == kind]
        scores = np.array([row["score"] for row in mine])
        cells = (
            f"{len(scores)} of {len({row['seed'] for row in mine})} seeds",
            f"{scores.mean():.3f}",
            f"{scores.min():.3f}",
        )
        times = [
            np.median([row[key] for row in mine]) for key in ("median", "p99", "search")
        ]
        cells += (
            f"{100 * np.mean(scores > best):.0f} %",
            f"{times[0]:.1f}, {times[1]:.1f}",
            f"{times[2]:.0f}",
        )
        ours[f"gpmpc, {kind} model"] = scores.mean(), cells
    every = [
        (score, name, ("published", f"{score:.3f}", "", "", "", ""))
        for name, score in PUBLISHED[robot].items()
    ]
    every += [(score, name, cells) for name, (score, cells) in ours.items()]
    lines += [
        f"| {name} | {' | '.join(cells)} |"
        for _, name, cells in sorted(every, reverse=True)
    ]
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Reads settings such as ``robot=acrobot``, plays, and prints the board."""
    settings = {"robot": "acrobot", "model": "true", "seeds": "0", "draws": "3"}
    settings |= {"board": "simulation", "time": "free", "folder": "outputs/realaigym"}
    choices = {"robot": tuple(ACTUATED), "model": tuple(DESCRIBED)}
    choices |= {
        "board": ("simulation", "script", "robustness", "film"),
        "time": ("free", "real"),
    }
    try:
        for argument in arguments:
            key, _, value = argument.partition("=")
            if key not in settings:
                raise SettingError(key, f"must be one of {', '.join(settings)}")
            settings[key] = value
        for key, names in choices.items():
            if settings[key] not in names:
                raise SettingError(
                    key, f"must be one of {', '.join(names)}; got {settings[key]!r}"
                )
        if not all(
            number.isdigit()
            for number in (*settings["seeds"].split(","), settings["draws"])
        ):
            raise SettingError(
                "seeds, draws",
                "must be numbers such as 0,1 and a number of draws such as 3",
            )
        robot = settings["robot"]
        kind = settings["model"]
        folder = Path(settings["folder"])
        if settings["board"] == "robustness" and kind == "gp":
            raise SettingError(
                "model",
                "must be true or residual for board=robustness, which predicts over 2 "
                "ms",
            )
        if settings["board"] in ("script", "film") and settings["time"] == "real":
            raise SettingError("time", "must be free for board=script and board=film")
        if find_spec("double_pendulum") is None:
            raise SettingError("simulator", INSTALL)
        seeds = [int(seed) for seed in settings["seeds"].split(",")]
        draws = int(settings["draws"])
        if settings["board"] == "simulation":
            rows = board(
                robot,
                kind,
                seeds,
                [100 + i for i in range(draws)],
                folder,
                settings["time"] == "real",
            )
            _say(table(robot, rows))
            return 0
        for seed in seeds:
            entry = write_entry(robot, kind, seed, folder)
            if settings["board"] == "robustness":
                _say(play_robustness(entry, robot, kind, draws))
            elif settings["board"] == "film":
                _say(f"  {play_film(entry, robot, kind)}")
            else:
                for _ in range(draws):
                    _say(f"  seed {seed}  score {play_script(entry, robot):.3f}")
    except (GpmpcError, subprocess.CalledProcessError) as error:
        print(f"realaigym: {error}", file=sys.stderr)
        return 2
    return 0


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
