"""Writes a page of the documentation as a Jupyter notebook.

    python docs/notebook.py docs/tutorial.md docs/_build/tutorial.ipynb

Text stays text, Python becomes a cell, commands a cell of the shell, and a block that
names a file a cell that writes it. The page is the one source; the notebook is built.
"""

import json
import re
import sys
from pathlib import Path

_BLOCK = re.compile(r"^```([\w{}-]*)\n(.*?)^```\n?", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"(?:# @package [\w.]+\n)?# ([\w/.-]+\.(?:py|yaml|csv))\n")
_IMAGE = re.compile(r"^!\[[^\]]*\]\([^)]*\)\n?", re.MULTILINE)


def notebook_of(text: str) -> dict:
    """Returns the notebook (nbformat 4.5) of a page's text."""
    cells = []
    end = 0
    for block in _BLOCK.finditer(text):
        cells += _text_cell(text[end : block.start()])
        cells.append(_block_cell(block[1], block[2]))
        end = block.end()
    cells += _text_cell(text[end:])
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    python = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {
        "cells": cells,
        "metadata": {"kernelspec": python, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def write_notebook(page: Path, notebook: Path) -> None:
    """Writes the notebook of a page."""
    notebook.parent.mkdir(parents=True, exist_ok=True)
    notebook.write_text(json.dumps(notebook_of(page.read_text()), indent=1))


def _text_cell(text: str) -> list[dict]:
    """Returns a cell of text; none where there is none.

    Pictures are left out: the cells before them draw them.
    """
    text = _IMAGE.sub("", text).strip()
    if not text:
        return []
    return [{"cell_type": "markdown", "metadata": {}, "source": text}]


def _block_cell(language: str, text: str) -> dict:
    """Returns the cell of a block: code to run, or text as it stands."""
    source = text.rstrip("\n")
    if file := _FILE.match(text):
        source = f"%%writefile {file[1]}\n{source}"
        folder = file[1].rpartition("/")[0]
        if folder:
            source = f"%%bash\nmkdir -p {folder}\ncat > {file[1]} <<'END'\n{text}END"
    elif language in ("", "bash"):
        source = f"%%bash\n{source}"
    elif language != "python":
        quoted = f"```{language}\n{source}\n```"
        return {"cell_type": "markdown", "metadata": {}, "source": quoted}
    return {
        "cell_type": "code",
        "execution_count": None,
        "metadata": {},
        "outputs": [],
        "source": source,
    }


if __name__ == "__main__":
    write_notebook(Path(sys.argv[1]), Path(sys.argv[2]))
