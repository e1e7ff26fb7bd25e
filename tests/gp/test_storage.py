"""Models on disk: what is loaded predicts what was saved bit by bit, and no damage goes
unnoticed or untold."""

import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
import safetensors
import safetensors.numpy
import torch

from gpmpc.exceptions import DataError, SettingError, UnsupportedModel
from gpmpc.gp import (
    GPPosterior,
    Trainer,
    Transitions,
    load_metadata,
    load_posterior,
    save_posterior,
)
from gpmpc.models import ResidualModel, linearize, save_model
from gpmpc.signals import Signals
from tests.gp.model_files import parts_of, write
from tests.gp.small_models import LOAD, SAVE, as_before, posterior, residual_model


def trained():
    states = torch.linspace(-2, 2, 20)[:, None] + 0.1 * torch.randn(20, 2)
    inputs = torch.randn(20, 1)
    return Trainer(restarts=0)(
        Transitions(states, inputs, states.sin() + 0.1 * inputs)
    ).posterior


def assert_same(loaded, saved):
    x = torch.randn(50, saved.state_dim, dtype=saved.dtype)
    u = torch.randn(50, saved.input_dim, dtype=saved.dtype)
    for state, control in ((x, u), (x[0], u[0])):
        ours = loaded.predict(state, control)
        theirs = saved.predict(state, control)
        assert torch.equal(ours.mean, theirs.mean)
        assert torch.equal(ours.covariance, theirs.covariance)
    points = x.double().numpy(), u.double().numpy()
    for rows in (slice(None), slice(0, 1)):
        states, inputs = (part[rows] for part in points)
        expansions = linearize(loaded, states, inputs), linearize(saved, states, inputs)
        for ours, theirs in zip(*expansions, strict=True):
            assert np.array_equal(ours, theirs)


@pytest.mark.parametrize(
    "make",
    [
        posterior,
        trained,
        residual_model,
        lambda: posterior(predicts="difference"),
        lambda: posterior(m=0),
        lambda: posterior(size=1, n=1),
        lambda: posterior(size=150, n=6, m=3),
        lambda: posterior().to(dtype=torch.float32),
        lambda: residual_model().to(dtype=torch.float32),
    ],
    ids=[
        "next_state",
        "trained",
        "residual",
        "difference",
        "m=0",
        "one point",
        "large",
        "float32",
        "residual32",
    ],
)
def test_what_is_loaded_predicts_what_was_saved_bit_by_bit(make, tmp_path):
    model = make()
    path = tmp_path / "model.safetensors"
    SAVE[type(model)](model, path)
    loaded = LOAD[type(model)](path)
    assert loaded.dtype == model.dtype
    assert_same(loaded, model)
    SAVE[type(model)](loaded, tmp_path / "again")
    assert_same(LOAD[type(model)](tmp_path / "again"), model)


def test_a_posterior_of_a_slice_of_an_array_comes_back_the_same(tmp_path):
    table = torch.rand(40, 9)
    gp = GPPosterior.from_hyperparameters(
        table[::2, 1:4],
        table.T[5:7, ::2].T,
        torch.ones(3, 2).T,
        torch.ones(2),
        torch.full((2,), 1e-2),
        1,
    )
    save_posterior(gp, tmp_path / "gp.safetensors")
    assert_same(load_posterior(tmp_path / "gp.safetensors"), gp)


def test_a_factor_that_no_hyperparameters_give_is_kept(tmp_path):
    gp = posterior()
    gp = GPPosterior(
        **{f.name: getattr(gp, f.name) for f in fields(gp)}
        | {"cholesky": 1.5 * gp.cholesky}
    )
    save_posterior(gp, tmp_path / "gp.safetensors")
    assert torch.equal(
        load_posterior(tmp_path / "gp.safetensors").cholesky, gp.cholesky.tril()
    )


def test_the_file_is_plain_arrays_and_a_readable_header(tmp_path):
    gp = posterior(predicts="difference")
    path = tmp_path / "gp.safetensors"
    save_posterior(gp, path, {"states": ["x", "y"], "units": ["m", "m"]})
    with safetensors.safe_open(path, framework="numpy") as file:
        assert np.array_equal(file.get_tensor("features"), gp.features.numpy())
    header = load_metadata(path)
    said = {
        "format": "gpmpc model",
        "format_version": 2,
        "kind": "GPPosterior",
        "kernel": "SE-ARD",
    }
    assert (
        header.items()
        >= (said | {"predicts": "difference", "input_dim": 1, "points": 12}).items()
    )
    assert header["metadata"] == {"states": ["x", "y"], "units": ["m", "m"]}
    assert set(header["versions"]) == {"gpmpc", "torch", "gpytorch", "numpy"}
    assert header["versions"]["numpy"] == np.__version__
    assert header["created"].endswith("+00:00")
    with pytest.raises(SettingError, match="metadata: must be what JSON can hold"):
        save_posterior(gp, path, {"states": gp})


@pytest.mark.parametrize(
    "make", [posterior, residual_model], ids=["posterior", "residual"]
)
def test_a_file_of_the_first_format_is_read(make, tmp_path):
    saved = make()
    as_before(saved, tmp_path / "old.npz")
    loaded = LOAD[type(saved)](tmp_path / "old.npz")
    assert_same(loaded, saved)
    assert getattr(loaded, "residual", loaded).has_observation_noise
    assert load_metadata(tmp_path / "old.npz")["format_version"] == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_targets_are_stays_known(dtype, tmp_path):
    """Rounded, a factor of great signal says nothing of its noise."""
    gp = posterior()
    learned = torch.full((2,), 1e-6, dtype=torch.float64)
    observed = GPPosterior.from_hyperparameters(
        gp.features, gp.targets, gp.lengthscales, gp.signal_variance, learned, 1
    )
    separated = replace(observed, noise_variance=learned / 2).to(dtype=torch.float32)
    save_posterior(separated, tmp_path / "gp.safetensors")
    loaded = load_posterior(tmp_path / "gp.safetensors").to(dtype=dtype)
    assert torch.allclose(loaded.observation_noise.double(), learned)
    assert torch.allclose(loaded.noise_variance.double(), learned / 2)

    for points in (1, 12):
        kernel = (gp.lengthscales, gp.signal_variance, 4 * learned)
        of_points = GPPosterior.from_hyperparameters(
            gp.features[:points], gp.targets[:points], *kernel, input_dim=1
        )
        # as SparseTrainer makes them; a pseudo-observation may be noisier than a row
        sparse = replace(of_points, noise_variance=learned, observation_noise=None)
        save_posterior(sparse.to(dtype=torch.float32), tmp_path / "gp.safetensors")
        loaded = load_posterior(tmp_path / "gp.safetensors").to(dtype=dtype)
        with pytest.raises(UnsupportedModel, match="pseudo-observations"):
            Trainer().refit(loaded)


def test_dimensions_and_steps_of_numpy_are_kept(tmp_path):
    gp = posterior()
    signals = Signals(time_step=np.float32(0.5))
    saved = GPPosterior.from_hyperparameters(
        gp.features,
        gp.targets,
        gp.lengthscales,
        gp.signal_variance,
        gp.noise_variance,
        input_dim=np.int64(1),
        signals=signals,
    )
    save_posterior(saved, tmp_path / "gp.safetensors")
    assert_same(load_posterior(tmp_path / "gp.safetensors"), saved)
    assert load_posterior(tmp_path / "gp.safetensors").signals == signals
    rows = Transitions(gp.targets, gp.targets, gp.targets, signals)
    rows.save(tmp_path / "rows.npz")
    assert Transitions.load(tmp_path / "rows.npz").signals == signals


def test_metadata_of_any_keys_are_read_back(tmp_path):
    """Numbers as keys sort otherwise than the texts that JSON makes of them."""
    path = tmp_path / "gp.safetensors"
    saved = posterior()
    errors = {1: 0.1, 5: 0.2, 10: 0.3, "mean": 0.2}
    save_posterior(saved, path, metadata={"rmse": errors, 2: "two"})
    assert_same(load_posterior(path), saved)
    metadata = load_metadata(path)["metadata"]
    assert metadata == {"rmse": {str(k): v for k, v in errors.items()}, "2": "two"}


def test_another_process_predicts_the_same_bits(tmp_path):
    gp = posterior(size=60, n=3)
    save_posterior(gp, tmp_path / "gp.safetensors")
    code = (
        "import sys, torch; torch.set_num_threads(1); "
        "from gpmpc.gp import load_posterior;"
        "b = load_posterior(sys.argv[1]).predict("
        "torch.full((3,), 0.3).double(), torch.full((1,), 0.1).double());"
        "print([v.hex() for v in (*b.mean.tolist(), *b.variance.tolist())])"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "gp.safetensors")]
    said = subprocess.run(
        command, capture_output=True, text=True, check=True
    ).stdout.strip()
    here = gp.predict(
        torch.full((3,), 0.3).float().double(), torch.full((1,), 0.1).float().double()
    )
    assert said == str(
        [v.hex() for v in (*here.mean.tolist(), *here.variance.tolist())]
    )


@pytest.mark.parametrize(
    "make", [posterior, residual_model], ids=["posterior", "residual"]
)
def test_a_file_cut_anywhere_is_refused(make, tmp_path):
    model = make()
    path = tmp_path / "model.safetensors"
    SAVE[type(model)](model, path)
    whole = path.read_bytes()
    for size in {*range(0, len(whole), 37), *range(len(whole) - 30, len(whole))}:
        path.write_bytes(whole[:size])
        with pytest.raises(DataError, match=r"model\.safetensors: .*expected a saved"):
            LOAD[type(model)](path)


def test_a_flipped_bit_anywhere_is_refused_or_harmless(tmp_path):
    gp = posterior(size=6)
    path = tmp_path / "gp.safetensors"
    save_posterior(gp, path)
    whole = path.read_bytes()
    refused = 0
    for position in range(0, len(whole), 3):
        changed = bytearray(whole)
        changed[position] ^= 1 << position % 8
        path.write_bytes(changed)
        try:
            loaded = load_posterior(path)
        except DataError as error:
            # most positions raise, some cannot matter
            assert str(error).startswith(f"{path}: ")  # noqa: PT017
            refused += 1
        else:
            assert_same(loaded, gp)
    assert refused > 0.75 * len(whole) / 3


def test_a_flipped_bit_in_the_data_is_refused(tmp_path):
    gp = posterior()
    path = tmp_path / "gp.safetensors"
    save_posterior(gp, path)
    whole = path.read_bytes()
    for name in ("features", "targets", "lengthscales", "noise_variance", "weights"):
        content = getattr(gp, name).contiguous().numpy().tobytes()
        position = whole.index(content) + len(content) // 2
        path.write_bytes(
            whole[:position] + bytes([whole[position] ^ 1]) + whole[position + 1 :]
        )
        with pytest.raises(
            DataError,
            match=r"gp\.safetensors: damaged; "
            r"expected a saved GPPosterior \(the checksum",
        ):
            load_posterior(path)


def rewritten(path, header=None, **arrays):
    """The file with other header entries and arrays (None drops one), and a valid
    checksum."""
    said, parts = parts_of(path)
    said = said | (header or {})
    parts = {
        name: value for name, value in (parts | arrays).items() if value is not None
    }
    write(path, said, parts)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"header": {"format_version": 3}},
            "written in format 3 .*reads up to 2: update gpmpc",
        ),
        ({"header": {"format_version": "x"}}, "written in format 'x' .*reads up to 2"),
        (
            {"header": {"format": "other"}},
            "a file of something else; expected a saved GPPosterior",
        ),
        ({"header": {"kernel": "Matern"}}, "holds a Matern; expected a SE-ARD"),
        (
            {"header": {"predicts": "tomorrow"}},
            "not a consistent posterior .*got 'tomorrow'",
        ),
        ({"header": {"input_dim": 2}}, "2 controls; got 3 columns and 2 outputs"),
        ({"header": {"input_dim": None}}, "input_dim: must be a whole number"),
        ({"header": {"memory_order": {}}}, "damaged; expected a saved GPPosterior"),
        (
            {"weights": None},
            r"not a consistent posterior of features, targets.* \('weights'\)",
        ),
        (
            {"weights": np.ones((2, 3))},
            r"weights must have shape \(2, 12\); got \(2, 3\)",
        ),
        (
            {"offset": np.ones(2, dtype=np.float32)},
            "offset: must be float64 .*got torch.float32",
        ),
        ({"targets": np.full((12, 2), np.nan)}, "targets must be finite; got nan"),
        ({"noise_variance": np.array([1.0, -1.0])}, "noise_variance: must be positive"),
        (
            {"offset": np.ones(2, dtype=np.int64)},
            "offset must be of type float64 or float32; got int64",
        ),
    ],
)
def test_other_content_is_refused_with_what_was_expected(change, message, tmp_path):
    path = tmp_path / "gp.safetensors"
    save_posterior(posterior(), path)
    rewritten(path, **change)
    with pytest.raises(DataError, match=rf"gp\.safetensors: .*{message}"):
        load_posterior(path)


def test_foreign_and_missing_files_are_named(tmp_path):
    path = tmp_path / "other.npz"
    with pytest.raises(
        DataError, match=r"other\.npz: no such file; expected a saved GPPosterior"
    ):
        load_posterior(path)
    Transitions(torch.ones(1, 1), torch.ones(1, 1), torch.ones(1, 1)).save(path)
    with pytest.raises(
        DataError,
        match=r"other\.npz: a file of something else; expected a saved GPPosterior",
    ):
        load_posterior(path)
    for content in (b"", b"state,input\n1,2\n", bytes(1000)):
        path.write_bytes(content)
        with pytest.raises(
            DataError, match=r"other\.npz: damaged, or not a file of this package"
        ):
            load_posterior(path)
    save_model(residual_model(), path)
    with pytest.raises(
        DataError, match=r"holds a ResidualModel; expected a GPPosterior"
    ):
        load_posterior(path)
    with pytest.raises(DataError, match="the folder .* does not exist"):
        save_posterior(posterior(), tmp_path / "nowhere" / "gp.safetensors")


def test_what_cannot_be_saved_says_what_to_do(tmp_path):
    model = residual_model()
    model = ResidualModel(
        lambda x, u: x,
        model.residual,
        model.B,
        model.states,
        model.inputs,
        model.input_dim,
    )
    with pytest.raises(
        UnsupportedModel, match="nominal is code that a file cannot name: <function"
    ):
        save_model(model, tmp_path / "model")
    gp = posterior()
    parts = {f.name: getattr(gp, f.name) for f in fields(gp)}
    short = {
        name: value.to(torch.bfloat16)
        for name, value in parts.items()
        if isinstance(value, torch.Tensor)
    }
    with pytest.raises(
        SettingError,
        match="features: must be one of float64, float32 to be saved; "
        "got torch.bfloat16",
    ):
        save_posterior(GPPosterior(**parts | short), tmp_path / "gp.safetensors")
    with pytest.raises(
        DataError, match=r"gp\.safetensors: .*weights must be finite; got nan"
    ):
        save_posterior(
            GPPosterior(**parts | {"weights": gp.weights * torch.nan}),
            tmp_path / "gp.safetensors",
        )

    curve = np.random.default_rng(0).normal(size=60_000).tolist()
    with pytest.raises(SettingError, match="at most 1048576 characters .* got 12"):
        save_posterior(gp, tmp_path / "gp.safetensors", metadata={"loss": curve})

    class Derived(GPPosterior):
        pass

    with pytest.raises(
        UnsupportedModel, match="only a GPPosterior can be saved; got Derived"
    ):
        save_posterior(Derived(**parts), tmp_path / "gp.safetensors")
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "gp.safetensors"
    save_posterior(posterior(), path)
    before = path.read_bytes()

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="no space"):
        save_posterior(posterior(seed=1), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["gp.safetensors"]
