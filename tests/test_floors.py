"""The promised lowest versions are those that ``make floors`` installs and tries."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOOL = runpy.run_path(str(ROOT / ".ci" / "floors.py"))


def project(*dependencies, **extras):
    return {
        "build-system": {"requires": ["hatchling>=1.27"]},
        "project": {
            "dependencies": [*dependencies],
            "optional-dependencies": extras,
        },
    }


def test_every_requirement_has_its_floor():
    requirements = project(
        "numpy>=2.2",
        "hydra-core>=1.3.8,<1.5",
        sim=["gymnasium[mujoco]>=1.0"],
        logs=["PyArrow>=17", "numpy>=2.10"],
        dev=["pyarrow>=9"],
    )
    assert TOOL["floors"](requirements) == {
        "hatchling": "1.27",
        "numpy": "2.10",  # the highest of several, by version and not by letter
        "hydra-core": "1.3.8",
        "gymnasium": "1.0",
        "pyarrow": "17",
    }


@pytest.mark.parametrize("requirement", ["numpy", "numpy<3", "numpy==2.2", "numpy>2"])
def test_a_requirement_without_a_floor_is_refused_by_its_name(requirement):
    with pytest.raises(ValueError, match=f"{requirement}: must have one floor"):
        TOOL["floors"](project(requirement))


def test_torch_is_as_pinned_unless_another_is_named():
    def printed(*arguments):
        command = [sys.executable, str(ROOT / ".ci" / "floors.py"), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()

    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    (pinned,) = (line for line in constraints if line.startswith("torch=="))
    usual = printed()
    other = printed("torch=2.8.0")
    assert pinned in usual
    assert "torch==2.8.0" in other
    assert {*usual} ^ {*other} == {pinned, "torch==2.8.0"}
    assert all(re.fullmatch(r"[a-z\d-]+==[\d.]+", line) for line in usual)
    with pytest.raises(ValueError, match="torch is not pinned"):
        TOOL["pinned_version"]("numpy==2.3.5\n", "torch")


def test_the_smoke_tests_are_there_and_the_workflow_runs_them():
    makefile = (ROOT / "Makefile").read_text()
    smoke = re.search(r"^SMOKE := ((?:.*\\\n)*.*)", makefile, re.MULTILINE)
    paths = smoke[1].replace("\\\n", " ").split()
    assert len(paths) > 10
    assert all((ROOT / path).exists() for path in paths)
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    pyproject = (ROOT / "pyproject.toml").read_text()
    (lowest,) = re.findall(r'"torch>=([\d.]+)"', pyproject)
    (python,) = re.findall(r'requires-python = ">=([\d.]+)"', pyproject)
    (job,) = re.findall(r"^  floors:(?:.*\n)+?\n", workflow, re.MULTILINE)
    assert f'python-version: "{python}"' in job
    assert f"make floors TORCH={lowest}" in job


def test_no_floor_is_one_with_which_a_command_was_seen_to_fail():
    """Seen with older ones.

    foxglove-sdk 0.23 has no ``MCAPWriter.flush``, numpy 2.1 saves a keyword as an
    array, and rich 14.0 refuses a status within a progress bar, which ``gpmpc tune``
    shows.
    """
    lowest = TOOL["floors"](
        TOOL["tomllib"].loads((ROOT / "pyproject.toml").read_text())
    )
    version = TOOL["Version"]
    assert version(lowest["foxglove-sdk"]) >= version("0.24")
    assert version(lowest["numpy"]) >= version("2.2")
    assert version(lowest["pandas"]) >= version("2.2.2")
    assert version(lowest["rich"]) >= version("14.1")
