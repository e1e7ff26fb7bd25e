"""What is wrong with a file is said once: the message begins with its path and names it
no second time."""

import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError
from gpmpc.gp import Transitions


def damage(path, how):
    if how == "an array is missing":
        np.savez(path, states=np.zeros((2, 1)), inputs=np.zeros((2, 1)))
    elif how == "other rows":
        np.savez(
            path,
            states=np.zeros((2, 1)),
            inputs=np.zeros((3, 1)),
            next_states=np.zeros((2, 1)),
        )
    elif how == "cut off":
        Transitions(torch.zeros(9, 2), torch.zeros(9, 1), torch.zeros(9, 2)).save(path)
        path.write_bytes(path.read_bytes()[:-40])
    elif how == "text":
        path.write_text("x,u\n1,2\n")


@pytest.mark.parametrize(
    "how", ["an array is missing", "other rows", "cut off", "text", "no file"]
)
def test_a_file_that_cannot_be_loaded_is_named_once(how, tmp_path):
    path = tmp_path / "transitions.npz"
    damage(path, how)
    with pytest.raises(DataError) as caught:
        Transitions.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).count(str(path)) == 1
