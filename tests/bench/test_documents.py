import pytest

from gpmpc.bench.documents import compared, compared_markdown, markdown, read_json, write_json
from gpmpc.exceptions import DataError
from gpmpc.plotting import png, speed

HERE = {
    "processor": "P",
    "cores": 2,
    "caches": {"L1": "48K"},
    "threads": 1,
    "load": 0.5,
    "dgemm_gflops": 50.0,
    "memory_gb_per_s": 10.0,
}


def row(N, H, median, what="mean only", part="step", **others):
    times = {"median": median, "p95": median, "p99": 2 * median, "max": 3 * median, "samples": 7}
    times |= {"model": median / 2, "build": median / 4, "solve": median / 8}
    return {"part": part, "what": what, "n": 2, "m": 1, "N": N, "H": H, "cache": "hot", **times, **others}


ROWS = [row(N, H, N * H / 100) for N in (10, 50) for H in (1, 10)]


def document(tmp_path, name, rows, machine=HERE):
    path = tmp_path / name
    path.write_text(write_json(rows, machine, {"seed": 0}, {"git": None}))
    return read_json(path)


def test_a_document_is_read_as_it_was_written(tmp_path):
    found = document(tmp_path, "a.json", ROWS)
    assert found["rows"] == ROWS
    assert found["machine"] == HERE


def test_markdown_holds_every_median_and_names_the_machine():
    text = markdown(ROWS, HERE)
    assert "P, 2 cores, L1 48K; 1 thread; 50.0 GFlop/s" in text
    for found in ROWS:
        assert f"{found['median']:.3g} ({found['p99']:.3g})" in text


def test_markdown_says_where_a_step_goes():
    assert "| mean only, H = 10 | 2.5 | 1.25 | 0.625 | 5 |" in markdown(ROWS, HERE)


def test_other_parts_are_shown_with_all_their_columns():
    text = markdown([*ROWS, row(10, 1, 3.0, part="peers", kkt=1e-7)], HERE)
    assert "## Peers" in text
    assert "1e-07" in text


def test_ratios_pair_the_same_cells_greatest_first(tmp_path):
    old = document(tmp_path, "old.json", ROWS)
    slower = [row(10, 1, 0.2), row(50, 10, 10.0), row(99, 1, 1.0)]
    new = document(tmp_path, "new.json", slower, HERE | {"dgemm_gflops": 25.0})
    found = compared(old, new)
    assert [(r["N"], r["H"], r["ratio"], r["per_gflop"]) for r in found] == [(10, 1, 2.0, 1.0), (50, 10, 2.0, 1.0)]
    assert "step: new / old 2.00 in the median of 2 rows" in compared_markdown(old, new)


def test_measurements_without_a_row_in_common_are_refused(tmp_path):
    old, new = document(tmp_path, "o.json", ROWS), document(tmp_path, "n.json", [row(7, 7, 1.0)])
    with pytest.raises(DataError, match="no row in common"):
        compared_markdown(old, new)


@pytest.mark.parametrize("content", ["", "[1]", '{"rows": []}', '{"gpmpc bench": 1}'])
def test_another_file_is_refused_by_name(content, tmp_path):
    path = tmp_path / "other.json"
    path.write_text(content)
    with pytest.raises(DataError, match=r"other.json is no JSON document of gpmpc bench"):
        read_json(path)


def test_the_figure_has_a_line_for_every_contender_in_both_rows():
    figure = speed(ROWS, size=50, horizon=10)
    above, below = figure.axes
    assert [list(line.get_xdata()) for line in above.get_lines()] == [[10, 50]]
    assert [list(line.get_ydata()) for line in below.get_lines()] == [[0.5, 5.0]]
    assert png(figure).startswith(b"\x89PNG")
