"""What exported code is asked, and what it is not."""

import shutil
import subprocess

import casadi
import numpy as np
import pytest
import torch

from gpmpc.estimation import KalmanFilter, Measurement
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.export import (
    CompiledLoop,
    Estimator,
    Question,
    answers,
    export_c,
    write_replay,
)
from gpmpc.export._text import Numbers
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, KnownModel, ResidualModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    Halfspaces,
    Inequality,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.propagation import Linearization
from tests.mpc.small_models import pendulum_posterior

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
COMPILER = ("cc", "-O0", "-Wall", "-Wextra", "-Werror", "-pedantic")
HOVER = 1.5


def pushed_cart():
    """A cart of which one GP learns the acceleration alone."""
    generator = torch.Generator().manual_seed(0)
    features = 4 * torch.rand(20, 2, generator=generator) - 2
    gp = GPPosterior.from_hyperparameters(
        features,
        0.1 * torch.sin(features[:, :1]),
        lengthscales=torch.tensor([[1.0, 2.0]]),
        signal_variance=torch.tensor([0.1]),
        noise_variance=torch.tensor([1e-4]),
        input_dim=1,
        predicts="value",
    )
    nominal = Affine(
        A=torch.tensor([[1.0, 0.1], [0.0, 1.0]]),
        B=torch.tensor([[0.0], [0.1]]),
        c=torch.zeros(2),
    )
    effect = torch.tensor([[0.0], [1.0]])
    return ResidualModel(nominal, gp, effect, [1], [0], 1)


def controller_of(model, probability=None):
    side = Halfspaces([[1.0, 0.2]], [0.3], probability=probability)
    return GPMPC(
        model,
        Linearization(),
        Problem(Tracking([1.0, 0.1], [0.05]), Box([-2.0], [2.0]), constraints=[side]),
        6,
        [HOVER],
        iterations=1,
    )


@pytest.mark.parametrize("probability", [None, 0.9])
def test_controller_and_filter_have_models_of_other_outputs(probability):
    controller = controller_of(pushed_cart(), probability)
    seen = Measurement.of_states(2, [0], [0.05])
    belief = Gaussian(torch.zeros(2), torch.diag(torch.tensor([0.01, 0.25])))
    estimator = Estimator(KalmanFilter.extended(pendulum_posterior(), seen), belief)
    compiled = CompiledLoop(controller, compiler=COMPILER, estimator=estimator)
    rng = np.random.default_rng(0)
    asked = [Question(rng.normal(0, 0.2, 1), Reference(np.zeros(2))) for _ in range(12)]
    for answer in answers(controller, asked, estimator=estimator):
        got = compiled.input(answer.question.measured, answer.question.reference)
        assert np.abs(got - answer.input).max() < 1e-9


def test_what_code_does_not_take_is_refused():
    loop = CompiledLoop(controller_of(pendulum_posterior()), compiler=COMPILER)
    state = np.zeros(2)
    with pytest.raises(SettingError, match="keeps its problem's deviations"):
        loop.input(state, Reference(np.zeros(2), kappas=[2.0] * 6))
    with pytest.raises(ShapeError, match=r"a measurement must have the shape \(2,\)"):
        loop.input(np.zeros((5, 2)), state)
    with pytest.raises(ShapeError, match="reference"):
        loop.input(state, Reference(np.zeros((7, 2)), np.zeros((6, 2))))
    assert np.isfinite(loop.input(state, state)).all()


def test_an_output_that_rests_is_exported_in_float():
    """A state that stood still in all rows has GPs of weights zero."""
    states = torch.tensor([[-1.0, 0.5], [0.0, -0.5], [1.0, 0.0]], dtype=torch.float64)
    inputs = torch.tensor([[1.0], [-1.0], [0.5]], dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(
        torch.cat([states, inputs], dim=1),
        torch.cat([0.1 * states[:, 1:] + 0.1 * inputs, torch.zeros(3, 1)], dim=1),
        lengthscales=torch.full((2, 3), 2.0),
        signal_variance=torch.ones(2),
        noise_variance=torch.full((2,), 1e-4),
        input_dim=1,
        predicts="difference",
    )
    controller = controller_of(gp)
    loop = CompiledLoop(controller, "float", compiler=COMPILER)
    (answer,) = answers(controller, [Question(np.ones(2), Reference(np.zeros(2)))])
    got = loop.input(np.ones(2), np.zeros(2))
    assert abs(got - answer.input).max() < 1e-3
    assert abs(got).max() > 0.1


def test_numbers_beyond_a_float_and_undefined_ones_are_c():
    single = Numbers("float")
    assert [single.number(x) for x in (1e40, -1e40, np.nan)] == [
        "INFINITY",
        "-INFINITY",
        "NAN",
    ]
    assert Numbers("double").number(np.nan) == "NAN"


def test_a_replay_without_reference_inputs_begins_as_python(tmp_path):
    """The first state is unknown: the initial input is applied, and not zero."""
    controller = controller_of(pendulum_posterior())
    asked = [
        Question(state, Reference(np.zeros(2))) for state in ([np.nan, 0.0], [0.1, 0.2])
    ]
    export_c(controller, tmp_path)
    assert write_replay(controller, asked, tmp_path / "replay.txt") == 2
    sources = ["examples/replay/replay.c", "src/gpmpc.c"]
    command = ["cc", "-std=c99", "-Isrc", *sources, "-lm", "-o", "replay"]
    subprocess.run(command, cwd=tmp_path, check=True)

    def replayed():
        return subprocess.run(
            ["./replay"], cwd=tmp_path, capture_output=True, text=True
        )

    done = replayed()
    deviation = done.stdout.split("largest deviation ")[1].partition(",")[0]
    assert float(deviation) < 1e-9
    assert done.returncode == 0
    # what differs from Python's, and what is no replay, is told by the exit code
    written = (tmp_path / "replay.txt").read_text()
    *numbers, status = written.split()
    other = " ".join([*numbers[:-1], str(float(numbers[-1]) + 0.01), status])
    comment = written.splitlines()[0]
    for text, code in ((f"{comment}\n{other[len(comment) :]}", 1), (comment, 2)):
        (tmp_path / "replay.txt").write_text(text)
        assert replayed().returncode == code


def integrator(penalized, parameters):
    """A controller of deviations, or of increments, with a bound of parameters."""
    x = casadi.SX.sym("x", 1)
    u = casadi.SX.sym("u")
    p = casadi.SX.sym("p", parameters)
    arguments = [x, u, p] if parameters else [x, u]
    ceiling = casadi.sum1(p) if parameters else 2.0
    below = Inequality(casadi.Function("h", arguments, [x[0] - ceiling]))
    one = torch.ones(1, 1)
    return GPMPC(
        KnownModel(Affine(one, one, torch.zeros(1)), 1, 1),
        Linearization(),
        Problem(
            Tracking([1.0], [0.1], penalized=penalized),
            Box([-2.0], [2.0]),
            constraints=[below],
        ),
        4,
        [0.0],
        iterations=1,
    )


PARTIAL = {"reference inputs": ("deviations", 0), "parameters": ("increments", 2)}
FIRMWARE = """
    #include "gpmpc.h"

    static gpmpc_controller controller;
    static gpmpc_reference reference;

    int main(void)
    {
        const gpmpc_real state[GPMPC_STATES] = {0.5};
        gpmpc_real input[GPMPC_INPUTS];
        int k, i;
        gpmpc_reset(&controller);
        gpmpc_hold(&reference, state);
        if (gpmpc_step(&controller, state, &reference, input)
            != GPMPC_INVALID_MEASUREMENT)
            return 1;
        reference.has_inputs = 1;
        for (k = 0; k < GPMPC_HORIZON; k++)
            for (i = 0; i < GPMPC_PARAMETERS; i++)
                reference.parameters[k][i] = 1;
        if (gpmpc_step(&controller, state, &reference, input) != GPMPC_SOLVED)
            return 2;
        controller.input[0] = -controller.violation / 0.0; /* it is not known */
        if (gpmpc_step(&controller, state, &reference, input) != GPMPC_SOLVED)
            return 3;
        return 0;
    }
"""


@pytest.mark.parametrize("part", PARTIAL)
def test_what_a_reference_lacks_fails_a_step(part, tmp_path):
    """Where Python raises an error; an input that is not known is the initial one."""
    export_c(integrator(*PARTIAL[part]), tmp_path)
    (tmp_path / "main.c").write_text(FIRMWARE)
    sources = ["main.c", "src/gpmpc.c"]
    command = ["cc", "-std=c99", "-O0", "-Isrc", *sources, "-lm", "-o", "firmware"]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert subprocess.run(["./firmware"], cwd=tmp_path).returncode == 0


ROS = """
    #pragma once
    #include <cstdio>
    #include <functional>
    #include <map>
    #include <memory>
    #include <string>
    #include <vector>
    #define RCLCPP_WARN(logger, ...) (void)(logger), std::printf(__VA_ARGS__)
    namespace std_msgs { namespace msg {
    struct Float64MultiArray { std::vector<double> data; };
    } }
    using Message = std_msgs::msg::Float64MultiArray;
    static std::map<std::string, std::function<void(const Message &)>> topics;
    namespace rclcpp {
    template <class M> struct Publisher {
        using SharedPtr = std::shared_ptr<Publisher>;
        void publish(const M &m) { std::printf("%zu published\\n", m.data.size()); }
    };
    template <class M> struct Subscription {
        using SharedPtr = std::shared_ptr<Subscription>;
    };
    struct Node {
        explicit Node(const char *) {}
        int get_logger() { return 0; }
        template <class M>
        typename Publisher<M>::SharedPtr create_publisher(const char *, int)
        {
            return std::make_shared<Publisher<M>>();
        }
        template <class M, class F>
        typename Subscription<M>::SharedPtr
        create_subscription(const char *name, int, F read)
        {
            topics[name] = read;
            return std::make_shared<Subscription<M>>();
        }
    };
    inline void init(int, char **) {}
    inline void shutdown() {}
    template <class N> void spin(const std::shared_ptr<N> &)
    {
        for (std::string told : {"measured", "reference", "reference_input"}) {
            topics[told](Message{{0.5}});
            topics["measured"](Message{{0.5}});
        }
        std::printf("parameters\\n");
        topics["parameters"](Message{{1.0, 1.0}});
        topics["measured"](Message{{0.5}});
    }
    }
"""


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("part", PARTIAL)
def test_the_node_waits_for_what_a_step_needs(part, tmp_path):
    export_c(integrator(*PARTIAL[part]), tmp_path)
    for header in ("rclcpp/rclcpp.hpp", "std_msgs/msg/float64_multi_array.hpp"):
        file = tmp_path / "ros" / header
        file.parent.mkdir(parents=True)
        file.write_text(ROS)
    strict = ["-Wall", "-Wextra", "-Werror"]
    sources = ["-x", "c++", "ros2/node.cpp", "src/gpmpc.c"]
    command = ["c++", "-std=c++17", "-O0", "-Isrc", "-Iros", *strict, *sources]
    command += ["-lm", "-o", "node"]
    subprocess.run(command, cwd=tmp_path, check=True)
    done = subprocess.run(["./node"], cwd=tmp_path, capture_output=True, text=True)
    before, after = done.stdout.split("parameters\n")
    assert before.count("1 published") == (part == "reference inputs")
    assert after.count("1 published") == 1
