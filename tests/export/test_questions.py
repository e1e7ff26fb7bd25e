"""What exported code is asked, and what it is not."""

import shutil
import subprocess

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
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc import GPMPC, Box, Halfspaces, Problem, Reference, Tracking
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
