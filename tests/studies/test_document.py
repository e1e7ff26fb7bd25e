"""One small document in every format: nothing is lost, doubled or out of its place."""

import io
import json
import math

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from gpmpc.plotting._style import figure_label
from gpmpc.studies._document import (
    Document,
    Table,
    json_text,
    number,
    plain_text,
    terminal,
    with_range,
)

RUNS = Table(
    ["kind", "n, all", "RMSE [m]"],
    [["a", "3\n1 failed", 0.1234567], ["a", "[2]", "—"], ["b", "*1", 1.5e-7]],
    "Runs & more",
    sections=True,
)
PLAIN = Table(["x"], [[1.0]])
DOCUMENT = Document(
    "A <title>",
    [RUNS, PLAIN],
    pd.DataFrame({"=name": ["@x", "-2.5e-3", "-a"], "n": [1.5, 2, 3]}),
    lead="It *is* so.",
    notes=["first", "a|b"],
    lists={"Failed": ["one_two _x_", "[a](b)"], "Nothing": []},
    code={
        "Nothing else": (),
        "To fill": ["l < 1"],
        "Eleven": ["x"] * 11,
        "Ten": ["x"] * 10,
    },
    images={"a.png": b"\x89PNG"},
    links={"run/<1>": "../a b"},
)

MARKDOWN = r"""# A &lt;title&gt;

It \*is\* so.

## Runs &amp; more

| kind | n, all | RMSE [m] |
| --- | --- | --- |
| a | 3, 1 failed | 0.123 |
| a | [2] | — |
| b | \*1 | 1.50e-7 |

| x |
| --- |
| 1 |

first

a\|b

![a.png](a.png)

## Failed

- one_two \_x\_
- [a]\(b)

## To fill

```
l < 1
```

## Eleven

```
11 times x
```

## Ten

```
10 times x
```
"""

LATEX = r"""% needs \usepackage{booktabs}
\begin{tabular}{rrr}
\toprule
kind & n & RMSE \\
 & \footnotesize all & \footnotesize [m] \\
\midrule
a & 3 & 0.123 \\
 & \footnotesize 1 failed &  \\
 & [2] & -- \\
\midrule
b & *1 & $1.50 \cdot 10^{-7}$ \\
\bottomrule
\end{tabular}
% Runs \& more

\begin{tabular}{r}
\toprule
x \\
\midrule
1 \\
\bottomrule
\end{tabular}
"""

PAGE = """</style></head><body>
<h1>A &lt;title&gt;</h1>
<p>It *is* so.</p>
<div class="figures"><img alt="a" src="data:image/png;base64,iVBORw=="></div>
<h2>Runs &amp; more</h2>
<div class="wide"><table><thead><tr>\
<th>kind</th><th>n, all</th><th>RMSE [m]</th></tr></thead><tbody>
<tr><td>a</td><td>3<small>1 failed</small></td><td>0.123</td></tr>
<tr><td>a</td><td>[2]</td><td>—</td></tr>
<tr><td>b</td><td>*1</td><td>1.50e-7</td></tr>
</tbody></table></div>
<div class="wide"><table><thead><tr><th>x</th></tr></thead><tbody>
<tr><td>1</td></tr>
</tbody></table></div>
<p>first</p>
<p>a|b</p>
<h2>Failed</h2><ul><li>one_two _x_</li><li>[a](b)</li></ul>
<h2>To fill</h2><pre>l &lt; 1</pre>
<h2>Eleven</h2><details><summary>11 lines</summary><pre>11 times x</pre></details>
<h2>Ten</h2><pre>10 times x</pre>
<h2>Runs</h2><details><summary>1 folders</summary><ul>\
<li><a href="../a%20b/">run/&lt;1&gt;</a></li></ul></details>
</body></html>
"""

TERMINAL = """
Runs & more

 n, all    RMSE [m]
 ───────────────────
                  a
 3            0.123
 1 failed
 [2]              —

                  b
 *1         1.50e-7


 x
 ──
 1


 a  1


 n
 ──


note
"""


def written_out(text):
    for count in (11, 10):
        text = text.replace(f"{count} times x", "\n".join(["x"] * count))
    return text


def test_markdown_holds_every_part_in_its_order():
    assert DOCUMENT.markdown() == written_out(MARKDOWN)


def test_latex_holds_the_tables_with_a_rule_before_each_section():
    assert DOCUMENT.tex() == LATEX


def test_a_page_folds_what_is_long_and_links_the_runs():
    head, mark, page = DOCUMENT.html().partition("</style>")
    assert mark + page == written_out(PAGE)
    assert "<title>A &lt;title&gt;</title>" in head
    assert head.startswith("<!doctype html>\n<html lang=en><head>")


def test_a_terminal_shows_sections_details_and_notes():
    tables = [RUNS, PLAIN, Table(["", ""], [["a", "1"]]), Table(["n"], [])]
    console = Console(file=io.StringIO(), width=60)
    console.print(terminal(tables, "note"))
    assert (
        "\n".join(line.rstrip() for line in console.file.getvalue().splitlines()) + "\n"
        == TERMINAL
    )


def test_a_terminal_aligns_names_left_and_numbers_right():
    console = Console(width=80)
    with console.capture() as capture:
        console.print(
            terminal(
                [Table(["system", "error"], [["cart", 0.25], ["quadrotor", 12.5]])]
            )
        )
    cart, quadrotor = (
        line.rstrip()
        for line in capture.get().splitlines()
        if "cart" in line or "quad" in line
    )
    assert cart.index("cart") == quadrotor.index("quadrotor")
    assert len(cart) == len(quadrotor)


def test_a_spreadsheet_reads_numbers_and_no_formulas():
    assert DOCUMENT.csv() == "'=name,n\n'@x,1.5\n-2.5e-3,2.0\n'-a,3.0\n"


def test_the_files_are_named_after_the_document():
    files = DOCUMENT.files("report")
    assert list(files) == ["report.md", "report.csv", "report.tex", "a.png"]
    assert files["report.md"] == DOCUMENT.markdown()
    assert files["report.csv"] == DOCUMENT.csv()
    assert files["report.tex"] == DOCUMENT.tex()
    assert files["a.png"] == b"\x89PNG"


def test_a_document_of_a_title_and_a_table_is_no_more_than_that():
    bare = Document("t", [PLAIN], pd.DataFrame())
    assert bare.markdown() == "# t\n\n| x |\n| --- |\n| 1 |\n"
    assert "<h2>" not in bare.html()
    shorter = Document(
        "t", [RUNS], pd.DataFrame(), latex=[Table(["x, y [m]"], [["[1]"], [2.0]])]
    )
    assert r"x \\" in shorter.tex()
    assert "{}[1] \\\\\n2 \\\\" in shorter.tex()
    assert "RMSE" not in shorter.tex()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1e-3, "0.001"),
        (9.994e-4, "9.99e-4"),
        (-1.23456e-3, "-0.00123"),
        (1.005e-10, "1.01e-10"),
        (12.0, "12"),
        (999.4, "999"),
        (999.6, "1.00e3"),
        (1234.0, "1.23e3"),
        (1.234e-7, "1.23e-7"),
        (0.01234, "0.0123"),
        (1.4567, "1.46"),
        (12345.0, "1.23e4"),
        (-1e4, "-1.00e4"),
        (1e100, "1.00e100"),
        (float("inf"), "inf"),
        (float("nan"), "nan"),
    ],
)
def test_a_number_has_three_digits_and_a_power_that_latex_sets(value, text):
    assert number(value) == text
    if "e" in text:
        mantissa, power = text.split("e")
        tex = Document("", [Table(["x"], [[value]])], pd.DataFrame()).tex()
        assert f"${mantissa} \\cdot 10^{{{power}}}$" in tex


def test_a_range_is_shown_where_there_is_one():
    assert with_range(1.0, 2.0, 3.0) == "2\n[1, 3]"
    assert with_range(2.0, 2.0, 2.0) == "2"


def test_json_knows_finite_numbers_alone():
    text = json_text(
        {"mean": math.nan, "costs": [1.5, -math.inf, (np.float64("inf"),)]}
    )
    content = json.loads(text, parse_constant=pytest.fail)
    assert content == {"mean": None, "costs": [1.5, None, [None]]}


def test_labels_are_no_formulas():
    assert figure_label("$a$") == r"\$a\$"


def test_text_is_one_line_and_data_are_json():
    assert plain_text("a\nb\x1b ä") == r"a\nb\x1b ä"
    with pytest.raises(TypeError, match="must be a text; got 3"):
        plain_text(3)
    assert json_text({"a": [1]}) == '{\n "a": [\n  1\n ]\n}\n'
