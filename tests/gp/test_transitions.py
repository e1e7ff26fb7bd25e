import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gp import Transitions
from tests.gp.model_files import write_npz

ROW = " ".join(str(float(i)) for i in range(15))


@pytest.fixture
def transitions():
    return Transitions(torch.randn(7, 3), torch.randn(7, 2), torch.randn(7, 3))


def test_what_is_saved_is_loaded_to_the_bit(transitions, tmp_path):
    transitions.save(tmp_path / "data.npz")
    loaded = Transitions.load(tmp_path / "data.npz")
    for name in ("states", "inputs", "next_states"):
        assert torch.equal(getattr(loaded, name), getattr(transitions, name))
    assert (loaded == transitions, loaded == loaded) == (False, True)  # no error
    assert [path.name for path in tmp_path.iterdir()] == ["data.npz"]


def test_single_precision_is_raised_to_double():
    assert (
        Transitions(
            torch.zeros(1, 1).float(), torch.zeros(1, 0), torch.zeros(1, 1)
        ).states.dtype
        == torch.float64
    )


@pytest.mark.parametrize("form", [np.asarray, torch.as_tensor])
def test_transitions_keep_their_own_numbers(form):
    buffers = [form(np.zeros((2, 1))) for _ in range(3)]
    data = Transitions(*buffers)
    for buffer in buffers:
        buffer[:] = 7.0
    assert not data.features.any()
    assert not data.next_states.any()


def test_features_are_states_and_inputs_and_rows_are_chosen(transitions):
    assert torch.equal(transitions.features[:, 3:], transitions.inputs)
    assert torch.equal(transitions[[4, 1]].next_states, transitions.next_states[[4, 1]])
    assert torch.equal(transitions[::-2].inputs, transitions.inputs.flip(0)[::2])
    assert torch.equal(transitions[(1, 0)].states, transitions.states[[1, 0]])
    backwards = np.arange(3)[::-1]
    assert torch.equal(transitions[backwards].states, transitions.states[[2, 1, 0]])
    assert torch.equal(transitions[np.uint8([1])].states, transitions.states[1:2])
    is_late = np.arange(len(transitions)) > 1
    assert torch.equal(transitions[is_late].states, transitions.states[2:])
    assert (len(transitions[:3]), transitions.state_dim, transitions.input_dim) == (
        3,
        3,
        2,
    )


@pytest.mark.parametrize(
    "rows", [(slice(3), slice(1)), [0.5], [99], [[0, 1]], [True], None]
)
def test_what_chooses_no_rows_is_refused(transitions, rows):
    with pytest.raises(SettingError, match="rows: must be whole numbers or a slice"):
        transitions[rows]


@pytest.mark.parametrize(
    ("shapes", "error", "message"),
    [
        (
            ((4, 2), (3, 1), (4, 2)),
            ShapeError,
            r"same n and number N of rows, one or more; "
            r"got \(4, 2\), \(3, 1\) and \(4, 2\)",
        ),
        (
            ((4, 2), (4, 1), (4, 3)),
            ShapeError,
            r"need the same n .*; got \(4, 2\), \(4, 1\) and \(4, 3\)",
        ),
        (
            ((4,), (4, 1), (4, 2)),
            ShapeError,
            r"states must have two dimensions \(rows, columns\); got shape \(4,\)",
        ),
        (((0, 2), (0, 1), (0, 2)), ShapeError, r"one or more; got \(0, 2\)"),
    ],
)
def test_shapes_that_do_not_belong_together_are_refused(shapes, error, message):
    with pytest.raises(error, match=message):
        Transitions(*(torch.zeros(*shape) for shape in shapes))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_entry_that_is_not_finite_is_named(value):
    inputs = torch.zeros(5, 2)
    inputs[3, 1] = value
    with pytest.raises(
        DataError, match=f"inputs must be finite; got {value} in row 4, column 2"
    ):
        Transitions(torch.zeros(5, 2), inputs, torch.zeros(5, 2))


@pytest.mark.parametrize(
    "damage", [lambda b: b[: len(b) // 2], lambda b: b"not an archive", lambda b: b""]
)
def test_a_damaged_archive_is_named(transitions, tmp_path, damage):
    path = tmp_path / "data.npz"
    transitions.save(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DataError, match=r"data\.npz: not a readable"):
        Transitions.load(path)


def test_an_archive_of_something_else_is_named(tmp_path):
    np.savez(tmp_path / "other.npz", states=np.zeros((1, 1)))
    with pytest.raises(DataError, match="array 'inputs' is missing"):
        Transitions.load(tmp_path / "other.npz")


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"format_version": 2}, "written in format 2; this version reads up to 1"),
        ({"format_version": None}, "written in format None"),
        ({"format_version": True}, "written in format True"),
        ({"format": "gpmpc model"}, "holds gpmpc model; expected a file of trans"),
    ],
)
def test_a_newer_or_another_format_is_named(transitions, tmp_path, header, message):
    path = tmp_path / "data.npz"
    arrays = {
        name: getattr(transitions, name).numpy()
        for name in ("states", "inputs", "next_states")
    }
    usual = {"format": "gpmpc transitions", "format_version": 1}
    write_npz(path, usual | header, arrays)
    with pytest.raises(DataError, match=rf"data\.npz: {message}"):
        Transitions.load(path)


@pytest.mark.parametrize("predicts", ["differences", "Difference", None])
def test_targets_are_of_one_of_the_kinds(transitions, predicts):
    with pytest.raises(SettingError, match="predicts: "):
        transitions.targets(predicts)


def test_the_authors_text_format_is_read(tmp_path):
    (tmp_path / "data.txt").write_text(f"  {ROW}\n\n{ROW}\n")
    data = Transitions.from_text(tmp_path / "data.txt")
    assert len(data) == 2
    assert data.states[0].tolist() == [0, 1, 2, 3, 4, 5]
    assert data.inputs[0].tolist() == [6, 7, 8]
    assert data.next_states[0].tolist() == [9, 10, 11, 12, 13, 14]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            f"{ROW}\n{ROW.rsplit(' ', 1)[0]}\n",
            "data.txt: row 2 has 14 columns; expected 15",
        ),
        (
            f"{ROW}\n\n{ROW.replace('3.0', 'NaN', 1)}\n",
            "data.txt: row 3, column 4 is 'NaN'; expected a finite number",
        ),
        (
            ROW.replace("7.0", "-inf"),
            "data.txt: row 1, column 8 is '-inf'; expected a finite number",
        ),
        (
            ROW.replace("7.0", "7,0"),
            "data.txt: row 1, column 8 is '7,0'; expected a finite number",
        ),
        ("\n \n", "data.txt: the file holds 0 rows; expected 1 or more, of 15 columns"),
    ],
)
def test_what_is_wrong_with_a_text_file_is_said_with_its_place(tmp_path, text, message):
    (tmp_path / "data.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        Transitions.from_text(tmp_path / "data.txt")


def test_a_missing_file_and_a_binary_one_are_named(tmp_path):
    with pytest.raises(DataError, match=r"gone\.txt: no such file"):
        Transitions.from_text(tmp_path / "gone.txt")
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(DataError, match=r"binary\.txt: not a readable text file"):
        Transitions.from_text(tmp_path / "binary.txt")


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_csv_file_gives_its_named_columns(tmp_path, delimiter):
    lines = [
        ["t", "v", "u", "x"],
        ["0", "2", "3", "1"],
        ["1", "5", "6", "4"],
        ["2", "8", "9", "7"],
    ]
    (tmp_path / "log.csv").write_text(
        "\n".join(delimiter.join(line) for line in lines) + "\n"
    )
    data = Transitions.from_csv(tmp_path / "log.csv", states=["x", "v"], inputs=["u"])
    assert data.states.tolist() == [[1, 2], [4, 5]]
    assert data.inputs.tolist() == [[3], [6]]
    assert data.next_states.tolist() == [[4, 5], [7, 8]]  # the next row
    paired = Transitions.from_csv(
        tmp_path / "log.csv", states=["x"], inputs=[], next_states=["v"]
    )
    assert paired.next_states.tolist() == [[2], [5], [8]]
    assert paired.inputs.shape == (3, 0)


@pytest.mark.parametrize(
    "labels", [("next_x", "next_v"), ("x_t+1", "v_t+1"), ("xx", "xv")]
)
def test_next_states_are_sorted_wherever_their_names_stand(tmp_path, labels):
    """The first x of next_x is in next, and no affix of v."""
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame([[1.0, 2.0, 3.0, 4.0, 5.0]])
    table.columns = ["x", "v", "u", *labels]
    table.to_csv(tmp_path / "log.csv", index=False)
    data = Transitions.from_csv(
        tmp_path / "log.csv", states=["v", "x"], inputs=["u"], next_states=labels
    )
    assert data.next_states.tolist() == [[5.0, 4.0]]
    for states, expected in ((["x", "v"], [4.0, 5.0]), (["v", "x"], [5.0, 4.0])):
        data = Transitions(table[states], table[["u"]], table[list(labels)])
        assert data.next_states.tolist() == [expected]


def test_next_states_in_another_order_are_refused(tmp_path):
    (tmp_path / "log.csv").write_text("x,v,after_x,v_then,rate_x\n1,2,3,4,5\n")

    def read(*next_states):
        data = Transitions.from_csv(
            tmp_path / "log.csv", states=["x", "v"], inputs=[], next_states=next_states
        )
        return data.next_states.tolist()

    assert read("after_x", "v_then") == [[3, 4]]
    assert read("after_x", "rate_x") == [[3, 5]]
    with pytest.raises(DataError, match="in the order of the states, .* got v_then,"):
        read("v_then", "after_x")
    with pytest.raises(SettingError, match="different columns; got after_x, after_x"):
        read("after_x", "after_x")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,w\n1,2\n", "column 'u' is missing; the header has x, w"),
        ("x,u,u\n1,2,3\n", "column 'u' stands there twice"),
        ("x,u\n1,2\n3\n", "row 3 has 1 columns; expected 2"),
        ("x,u\n1,2\n3,nan\n", "row 3, column u is 'nan'; expected a finite number"),
        ("x,u\n1,2\n", "the file holds 1 rows; expected 2 or more"),
        ("", "column 'x' is missing; the header has no columns"),
    ],
)
def test_what_is_wrong_with_a_csv_file_is_said_with_its_place(tmp_path, text, message):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(DataError, match=f"log.csv: {message}"):
        Transitions.from_csv(tmp_path / "log.csv", states=["x"], inputs=["u"])


NUMBERS = [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    "values",
    [
        NUMBERS,
        np.array(NUMBERS),
        np.array(NUMBERS, np.uint8),
        np.array(NUMBERS, ">f4"),
        np.array(NUMBERS, np.float16),
        torch.tensor(NUMBERS),
        torch.tensor(NUMBERS).float(),
    ],
)
def test_all_kinds_of_numbers_are_taken_as_doubles(values):
    data = Transitions(values, values, values)
    for taken in (data.states, data.inputs, data.next_states):
        assert taken.dtype == torch.float64
        assert taken.tolist() == NUMBERS


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ([[True, False]] * 2, "bool"),
        ([["1", "2"]] * 2, "<U1"),
        ([[1j, 2]] * 2, "complex128"),
        ([[None, 1]] * 2, "object"),
        (np.zeros((2, 2), "datetime64[s]"), r"datetime64\[s\]"),
        (torch.ones(2, 2, dtype=torch.bool), "torch.bool"),
        (torch.ones(2, 2, dtype=torch.complex64), "torch.complex64"),
    ],
)
def test_what_only_could_be_taken_for_numbers_is_refused(values, kind):
    with pytest.raises(
        DataError, match=f"inputs must be numbers in rows and columns; got {kind}"
    ):
        Transitions(NUMBERS, values, NUMBERS)
