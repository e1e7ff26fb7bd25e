"""Foreign simulators are systems like any other, and this package's systems are
environments."""

import sys
from functools import partial

import numpy as np
import pytest

from gpmpc.datasets import RandomData
from gpmpc.exceptions import DataError, Diverged, SettingError
from gpmpc.gp import Trainer, standardize
from gpmpc.mpc import GPMPC, Box, Decision, Problem, Timing, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise, Replaced, closed_loop, closed_loops
from gpmpc.status import Status
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.systems import (
    cart_pole,
    double_integrator,
    planar_quadrotor,
    step,
    step_many,
)
from gpmpc.systems.gymnasium_ import (
    OURS,
    gymnasium_system,
    make_environment,
    register_environments,
)
from gpmpc.systems.mujoco_ import mujoco_system

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("mujoco")

CART = """
<mujoco model="cart">
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" damping="0.1"/>
      <geom type="box" size="0.1 0.1 0.05" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.02" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="push" joint="slider" ctrllimited="true" ctrlrange="-10 10" DYNTYPE/>
    <motor name="unused" joint="hinge"/>
  </actuator>
  <sensor>
    <jointpos name="position" joint="slider"/>
    <jointpos name="angle" joint="hinge"/>
    <jointvel name="velocity" joint="slider"/>
    <jointvel name="rate" joint="hinge"/>
    <framepos name="tip" objtype="body" objname="pole"/>
  </sensor>
</mujoco>
"""


@pytest.fixture
def cart(tmp_path):
    path = tmp_path / "cart.xml"
    path.write_text(CART.replace("DYNTYPE", ""))
    return path


@pytest.fixture
def lagging(tmp_path):
    path = tmp_path / "lagging.xml"
    path.write_text(CART.replace("DYNTYPE", 'dyntype="filter" dynprm="0.05"'))
    return path


@pytest.mark.parametrize("name", OURS)
@pytest.mark.filterwarnings(
    "ignore:.*we recommend using a symmetric and normalized space.*:UserWarning"
)
@pytest.mark.filterwarnings(
    "ignore:.*A Box observation space m.*imum value is -?infinity.*:UserWarning"
)
def test_our_systems_pass_gymnasiums_environment_checker(name):
    from gymnasium.utils.env_checker import check_env

    assert f"gpmpc/{name}-v0" in register_environments()
    check_env(gymnasium.make(f"gpmpc/{name}-v0").unwrapped, skip_render_check=True)


def test_our_environment_moves_as_its_system_and_ends_when_lost():
    environment, system = make_environment("planar_quadrotor"), planar_quadrotor()
    state, _ = environment.reset(seed=0)
    assert np.array_equal(state, system.start)
    for _ in range(200):
        expected = step(system, state, np.zeros(2))
        state, reward, terminated, truncated, _ = environment.step(np.zeros(2))
        assert np.array_equal(state, expected)
        assert reward == pytest.approx(-(np.hypot(state[0], state[2]) ** 2))
        assert not truncated
        if terminated:
            break
    assert terminated
    assert np.hypot(state[0], state[2]) > 10


def test_a_cart_under_a_hanging_pole_is_far_from_its_goal():
    environment = make_environment("cart_pole")
    environment.reset(seed=0)
    reward = environment.step(np.zeros(1))[1]
    assert reward == pytest.approx(-(np.pi**2))
    assert list(cart_pole().tracked_by_unit) == ["rad", "m"]


def pendulum_environment(**settings):
    names = {"state_names": ["cosine", "sine", "rate"], "tracked": ["cosine", "sine"]}
    return gymnasium_system("Pendulum-v1", goal=[1, 0, 0], **(names | settings))


def test_an_environment_is_learned_and_swung_up_like_a_system():
    system = pendulum_environment(units={"rate": "rad/s", "cosine": "1", "sine": "1"})
    assert (system.time_step, system.input_lower, system.input_upper) == (
        0.05,
        (-2.0,),
        (2.0,),
    )
    problem = Problem(
        Tracking([1, 1, 0.01], [0.01], penalized="inputs"), inputs=Box([-2], [2])
    )
    experiment = Experiment(
        RandomData(samples=400, episode=40),
        None,
        system,
        Trainer(predicts="difference", scaling=standardize),
        partial(
            GPMPC,
            propagator=Linearization(),
            problem=problem,
            horizon=25,
            initial_input=[0.0],
        ),
        steps=150,
    )
    first, again = (run_trial(experiment).rollout for _ in range(2))
    assert np.abs(first.states[-20:] - [1, 0, 0]).max() < 0.05
    assert np.array_equal(first.states, again.states)


class Pushing:
    """Always applies the same input."""

    horizon = 1
    initial_input = (1.0,)

    def __init__(self, input=1.0):
        self.input = input

    def control(self, belief, reference, previous=None):
        n = len(belief.mean)
        return Decision(
            [self.input],
            np.full((1, 1), self.input),
            np.zeros((2, n)),
            np.zeros((2, n, n)),
            Status.SOLVED,
            1,
            Timing(0, 0, 0),
        )


def test_an_episode_that_ends_is_a_lost_flight():
    system = gymnasium_system(
        make_environment("double_integrator"), time_step=0.1, tracked=["x1"]
    )
    with pytest.raises(
        Diverged, match="the simulator has ended its episode, at state"
    ) as caught:
        closed_loop(system, Pushing(), np.zeros((203, 2)), None, 200)
    assert np.abs(caught.value.rollout.states[-1, 0]) < 10
    with pytest.raises(SettingError, match="a simulator flies one seed after another"):
        closed_loops(system, Pushing(), np.zeros((3, 2)), None, 2, seeds=2)
    later = [Replaced(system, start=1e3)]
    plant = double_integrator()
    with pytest.raises(SettingError, match="a simulator flies one seed after another"):
        closed_loops(
            plant,
            Pushing(),
            np.zeros((3, 2)),
            [0.0, 0.0],
            2,
            seeds=2,
            disturbances=later,
        )


def test_a_simulator_as_an_environment_starts_where_it_does():
    environment = make_environment(pendulum_environment())
    start, _ = environment.reset(seed=1)
    after = environment.step(np.zeros(1))[0]
    assert not np.array_equal(after, start)
    assert not np.array_equal(environment.reset()[0], start)
    with pytest.raises(SettingError, match="must be a name where settings are given"):
        make_environment(planar_quadrotor(), mass=2.0)


def test_inputs_of_joints_are_recorded_as_clipped(cart):
    joints = mujoco_system(cart, ["push"], joints=["slider", "hinge"])
    flight = closed_loop(
        joints, Pushing(20.0), np.zeros((4, 4)), np.zeros(4), 2, noise=Noise(input=[1])
    )
    assert np.array_equal(flight.inputs, [[10.0], [10.0]])


def test_a_limit_of_steps_that_was_asked_for_ends_the_episode():
    register_environments()
    system = gymnasium_system(
        "gpmpc/double_integrator-v0", time_step=0.1, make={"max_episode_steps": 3}
    )
    state = system.dynamics.reset(0)
    for _ in range(3):
        assert not system.dynamics.ended
        state = step(system, state, [0.0])
    assert system.dynamics.ended


def test_mujoco_joints_and_sensors_agree_for_one_and_for_many(cart, rng):
    joints = mujoco_system(cart, ["push"], joints=["slider", "hinge"], substeps=4)
    sensors = mujoco_system(
        cart, ["push"], sensors=["position", "angle", "velocity", "rate"], substeps=4
    )
    assert joints.state_names == ("slider", "hinge", "slider_rate", "hinge_rate")
    assert sensors.state_names == ("position", "angle", "velocity", "rate")
    assert joints.time_step == 0.04
    assert joints.input_upper == (10.0,)
    state = other = sensors.dynamics.reset(0)
    for k in range(20):
        input = np.array([np.sin(k)])
        state, other = step(joints, state, input), step(sensors, other, input)
        assert np.array_equal(state, other)
    states, inputs = 0.1 * rng.normal(size=(7, 4)), rng.normal(size=(7, 1))
    alone = [step(joints, x, u) for x, u in zip(states, inputs, strict=True)]
    assert np.array_equal(step_many(joints, states, inputs), alone)
    states[2, 1] = np.inf
    others = np.arange(7) != 2
    together = step_many(joints, states, inputs)
    assert np.array_equal(together[others], np.array(alone)[others])
    assert np.isnan(together[2]).all()
    assert len(RandomData(samples=20, starts="start").transitions(joints)) == 20


def test_an_actuators_lag_is_a_state_and_a_delay_waits(cart, lagging):
    lag = mujoco_system(lagging, ["push"], joints=["slider", "hinge"], substeps=1)
    assert lag.state_names[-1] == "push_activation"
    state = np.zeros(5)
    for _ in range(5):
        state = step(lag, state, np.array([10.0]))
    assert state[4] == pytest.approx(
        10 * (1 - 0.8**5)
    )  # Euler's method: 0.01 s of 0.05 s, five times
    late = mujoco_system(
        cart, ["push"], sensors=["velocity", "tip"], observation={"input_delay": 2}
    )
    assert late.state_names == ("velocity", "tip1", "tip2", "tip3")
    state = late.dynamics.reset(0)
    speeds = []
    for _ in range(4):
        state = step(late, state, np.array([10.0]))
        speeds.append(state[0])
    assert np.abs(speeds[:2]).max() < 1e-12 < 0.01 < speeds[2] < speeds[3]


def test_misuse_of_simulators_is_one_clear_line(cart, tmp_path, monkeypatch):
    class Worded(gymnasium.Env):
        action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float64)
        observation_space = gymnasium.spaces.Dict({"a": action_space})

        def reset(self, *, seed=None, options=None):
            return {"a": np.zeros(1)}, {}

        def step(self, action):
            return {"a": action}, 0.0, False, False, {}

    class Settable(Worded):  # and no MuJoCo behind it
        observation_space = Worded.action_space

        def reset(self, *, seed=None, options=None):
            return np.zeros(1), {}

        def set_state(self, positions, velocities):
            raise NotImplementedError

    settable = gymnasium_system(Settable(), time_step=0.1)
    with pytest.raises(SettingError, match="cannot be set to a state"):
        step(settable, np.ones(1), np.zeros(1))
    named = gymnasium_system(
        Worded(), observe=lambda observation: observation["a"], time_step=0.1
    )
    assert step(named, np.zeros(1), np.array([3.0])) == 1.0
    system = pendulum_environment()
    started = system.dynamics.reset(0)
    for misuse, error, message in (
        (
            lambda: gymnasium_system(Worded(), time_step=1),
            SettingError,
            "observation space must be a Box.*observe",
        ),
        (
            lambda: gymnasium_system("CartPole-v1"),
            SettingError,
            "the action space must be a Box of one dimension",
        ),
        (
            lambda: gymnasium_system("Pendlum-v1"),
            SettingError,
            "environment: 'Pendlum-v1': ",
        ),
        (
            lambda: gymnasium_system(Worded(), observe=lambda o: o["a"]),
            SettingError,
            "time_step: is not known",
        ),
        (
            lambda: step(system, started + 0.1, np.zeros(1)),
            SettingError,
            "cannot be set to a state",
        ),
        (
            lambda: mujoco_system(cart, ["push"], joints=["slider", "hing"]),
            SettingError,
            "joints: Invalid name 'hing'. Valid names: .*'hinge'.*'slider'.* "
            "in .*cart.xml",
        ),
        (
            lambda: mujoco_system(cart, ["pull"], joints=["slider", "hinge"]),
            SettingError,
            "actuators: .*'pull'",
        ),
        (
            lambda: mujoco_system(cart, ["push"], joints=["slider"]),
            SettingError,
            "must name all 2 joints",
        ),
        (
            lambda: mujoco_system(
                cart, ["push"], ["slider", "hinge"], observation={"input_delay": 2}
            ),
            SettingError,
            "observation: is of sensors",
        ),
        (
            lambda: mujoco_system(
                cart, ["push"], sensors=["angle"], observation={"input_delay": -1}
            ),
            SettingError,
            "input_delay: must be a whole number",
        ),
        (
            lambda: mujoco_system(cart, ["push"]),
            SettingError,
            "name either the joints or the sensors",
        ),
        (
            lambda: mujoco_system(tmp_path / "no.xml", ["push"], joints=["a"]),
            DataError,
            "no.xml: is no MJCF model",
        ),
    ):
        with pytest.raises(error, match=message):
            misuse()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(
        SettingError,
        match=r"needs mujoco, which is not installed: pip install 'gpmpc\[sim\]'",
    ):
        mujoco_system(cart, ["push"], joints=["slider", "hinge"])


def test_a_falling_hopper_ends_and_a_spinning_one_is_not_set():
    """It ends by itself once it leans, and shows velocities up to 10 alone."""
    pytest.importorskip("imageio")  # which gymnasium's MuJoCo environments need
    whole = {"exclude_current_positions_from_observation": False}
    hopper = gymnasium_system("Hopper-v5", make=whole)
    inner = hopper.dynamics.environment.unwrapped
    environment = make_environment(hopper)
    environment.reset(seed=0)
    push = np.zeros(3)
    assert not environment.step(push)[2]
    leaning = environment.state.copy()
    leaning[2] = 1.0
    environment.state = leaning
    assert environment.step(push)[2]
    spinning = hopper.dynamics.reset(0)
    inner.set_state(spinning[:6], np.full(6, 20.0))
    shown = hopper.dynamics.successor(spinning, push)
    assert np.abs(shown[6:]).max() == 10.0
    with pytest.raises(SettingError, match="cannot be set to a state"):
        hopper.dynamics.successor(shown + 1e-3, push)
