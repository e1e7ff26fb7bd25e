import pytest

from gpmpc.bench.documents import as_json, compared, compared_markdown, document, markdown, read_json
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


def made(rows, machine=HERE, measured=3, sittings=1):
    """Of three groups."""
    when = [{"created": f"2026-01-0{day + 1}", "machine": machine, "groups": 3 - day} for day in range(sittings)]
    return document(rows, {"steps": (measured, 3)}, when, {"seed": 0}, {"git": None})


def written(tmp_path, name, *arguments, **more):
    path = tmp_path / name
    path.write_text(as_json(made(*arguments, **more)))
    return read_json(path)


def test_a_document_is_read_as_it_was_written(tmp_path):
    found = written(tmp_path, "a.json", ROWS)
    assert found["rows"] == ROWS
    assert found["machine"] == HERE


def test_markdown_holds_every_median_and_names_the_machine():
    text = markdown(made(ROWS))
    assert "P, 2 cores, L1 48K; 1 thread; 50.0 GFlop/s" in text
    for found in ROWS:
        assert f"{found['median']:.3g} ({found['p99']:.3g})" in text


def test_markdown_says_where_a_step_goes():
    assert "| mean only, H = 10 | 2.5 | 1.25 | 0.625 | 5 |" in markdown(made(ROWS))


def test_other_parts_are_shown_with_all_their_columns():
    text = markdown(made([*ROWS, row(10, 1, 3.0, part="peers", kkt=1e-7)]))
    assert "## Peers" in text
    assert "1e-07" in text


def test_ratios_pair_the_same_cells_greatest_first(tmp_path):
    old = written(tmp_path, "old.json", ROWS)
    slower = [row(10, 1, 0.2), row(50, 10, 10.0), row(99, 1, 1.0)]
    new = written(tmp_path, "new.json", slower, HERE | {"dgemm_gflops": 25.0})
    found = compared(old, new)
    assert [(r["N"], r["H"], r["ratio"], r["per_gflop"]) for r in found] == [(10, 1, 2.0, 1.0), (50, 10, 2.0, 1.0)]
    assert "step: new / old 2.00 in the median of 2 rows" in compared_markdown(old, new)


def test_measurements_without_a_row_in_common_are_refused(tmp_path):
    old, new = written(tmp_path, "o.json", ROWS), written(tmp_path, "n.json", [row(7, 7, 1.0)])
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


def test_what_is_incomplete_says_so_wherever_it_is_read(tmp_path):
    whole, half = written(tmp_path, "a.json", ROWS), written(tmp_path, "b.json", ROWS[:2], measured=2)
    assert "incomplete" not in markdown(whole).lower()
    assert "**Incomplete, groups measured: steps 2 of 3.**" in markdown(half)
    assert "incomplete" not in compared_markdown(whole, whole)
    assert "new is incomplete, groups measured: steps 2 of 3; rows that only one" in compared_markdown(whole, half)
    assert "old is incomplete" in compared_markdown(half, whole)
    with pytest.raises(DataError, match="no row in common; new is incomplete, groups measured: steps 0 of 3"):
        compared_markdown(whole, written(tmp_path, "c.json", [], measured=0))


def test_sittings_are_told_where_there_was_more_than_one():
    assert "sittings" not in markdown(made(ROWS))
    assert "Measured in 2 sittings: 3 groups from 2026-01-01 on, 2 groups from 2026-01-02 on." in markdown(
        made(ROWS, sittings=2)
    )
