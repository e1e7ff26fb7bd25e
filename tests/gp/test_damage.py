"""Damaged files are refused by name or read as they were, in little memory and time;
see ``damage``."""

import subprocess
import sys
import zipfile

import numpy as np
import pytest
import safetensors
import safetensors.numpy
import torch

from gpmpc.exceptions import DataError, SettingError
from gpmpc.gp import Transitions, load_posterior, save_posterior
from gpmpc.models import load_model
from tests.gp.small_models import posterior


def assert_survived(count, seed):
    command = [
        sys.executable,
        "-m",
        "tests.gp.damage",
        "model,old,residual,transitions,csv",
        str(count),
        str(seed),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("slowest") == 5


def test_eighty_damaged_files_are_refused_or_read_unchanged():
    assert_survived(80, seed=1)


@pytest.mark.slow
def test_3000_damaged_files_are_refused_or_read_unchanged():
    assert_survived(3000, seed=2)


def arrays(**changed):
    good = {
        name: np.arange(6.0).reshape(3, 2)
        for name in ("states", "inputs", "next_states")
    }
    return good | changed


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    "column",
    [
        np.full((3, 2), 1 + 2j),
        np.ones((3, 2), dtype=bool),
        np.full((3, 2), "1.5"),
        np.full((3, 2), b"1.5"),
        np.full((3, 2), "2026-11-22", dtype="datetime64[D]"),
        np.full((3, 2), 7, dtype="timedelta64[s]"),
        np.ones(3, dtype=[("x", "f8"), ("y", "f8")]),
    ],
    ids=lambda column: str(column.dtype),
)
def test_what_only_looks_like_numbers_is_refused(column, compressed, tmp_path):
    path = tmp_path / "data.npz"
    (np.savez_compressed if compressed else np.savez)(path, **arrays(inputs=column))
    with pytest.raises(
        DataError,
        match=r"data\.npz: (inputs must be numbers|not a readable .npz file of "
        r"transitions)",
    ):
        Transitions.load(path)
    with pytest.raises(
        DataError, match="inputs must be numbers in rows and columns; got"
    ):
        Transitions(**arrays(inputs=column))


@pytest.mark.parametrize(
    "column",
    [torch.ones(3, 2, dtype=torch.bool), torch.ones(3, 2, dtype=torch.complex128)],
)
def test_tensors_of_no_real_numbers_are_refused(column):
    with pytest.raises(
        DataError, match="inputs must be numbers in rows and columns; got torch"
    ):
        Transitions(**arrays(inputs=column))


@pytest.mark.parametrize("kind", ["f2", "f4", ">f8", "i1", "u4", "i8"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_of_others_and_of_any_real_type_are_read(kind, save, tmp_path):
    save(
        tmp_path / "data.npz",
        **arrays(inputs=np.array([[1], [2], [3]], dtype=kind)),
        more=np.array(["x"]),
    )
    data = Transitions.load(tmp_path / "data.npz")
    assert data.inputs.tolist() == [[1], [2], [3]]
    assert data.inputs.dtype == torch.float64


def test_a_file_that_declares_more_than_it_can_hold_is_refused(tmp_path):
    path = tmp_path / "data.npz"
    np.savez_compressed(path, **arrays(states=np.zeros((400_000, 2))))
    with pytest.raises(
        DataError, match=r"declares \d+ bytes, more than a file of \d+ bytes can hold"
    ):
        Transitions.load(path)


def test_an_array_that_declares_more_than_it_holds_is_refused(tmp_path):
    path = tmp_path / "data.npz"
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 2), }"
    with zipfile.ZipFile(path, "w") as archive:
        for name in arrays():
            archive.writestr(
                f"{name}.npy",
                b"\x93NUMPY\x01\x00"
                + len(header).to_bytes(2, "little")
                + header.encode(),
            )
    with pytest.raises(
        DataError,
        match=r"data\.npz: not a readable .npz file of transitions \(states.npy is an "
        r"array of shape",
    ):
        Transitions.load(path)


@pytest.mark.parametrize(
    ("one", "other"), [("signal_variance", "noise_variance"), ("features", "targets")]
)
def test_parts_that_changed_places_are_noticed(one, other, tmp_path):
    path = tmp_path / "gp.safetensors"
    save_posterior(posterior(m=0), path)
    with safetensors.safe_open(path, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = file.metadata()
    safetensors.numpy.save_file(
        arrays | {one: arrays[other], other: arrays[one]}, path, metadata
    )
    with pytest.raises(
        DataError,
        match="damaged; expected a saved GPPosterior .the checksum of its parts",
    ):
        load_posterior(path)


@pytest.mark.parametrize(
    "load",
    [
        Transitions.load,
        Transitions.from_text,
        lambda p: Transitions.from_csv(p, ["x"], ["u"]),
        load_posterior,
        load_model,
        lambda p: save_posterior(posterior(), p),
    ],
)
def test_a_path_is_one_name(load):
    for path in (["a.csv", "b.csv"], None, 3):
        with pytest.raises(
            SettingError, match="path: must be the name of one file; got"
        ):
            load(path)


@pytest.mark.parametrize(
    "load", [Transitions.load, Transitions.from_text, load_posterior, load_model]
)
def test_a_name_that_no_file_can_have_is_named(load):
    for path in ("x" * 5000, "zero\0"):
        with pytest.raises(DataError, match="expected a"):
            load(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,u\n1_0,2\n3,4\n", "row 2, column x is '1_0'; expected a finite number"),
        ("x,u\n1,inf\n3,4\n", "row 2, column u is 'inf'"),
        ('x,u\n1,"2\n3,4\n', "row 3, column u is "),
        ('"' + "x" * 200_000 + "\n", r"row \d cannot be read"),
    ],
)
def test_what_only_python_reads_as_a_number_is_refused(text, message, tmp_path):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(DataError, match=f"log.csv: {message}"):
        Transitions.from_csv(tmp_path / "log.csv", ["x"], ["u"])
