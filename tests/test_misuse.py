"""Mixed-up types or shapes are refused at once, with the rule and what was got."""

import numpy as np
import pytest
import torch

from gpmpc import calibration, metrics
from gpmpc.estimation import KalmanFilter, Measurement
from gpmpc.exceptions import DataError, GpmpcError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, Trainer, Transitions, append_points, train
from gpmpc.models import Affine, DelayedModel, Lags, ResidualModel, linearize
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    LeastSquares,
    NonlinearGPMPC,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc.baselines import StateFormMPC
from gpmpc.propagation import Linearization, MomentMatching, rollout
from gpmpc.qp import DualActiveSet
from gpmpc.simulation import Gust, ModelLoop, Noise, closed_loop, closed_loops
from gpmpc.systems import System, step

F = torch.float64


def data():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(12, 2, generator=generator, dtype=F)
    u = torch.randn(12, 1, generator=generator, dtype=F)
    return Transitions(x, u, x + 0.1 * u)


def posterior(**changed):
    seen = data()
    ones = torch.ones(2, dtype=F)
    hyperparameters = {
        "features": seen.features,
        "targets": seen.next_states,
        "lengthscales": torch.ones(2, 3, dtype=F),
        "signal_variance": ones,
        "noise_variance": 1e-3 * ones,
        "input_dim": 1,
    }
    return GPPosterior.from_hyperparameters(**hyperparameters | changed)


def belief():
    return Gaussian(torch.zeros(2, dtype=F), 0.1 * torch.eye(2, dtype=F))


class Oscillator:
    state_names = ("position", "velocity")
    input_names = ("force",)

    def derivative(self, x, u):
        return [x[1], u[0] - x[0]]


class Short(Oscillator):
    def derivative(self, x, u):
        return [x[1]]


def controller(kind=GPMPC, **changed):
    settings = {
        "model": posterior(),
        "propagator": Linearization(),
        "problem": Problem(Tracking([1.0, 1.0], [1.0], penalized="inputs")),
        "horizon": 3,
        "initial_input": [0.0],
    }
    return kind(**settings | changed)


@pytest.mark.parametrize("value", [[0.1, 0.2], (0.1, 0.2), np.array([0.1, 0.2])])
def test_a_certain_belief_from_numbers_is_exactly_float64(value):
    assert torch.equal(Gaussian.certain(value).mean, torch.tensor([0.1, 0.2], dtype=F))


@pytest.mark.parametrize("value", [1.0, "ab", [[0.0, 1.0], [2.0]], None])
def test_a_certain_belief_of_no_vector_is_refused(value):
    with pytest.raises(ShapeError, match=r"\(\*batch, n\); got"):
        Gaussian.certain(value)


@pytest.mark.parametrize(
    "call",
    [
        lambda: Gaussian([0.0], [[1.0]]),
        lambda: Gaussian(np.zeros(1), np.eye(1)),
        lambda: posterior(features=data().features.tolist()),
        lambda: posterior(targets=data().next_states.numpy()),
        lambda: posterior(signal_variance=1.0),
        lambda: posterior().predict([0.0, 0.0], [0.0]),
        lambda: posterior().predict(np.zeros(2), np.zeros(1)),
        lambda: posterior().predict(torch.zeros(2, dtype=F), 0.0),
        lambda: append_points(posterior(), [[0.0] * 3], [[0.0] * 2]),
        lambda: MomentMatching()(posterior(), belief(), [0.0]),
        lambda: rollout(Linearization(), posterior(), belief(), [[0.0], [0.0]]),
        lambda: Affine([[1.0]], [[1.0]], [0.0]),
        lambda: ResidualModel.train(lambda x, u: x, data(), B=[[1.0], [0.0]]),
        lambda: metrics.mean_squared_error(np.zeros((3, 2)), np.zeros((3, 2))),
    ],
)
def test_what_is_no_tensor_is_named(call):
    with pytest.raises(
        SettingError, match="must be a torch tensor; got (list|ndarray|float)"
    ):
        call()


def test_a_mean_in_the_place_of_a_belief_is_refused():
    with pytest.raises(SettingError, match="belief: must be a Gaussian; got Tensor"):
        Linearization()(posterior(), torch.zeros(2, dtype=F), torch.zeros(1, dtype=F))


@pytest.mark.parametrize("input_dim", [1.0, True, -1])
def test_the_number_of_inputs_is_a_whole_number(input_dim):
    with pytest.raises(
        SettingError, match="input_dim: must be a whole number, 0 or more; got"
    ):
        posterior(input_dim=input_dim)


def residual():
    return ResidualModel.train(lambda x, u: x, data(), trainer=Trainer(restarts=0))


@pytest.mark.parametrize("model", [posterior, residual], ids=["posterior", "residual"])
def test_a_model_goes_only_where_torch_can_take_it(model):
    with pytest.raises(
        SettingError, match="device: must be one that torch finds here; got 'gpu'"
    ):
        model().to("gpu")
    with pytest.raises(
        SettingError,
        match=r"dtype: must be torch.float32 or torch.float64; got torch.int64",
    ):
        model().to(dtype=torch.int64)
    if not torch.cuda.is_available():
        with pytest.raises(
            SettingError, match="device: must be one that torch finds here; got 'cuda'"
        ):
            model().to("cuda")


def test_models_and_data_say_what_they_are_in_one_line():
    assert repr(posterior()) == (
        "GPPosterior(12 points, n=2, m=1, k=2, predicts='next_state', torch.float64 "
        "on cpu)"
    )
    assert repr(data()) == "Transitions(12 rows, n=2, m=1)"


@pytest.mark.parametrize(
    ("call", "rule"),
    [
        (
            lambda: train(data(), scaling="standardize"),
            "scaling: must be a function such as standardize",
        ),
        (
            lambda: train(data(), penalty="soft"),
            "penalty: must be a function such as SoftLimits",
        ),
        (
            lambda: train(data(), seed=-1),
            "seed: must be a whole number, 0 or more; got -1",
        ),
        (
            lambda: train(data(), seed=1.5),
            "seed: must be a whole number, 0 or more; got 1.5",
        ),
        (lambda: train((1, 2)), r"transitions: must be Transitions\(...\); got tuple"),
        (
            lambda: Transitions.from_csv("any.csv", "angle", []),
            "states: must be a list of column names; got .*'angle'",
        ),
        (
            lambda: Problem(
                Tracking([1.0], [1.0], penalized="inputs"), inputs=Box([np.inf])
            ),
            "lower: no number keeps it",
        ),
        (
            lambda: Problem(
                Tracking([1.0], [1.0], penalized="inputs"), constraints=[(-1, 1)]
            ),
            r"must be Box\(...\), Halfspaces\(...\) or Inequality\(...\); got tuple",
        ),
        (
            lambda: Box([0.0], 1),
            "upper: must be a list of numbers, infinite where unbounded; got 1",
        ),
        (lambda: Box([0.0, 0.0], [1.0]), "upper: must be a list of 2 numbers"),
        (
            lambda: controller(model="gp.npz"),
            "model: must be a DynamicsModel, such as GPPosterior; got str",
        ),
        (
            lambda: ModelLoop(posterior(predicts="value"), Linearization()),
            "model: must predict the next state; got GPs with predicts='value'",
        ),
        (
            lambda: ModelLoop(posterior(), Linearization),
            "propagator: .*such as Linearization.*got the class Linearization",
        ),
        (
            lambda: controller(problem={"Q": [1]}),
            r"problem: must be Problem\(...\); got dict",
        ),
        (
            lambda: controller(propagator=Linearization),
            "propagator: .*such as Linearization.*got the class Linearization",
        ),
        (
            lambda: controller(StateFormMPC, propagator=Linearization),
            "propagator: .*such as Linearization.*got the class Linearization",
        ),
        (
            lambda: controller(NonlinearGPMPC, propagator="linear"),
            "propagator: .*such as Linearization.*got 'linear'",
        ),
        (
            lambda: controller(solver=DualActiveSet),
            "solver: .*such as DualActiveSet.*got the class DualActiveSet",
        ),
        (
            lambda: metrics.violation_rate(np.zeros((3, 1)), [1], [-1]),
            "must not cross; entry 0 has 1 above -1",
        ),
    ],
)
def test_a_setting_of_another_kind_is_refused_where_it_is_given(call, rule):
    with pytest.raises(SettingError, match=rule):
        call()


@pytest.mark.parametrize("rows", [[[1.0], [2.0, 3.0]], [["a"]], None])
def test_rows_that_are_no_table_of_numbers_are_refused(rows):
    with pytest.raises(DataError, match="states must be numbers in rows and columns"):
        Transitions(rows, [[0.0]], [[0.0]])


@pytest.mark.parametrize(
    ("settings", "error", "rule"),
    [
        (
            {"nominal": lambda x, u: x[..., :1]},
            ShapeError,
            r"nominal must give .*\(12, 2\); got \(12, 1\)",
        ),
        (
            {"nominal": lambda x, u: x.numpy()},
            SettingError,
            "nominal: must be written with torch.*takes numbers out of a tensor",
        ),
        (
            {"B": torch.eye(3, dtype=F)},
            ShapeError,
            r"B must be \(2, k\), a row a state; got \(3, 3\)",
        ),
        (
            {"B": torch.ones(2, 2, dtype=F)},
            SettingError,
            "B: must have linearly independent columns",
        ),
        (
            {"states": [5]},
            SettingError,
            r"states: must be a list of different indices from 0 to 1; got \[5\]",
        ),
    ],
)
def test_a_nominal_model_that_does_not_fit_is_not_broadcast(settings, error, rule):
    with pytest.raises(error, match=rule):
        ResidualModel.train(
            **{"nominal": lambda x, u: x, "transitions": data()} | settings
        )


def test_a_residual_model_refuses_a_nominal_of_another_size():
    model = residual()
    wrong = ResidualModel(
        lambda x, u: x[..., :1], model.residual, model.B, model.states, model.inputs, 1
    )
    x = torch.zeros(2, dtype=F)
    u = torch.zeros(1, dtype=F)
    with pytest.raises(ShapeError, match="nominal must give next states"):
        wrong.predict(x, u)
    with pytest.raises(ShapeError, match="nominal must give next states"):
        linearize(wrong, x[None].numpy(), u[None].numpy())


def test_an_affine_model_checks_its_shapes():
    with pytest.raises(
        ShapeError, match=r"A, B and c must be \(n, n\), \(n, m\) and \(n,\); got"
    ):
        Affine(torch.eye(2), torch.zeros(1, 2), torch.zeros(2))


@pytest.mark.parametrize("kind", [GPMPC, NonlinearGPMPC])
def test_a_controller_says_what_it_takes(kind):
    mpc = controller(kind)
    reference = np.zeros((4, 2))
    for arguments in ((belief(), reference), (np.zeros(2), Reference(reference))):
        with pytest.raises(
            ShapeError,
            match=r"control takes a Gaussian .* and a Reference\(states\); got",
        ):
            mpc.control(*arguments)


@pytest.mark.parametrize(
    ("settings", "rule"),
    [
        (
            {"system": Oscillator()},
            "system: must be a plant, such as System.*; got Oscillator",
        ),
        ({"noise": 0.1}, r"noise: must be Noise\(...\); got 0.1"),
        (
            {"disturbances": Gust({"velocity": 1.0})},
            "disturbances: must be a list of them; got Gust",
        ),
    ],
)
def test_a_closed_loop_says_what_it_takes(settings, rule):
    scenario = {
        "system": System(Oscillator(), 0.1),
        "controller": controller(),
        "references": np.zeros((9, 2)),
        "initial": [0.0, 0.0],
        "steps": 2,
    }
    with pytest.raises(SettingError, match=rule):
        closed_loop(**scenario | settings)


def test_a_step_of_other_lengths_is_refused():
    plant = System(Oscillator(), 0.1)
    for state, input in ((np.zeros(3), np.zeros(1)), (np.zeros(2), 0.0)):
        with pytest.raises(
            ShapeError, match=r"state and input must have shapes \(2,\) and \(1,\); got"
        ):
            step(plant, state, input)
    with pytest.raises(
        ShapeError,
        match="derivative must give 2 entries, one for each of state_names; got 1",
    ):
        step(System(Short(), 0.1), np.zeros(2), np.zeros(1))


@pytest.mark.parametrize(
    "measure",
    [
        metrics.negative_log_predictive_density,
        metrics.interval_coverage,
        metrics.mean_squared_error,
    ],
)
def test_predictions_of_another_shape_are_not_broadcast(measure):
    tall = torch.ones(3, 1, dtype=F)
    wide = torch.ones(3, 2, dtype=F)
    predictions = (
        (tall, wide) if measure is metrics.mean_squared_error else (tall, tall, wide)
    )
    with pytest.raises(ShapeError, match=r"all must have one shape \(N, n\); got"):
        measure(*predictions)


def test_tracking_errors_of_axes_that_are_not_there_are_refused():
    with pytest.raises(
        ShapeError, match=r"axes must be states from 0 to 1; got \(0, 2, 4\)"
    ):
        metrics.tracking_error(np.zeros((3, 2)), np.zeros((3, 2)), (0, 2, 4))


NO_NUMBERS = {
    "complex array": np.array([1j, 0.0]),
    "complex list": [1j, 0.0],
    "complex tensor": torch.zeros(2, dtype=torch.complex128),
    "text": "ab",
    "texts": ["0.1", "0.2"],
    "dictionary": {"position": 0.1, "velocity": 0.0},
    "nothing": None,
    "nothings": [None, None],
    "truth values": [True, False],
    "dates": np.array(["2020-01-01"] * 2, "datetime64[D]"),
    "objects": [object(), 1.0],
    "rows of two lengths": [[1.0], [2.0, 3.0]],
    "tensor of a graph": torch.zeros(2, dtype=F, requires_grad=True),
    "list of tensors of a graph": [torch.zeros(2, dtype=F, requires_grad=True)] * 2,
}
PLANT = System(Oscillator(), 0.1)
STEPS = np.zeros((9, 2))


def fly(**changed):
    scenario = {
        "system": PLANT,
        "controller": controller(),
        "references": STEPS,
        "initial": [0.0, 0.0],
        "steps": 2,
    }
    return closed_loop(**scenario | changed)


def in_rows(value):
    return value[None] if hasattr(value, "shape") else [value]


def control(**changed):
    arguments = {"belief": belief(), "reference": Reference(np.zeros(2))}
    return controller().control(**arguments | changed)


TAKES_NUMBERS = {
    "Transitions, states": lambda x: Transitions(in_rows(x), [[0.0]], [[0.0, 0.0]]),
    "Transitions, next": lambda x: Transitions([[0.0, 0.0]], [[0.0]], in_rows(x)),
    "Recording": lambda x: calibration.Recording([x, x], [[0.0]]),
    "step, state": lambda x: step(PLANT, x, [0.0]),
    "step, input": lambda x: step(PLANT, [0.0, 0.0], x),
    "closed_loop, initial": lambda x: fly(initial=x),
    "closed_loop, references": lambda x: fly(references=x),
    "closed_loop, model loop": lambda x: fly(
        system=ModelLoop(posterior(), Linearization(), 0.1), initial=x
    ),
    "closed_loops, initial": lambda x: closed_loops(
        PLANT, controller(), STEPS, x, 2, seeds=2
    ),
    "ControlLoop, state": lambda x: ControlLoop(controller()).input(x, [0.0, 0.0]),
    "ControlLoop, reference": lambda x: ControlLoop(controller()).input([0.0, 0.0], x),
    "Lags": lambda x: Lags(2, 1).transitions([x, x, x], np.zeros((3, 1))),
}
# What torch may follow, or what None stands for nothing in.
TAKES_TENSORS = {
    "certain": Gaussian.certain,
    "predict, state": lambda x: posterior().predict(x, torch.zeros(1, dtype=F)),
    "Reference, set point": lambda x: control(reference=Reference(x)),
    "propagate": lambda x: Linearization()(posterior(), belief(), x),
    "update": lambda x: filter_of_states().update(belief(), x),
    "predict of a filter": lambda x: filter_of_states().predict(belief(), x),
    "augmented": lambda x: DelayedModel(posterior(), 2).augmented(belief(), x),
}
TAKES_NOTHING = {
    "Reference, inputs": lambda x: control(reference=Reference(np.zeros(2), x)),
    "parameters": lambda x: control(parameters=x),
    "plan": lambda x: control(plan=x),
    "reference of LeastSquares": lambda x: LeastSquares(lambda at: at, [1.0, 1.0], x),
    "Box": lambda x: Box(x),
    "Noise": lambda x: fly(noise=Noise(process=x)),
}


def filter_of_states():
    measurement = Measurement.of_states(2, [0, 1], [0.1, 0.1])
    return KalmanFilter.extended(posterior(), measurement)


def refuses(call, value):
    """Whether a value is refused by one line of ours."""
    try:
        call(value)
    except GpmpcError as error:
        text = str(error)
        assert "\n" not in text
        assert not any(word in text for word in ("numpy()", "float()", "Casting"))
        return True
    return False


@pytest.mark.parametrize("kind", NO_NUMBERS)
def test_what_is_no_number_is_refused_in_one_line_everywhere(kind):
    value = NO_NUMBERS[kind]
    for name, call in TAKES_NUMBERS.items():
        assert refuses(call, value), name
    for name, call in TAKES_TENSORS.items():
        assert refuses(call, value) or kind == "tensor of a graph", name
    for name, call in TAKES_NOTHING.items():
        assert refuses(call, value) or kind in ("nothing", "tensor of a graph"), name


def test_a_state_that_is_no_number_is_named():
    with pytest.raises(DataError, match="the initial state must be real numbers; got"):
        fly(initial={"position": 0.1, "velocity": 0.0})
    with pytest.raises(DataError, match=r"tensor of a graph: .* tensor.detach\(\)"):
        step(PLANT, torch.zeros(2, requires_grad=True), [0.0])
    with pytest.raises(DataError, match="got object, such as NoneType"):
        step(PLANT, [None, 1.0], [0.0])


def test_what_looks_like_transitions_is_refused_in_one_line(tmp_path):
    import pandas

    table = pandas.DataFrame({"a": [0.0, 1.0], "u": [0.0, 1.0]})
    with pytest.raises(ShapeError, match="must have two dimensions"):
        Transitions(table["a"], table[["u"]], table["a"])
    masked = np.ma.masked_array([[999.0], [1.0]], [[True], [False]])
    with pytest.raises(DataError, match="states .* masked entries"):
        Transitions(masked, [[0.0], [0.0]], [[1.0], [2.0]])
    table.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(SettingError, match="states: must name a column"):
        Transitions.from_csv(tmp_path / "log.csv", states=[], inputs=["u"])
    names = (name for name in ["a"])
    assert Transitions.from_csv(tmp_path / "log.csv", names, ["u"]).state_dim == 1
