"""The tutorial tells what happens, as a page and as a notebook."""

import json
import runpy

import numpy as np
import pytest

from tests.pages import BLOCK, ROOT, read

PAGE = "docs/tutorial.md"


def notebook():
    return runpy.run_path(str(ROOT / "docs/notebook.py"))["notebook_of"](read(PAGE))


def test_every_block_of_the_page_is_a_cell_of_the_notebook():
    cells = [
        cell["source"] for cell in notebook()["cells"] if cell["cell_type"] == "code"
    ]
    blocks = [text.strip() for _, text in BLOCK.findall(read(PAGE))]
    assert len(cells) == len(blocks)
    assert all(text in cell for text, cell in zip(blocks, cells, strict=True))
    assert cells[0].startswith("%%writefile crane.py\n")
    assert cells[-1].startswith("%%bash\ngpmpc run")
    assert sum(cell.startswith("%%") for cell in cells) == 3
    assert any("mkdir -p system" in cell for cell in cells)


def test_the_notebook_has_what_its_format_asks_for():
    content = json.loads(json.dumps(notebook()))
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    cells = content["cells"]
    assert len({cell["id"] for cell in cells}) == len(cells)
    for cell in cells:
        is_code = cell["cell_type"] == "code"
        assert is_code or cell["cell_type"] == "markdown"
        assert isinstance(cell["source"], str)
        assert ({"outputs", "execution_count"} <= cell.keys()) is is_code


@pytest.mark.slow
def test_the_story_of_the_tutorial_holds(page, tmp_path, capsys):
    names, (flown, swept, report) = page(PAGE)
    few = names["swing_ahead"](names["few"])
    many = names["swing_ahead"](names["gp"])
    assert few["rmse"] > 5 * many["rmse"]
    assert few["coverage_0.95"] < 0.5 < many["coverage_0.95"]
    gentle = names["gentle"]
    within = names["Recording"](gentle[:, :4], gentle[:-1, 4:])
    assert names["swing_ahead"](names["gp"], within)["coverage_0.95"] > 0.94
    goal = names["plant"].goal
    radii = [
        names[key].stability(goal).spectral_radius for key in ("short", "controller")
    ]
    assert radii[1] < 0.95 < radii[0]
    hits = [line for line in capsys.readouterr().out.splitlines() if "of 20" in line]
    assert [int(line.split()[0]) > 0 for line in hits] == [True, False]
    assert names["load"](names["beside"]).max() < 2.1
    assert np.abs(names["beside"].states[-1] - goal).max() < 0.05
    assert "80 steps of crane" in flown
    assert "12 runs: 12 flown" in swept
    assert "6 cells" in report
    assert (tmp_path / "sweep/report/report.html").exists()
