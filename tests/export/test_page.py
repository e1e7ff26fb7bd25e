"""The page on exporting is followed: learned, exported, compiled, flown from C."""

import re
import shutil
import subprocess

import pytest

from tests.pages import BLOCK, read

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


@pytest.mark.slow  # minutes: it learns thrice and compiles some twenty times
def test_the_ten_minutes_of_the_page(page, tmp_path):
    names, printed = page("docs/export.md")
    assert "other statuses" in printed[1]
    assert "with compiled" in printed[2]
    assert "chosen |" in printed[3]
    header = (tmp_path / "small/src/gpmpc.h").read_text()
    kept = re.search(r"points: (\d+) of the 189 of the model", header)
    assert kept
    assert (
        f"{kept[1]} of 189 points are kept"
        in (tmp_path / "small/points.md").read_text()
    )
    assert names["choice"].points < 400
    program = next(
        text
        for language, text in BLOCK.findall(read("docs/export.md"))
        if "main(" in text
    )
    (tmp_path / "pendulum/fly.c").write_text(program)
    command = "cc -std=c99 -Wall -Wextra -Werror -pedantic -O1 -Ipendulum/src"
    sources = "pendulum/fly.c pendulum/src/gpmpc.c -lm -o fly"
    subprocess.run([*command.split(), *sources.split()], cwd=tmp_path, check=True)
    flown = subprocess.run(["./fly"], cwd=tmp_path, capture_output=True, text=True)
    upright = re.fullmatch(r"upright after (\d\.\d+) s\n", flown.stdout)
    assert upright
    assert float(upright[1]) < 4.0
    python, compiled = names["flights"]
    assert abs(python.states[-1] - compiled.states[-1]).max() < 1e-3
