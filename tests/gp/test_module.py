"""The module is ``predict``, alone and after torch.export, in operations that other
runtimes have."""

import pytest
import torch

from gpmpc.exceptions import UnsupportedModel
from gpmpc.gp.module import PosteriorModule
from tests.gp.small_models import posterior, residual_model


@pytest.mark.parametrize("predicts", ["next_state", "difference", "value"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_module_is_predict(predicts, dtype):
    gp = posterior(n=3, m=2, predicts=predicts).to(dtype=dtype)
    state = torch.randn(4, 5, 3, dtype=dtype)
    control = torch.randn(4, 5, 2, dtype=dtype)
    mean, variance = PosteriorModule(gp)(state, control)
    at = gp.predict(state, control)
    close = {"rtol": 0, "atol": 1e-12 if dtype == torch.float64 else 1e-4}
    assert mean.dtype == dtype
    assert torch.allclose(mean, at.mean, **close)
    assert torch.allclose(variance, at.variance, **close)


def test_an_exported_program_from_a_file_predicts_any_batch(tmp_path):
    gp = posterior(m=1, predicts="difference")
    example = (torch.randn(3, 2), torch.randn(3, 1))
    batch = torch.export.Dim("batch")
    program = torch.export.export(
        PosteriorModule(gp), example, dynamic_shapes=({0: batch}, {0: batch})
    )
    torch.export.save(program, tmp_path / "gp.pt2")
    exported = torch.export.load(tmp_path / "gp.pt2").module()
    state = torch.randn(7, 2)
    control = torch.randn(7, 1)
    mean, variance = exported(state, control)
    at = gp.predict(state, control)
    assert torch.allclose(mean, at.mean, rtol=0, atol=1e-12)
    assert torch.allclose(variance, at.variance, rtol=0, atol=1e-12)
    operations = {
        str(node.target) for node in program.graph.nodes if node.op == "call_function"
    }
    assert not [name for name in operations if "linalg" in name or "triangular" in name]


def test_an_autonomous_model_takes_an_input_of_no_columns():
    gp = posterior(m=0)
    program = torch.export.export(PosteriorModule(gp), (torch.zeros(2), torch.zeros(0)))
    state = torch.randn(2)
    assert torch.allclose(
        program.module()(state, torch.zeros(0))[0], gp.predict(state).mean, atol=1e-12
    )


@pytest.mark.parametrize(
    "model", [residual_model(), "gp.npz"], ids=["residual", "name"]
)
def test_another_model_is_refused_with_the_way_out(model):
    with pytest.raises(
        UnsupportedModel, match=r"takes a GPPosterior, such as a model's .residual; got"
    ):
        PosteriorModule(model)
