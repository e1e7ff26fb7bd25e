"""What ``pip install`` gives works outside the checkout, settings included."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "hatchling",
        "build",
        "-t",
        "wheel",
        "-d",
        str(folder),
    ]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


def test_the_wheel_carries_settings_printed_figures_and_types(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    settings = {str(path.relative_to(ROOT)) for path in (ROOT / "conf").rglob("*.yaml")}
    assert {f"gpmpc/{name}" for name in settings} <= set(names)
    assert "gpmpc/py.typed" in names
    results = {
        path.name
        for path in (ROOT / "gpmpc" / "experiments").iterdir()
        if path.is_file()
    }
    assert {
        "paper_tables.csv",
        "paper_timings.csv",
        "tables.py",
        "figures.py",
    } <= results
    assert {f"gpmpc/experiments/{name}" for name in results} <= set(names)
    assert not [name for name in names if "__pycache__" in name]
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/"))]


def test_the_wheel_has_the_sources_of_the_checkout(wheel, tmp_path):
    """To the byte, and no others: results know the code that they are of by them."""

    def sources(folder):
        return {
            str(path.relative_to(folder)): path.read_bytes()
            for path in (folder / "gpmpc").rglob("*")
            if path.suffix in (".py", ".xml", ".csv", ".c", ".h")
            and path.relative_to(folder).parts[1] != "conf"
        }

    zipfile.ZipFile(wheel).extractall(tmp_path)
    packed = sources(tmp_path)
    assert len(packed) > 200
    assert packed == sources(ROOT)


def test_an_installed_package_finds_its_settings(wheel, tmp_path):
    site = tmp_path / "site"
    empty = tmp_path / "empty"
    empty.mkdir()
    zipfile.ZipFile(wheel).extractall(site)
    code = (
        f"import gpmpc; assert gpmpc.__file__.startswith({str(site)!r}); from "
        f"gpmpc.cli import main; main()"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, "tables", "--cfg", "draws=3"],
        cwd=empty,
        env=os.environ | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "draws: 3" in result.stdout
    assert not list(empty.iterdir())


def test_every_file_that_the_documentation_names_is_there():
    named = re.compile(
        r"\b(?:gpmpc|benchmarks|experiments|examples|conf|docs|tests)/[\w/.-]+\.(?:py|yaml|json|md|png|gif)\b"
    )
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")]
    missing = {
        f"{page.name}: {name}"
        for page in pages
        for name in named.findall(page.read_text())
    }
    missing = {
        entry for entry in missing if not (ROOT / entry.partition(": ")[2]).exists()
    }
    assert not missing
    links = {
        f"{page.name}: {link}"
        for page in pages
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text())
        if not (page.parent / link).exists()
    }
    assert not links
