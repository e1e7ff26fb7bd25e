"""A model of a log obeys the protocol of models, and flies from the command line."""

import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.models import LogDynamics, LogModel, MultirotorNominal, RigidBodyKinematics
from gpmpc.models._grouped import GroupedNominal
from gpmpc.models._kinematics import Increments
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._log_model import OutputGP
from gpmpc.models._memory import Memory, Products
from gpmpc.models._parametric import AffineNominal
from gpmpc.models._quaternions import rotation_quaternion
from gpmpc.models._state_space import StateGroup, StateSpace
from gpmpc.models._system_nominal import SystemNominal
from gpmpc.systems import pendulum
from gpmpc.testing import check_model

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.cli.command import forked

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "guide_log.md").read_text()
VECTORS = [StateGroup(name, tuple(f"{name}{axis}" for axis in "xyz")) for name in "pvw"]
BODY = StateSpace(
    (
        VECTORS[0],
        StateGroup("q", ("qx", "qy", "qz", "qw"), "", "quaternion"),
        *VECTORS[1:],
    )
)


def dynamics(kinematics, nominal, theta, inputs, dim, sees_memory=False, **model):
    """What ``load_flyable`` would return, with a GP on the last output."""
    rng = np.random.default_rng(0)
    o = len(kinematics.output_names)
    z = torch.from_numpy(rng.normal(size=(20, dim)))
    y = torch.from_numpy(rng.normal(size=(20, 1)))
    one = torch.ones(1, dtype=torch.float64)
    lengthscales = dim**0.5 * torch.ones(1, dim, dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(
        z, y, lengthscales, one, 0.1 * one, 0, "value"
    )
    gps = (OutputGP((o - 1,), gp, sees_memory),)
    whole = LogModel(kinematics, nominal, theta, (0,) * o, gps=gps, **model)
    noise = OutputNoise(np.ones((4, o)), np.ones(kinematics.space.error_dim))
    return LogDynamics(whole, inputs, 0.02, noise)


def test_what_was_learned_obeys_the_protocol_of_models():
    rng = np.random.default_rng(1)
    nominal = MultirotorNominal(4, torque=True)
    body = dynamics(RigidBodyKinematics(BODY), nominal, rng.normal(size=18), 4, 12)
    x = np.hstack(
        [
            rng.normal(size=(5, 3)),
            rotation_quaternion(rng.normal(size=(5, 3))),
            rng.normal(size=(5, 6)),
        ]
    )
    check_model(
        body, torch.from_numpy(x), torch.from_numpy(rng.uniform(0.2, 0.8, (5, 4)))
    )
    space = StateSpace(
        (StateGroup("a", ("a",), "rad", "angle"), StateGroup("b", ("b",)))
    )
    zero = AffineNominal(Increments(space), fitted=False)
    turning = dynamics(zero.kinematics, zero, np.empty(0), 1, 4)
    states = torch.tensor(
        [[3.1415, 60.0], [-7.0, 1.0]], dtype=torch.float64
    )  # a turn is counted, not taken back
    check_model(turning, states, torch.ones(2, 1, dtype=torch.float64))
    assert abs(turning.predict(states, states[:, :1]).mean - states).max() < 0.1
    x = np.array([[0.7, 1.0]])
    turned = x + np.array([2 * np.pi * 20_000, 0.0])
    slopes = turning.linearize(turned, np.ones((1, 1))).A
    np.testing.assert_allclose(slopes, turning.linearize(x, np.ones((1, 1))).A, 1e-6)


def test_what_no_controller_can_plan_with_is_named():
    nominal = MultirotorNominal(4, feedback=True)
    with pytest.raises(SettingError, match="feedback of the controller that flew"):
        dynamics(RigidBodyKinematics(BODY), nominal, np.zeros(10), 4, 12)


@pytest.mark.parametrize(
    ("feedback_from", "refused"), [((0, 1, 2), False), ((3, 4, 5), True)]
)
def test_feedback_counts_in_the_outputs_that_a_part_gives(feedback_from, refused):
    others = tuple(sorted(set(range(6)) - set(feedback_from)))
    nominal = GroupedNominal(
        parts=(MultirotorNominal(4, feedback=True), MultirotorNominal(4)),
        outputs_of=(feedback_from, others),
        sizes=(10, 6),
    )
    kinematics = RigidBodyKinematics(BODY)
    if not refused:
        dynamics(kinematics, nominal, np.zeros(16), 4, 12)
        return
    with pytest.raises(SettingError, match="feedback of the controller that flew"):
        dynamics(kinematics, nominal, np.zeros(16), 4, 12)
    # A GP alone says what these outputs are.
    dynamics(kinematics, nominal, np.zeros(16), 4, 12, without_nominal=(3, 4))


def without_gps(nominal, space):
    kinematics = Increments(space)
    return LogDynamics(LogModel(kinematics, nominal, np.empty(0), (0, 0)), 1, 0.05)


def test_parts_that_stand_still_are_named():
    space = StateSpace((StateGroup("x", ("angle", "rate"), ""),))
    still = AffineNominal(Increments(space), fitted=False)
    parts = GroupedNominal((still, still), ((0,), (1,)), (0, 0))
    with pytest.raises(SettingError, match="whatever the inputs are"):
        without_gps(parts, space)
    known = SystemNominal(
        factory=pendulum,
        code="gpmpc.systems:pendulum",
        fitted=(),
        time_step=0.05,
        state_names=("angle", "rate"),
        input_names=("torque",),
    )
    assert without_gps(known, space).state_dim == 2

    class Own:  # with no more than the guide asks for
        parameter_names = ()
        start = np.empty(0)

        def outputs(self, theta, states, inputs, context):
            return states + inputs

    assert without_gps(Own(), space).state_dim == 2


@pytest.mark.parametrize("sees_memory", [False, True])
def test_a_model_with_a_past_has_it_in_its_state(sees_memory):
    space = StateSpace((StateGroup("x", ("x", "y"), ""),))
    kinematics = Increments(space)
    products = Products(rows=2, degree=3, low=(-9.0,) * 3, high=(9.0,) * 3)
    memory = Memory(2, (0.8,), (0.5,), products)
    rng = np.random.default_rng(2)
    regressors = memory.regressor_dim(3, 2)
    model = dynamics(
        kinematics, AffineNominal(kinematics, fitted=False), np.empty(0), 1,
        dim=regressors - 1 if sees_memory else 3, sees_memory=sees_memory,
        lag=1, time_constants=np.array([0.05]), memory=memory,
        weights=0.1 * rng.normal(size=(2, regressors)),
    )  # fmt: skip
    carried = 1 + 1 + memory.dim(3, 2)  # of the lag, on its way, remembered
    assert (model.measured_dim, model.state_dim) == (2, 2 + carried)
    states = rng.normal(size=(30, 2))
    inputs = rng.normal(size=(29, 1))
    start = model.augmented(states[:-1], inputs[:-1])
    np.testing.assert_array_equal(start[:2], states[-2])
    assert start[3] == inputs[-2]  # it acts next
    np.testing.assert_array_equal(start[4:6], states[-3])
    np.testing.assert_array_equal(start[7:9], states[-4])
    # What is on its way moves on as the measured rows say.
    z = torch.from_numpy(start)
    after = model.predict(z, torch.from_numpy(inputs[-1])).mean.numpy()
    measured_after = model.augmented(states, inputs)
    np.testing.assert_allclose(after[2:4], measured_after[2:4], atol=1e-2)
    np.testing.assert_allclose(after[4:6], start[:2])
    points = z + 0.1 * torch.from_numpy(rng.normal(size=(4, len(start))))
    check_model(model, points, torch.from_numpy(rng.normal(size=(4, 1))))
    # A flight that has just begun was at rest before.
    first = model.augmented(states[:1], inputs[:0])
    np.testing.assert_array_equal(first[4:6], states[0])


def test_the_guide_flies_learns_and_flies_what_was_learned(tmp_path):
    section = PAGE.partition("## Fly it")[2].partition("\n## ")[0]
    (mapping,) = re.findall(r"```yaml\n(.*?)```", section, re.DOTALL)
    (tmp_path / "map.yaml").write_text(mapping)
    for line in re.findall(r"```bash\n(.*?)```", section, re.DOTALL)[1].splitlines():
        words = [
            name
            for w in shlex.split(line)[1:]
            for name in ([*map(str, tmp_path.glob(w))] if "*" in w else [w])
        ]
        done = forked(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert "learned/model.safetensors" in done.stdout
    wrong = forked(
        "run", "system=cart_pole", "model=learned/model.safetensors", cwd=tmp_path
    )
    expected = (
        "learned/model.safetensors has the states angle, rate; "
        "cart_pole has position, velocity, angle, rate"
    )
    assert (wrong.returncode, wrong.stderr) == (2, f"gpmpc: model: {expected}\n")
    missing = forked("run", "system=pendulum", "model=none.safetensors", cwd=tmp_path)
    assert (missing.returncode, missing.stderr.count("\n")) == (2, 1)
    assert "none.safetensors: no such file" in missing.stderr
