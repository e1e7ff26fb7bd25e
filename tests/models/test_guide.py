"""Every block of a guide page runs, in the order of the page."""

import re
from pathlib import Path

import matplotlib
import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("page", ["guide_models.md", "guide_estimation.md"])
def test_the_blocks_of_a_guide_run(page, tmp_path, monkeypatch):
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)  # what a block writes stays out of the repository
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)
    assert len(blocks) >= 4
    names: dict = {"__name__": page}
    for block in blocks:
        exec(compile(block, page, "exec"), names)
