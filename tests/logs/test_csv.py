"""CSV files are read whoever wrote them, or refused by what is wrong with them."""

import gzip

import numpy as np
import pandas
import pytest

from gpmpc.exceptions import DataError
from gpmpc.logs import LogMapping, read_log
from tests.logs.tables import read_file

MAPPING = {"time": "t", "states": {"x": ["x"]}, "inputs": {"u": ["u"]}}
TABLE = pandas.DataFrame(
    {
        "t": 0.01 * np.arange(300),
        "x": np.sin(0.07 * np.arange(300)),
        "u": np.cos(0.05 * np.arange(300)),
    }
)
TEXT = TABLE.to_csv(index=False)


def parse(folder, content):
    content = content.encode() if isinstance(content, str) else content
    (folder / "log.csv").write_bytes(content)
    file = read_file(folder / "log.csv")
    assert not file.findings
    return file.tables[""]


@pytest.mark.parametrize(
    "content",
    [
        TEXT,
        TEXT.replace("\n", "\r\n"),
        "\n\n" + TEXT,
        TABLE.to_csv(index=False, sep=";"),
        TABLE.to_csv(index=False, sep="\t"),
        TABLE.to_csv(index=False, sep=";", decimal=","),
        TABLE.to_csv(index=False, sep="\t", decimal=","),
        TABLE.to_csv(index=False, decimal=",", quoting=2),
        TEXT.encode("utf-8-sig"),
        TEXT.encode("utf-16"),
        b"\xfe\xff" + TEXT.encode("utf-16-be"),
        TEXT.encode("utf-16-le"),
        TEXT.encode("utf-16-be"),
        TEXT.encode("utf-32"),
        "# flown on a Tuesday\n% by hand\n// again\n" + TEXT,
        "# " + TEXT,
        "# flown on a Tuesday\n# " + TEXT,
        TEXT.replace("\n0.5,", "\n# a remark\n0.5,"),
        TEXT.replace(",", ", "),
        TEXT.replace(",", " "),
        TEXT.replace(",", "   "),
        TEXT.replace(",", ",").replace("\n", ",\n"),
        TEXT.replace("\n", ",\n").replace("t,x,u,", "t,x,u"),
        TABLE.to_csv(index=False, sep=" ", decimal=","),
        TABLE.to_string(index=False, float_format="{:.17g}".format) + "\n",
        "% t x u\n" + TEXT.partition("\n")[2].replace(",", " "),
    ],
)
def test_every_way_of_writing_numbers_is_read(tmp_path, content):
    table = parse(tmp_path, content)
    np.testing.assert_allclose(table[["t", "x", "u"]], TABLE, rtol=1e-15)


WHOLE_AT_FIRST = TABLE.assign(
    t=10 * np.arange(300), x=TABLE["x"].where(TABLE.index > 60, 0), u=1.0
)


@pytest.mark.parametrize(
    "table",
    [
        WHOLE_AT_FIRST.map("{:.6g}".format).map(lambda text: text.replace(".", ",")),
        TABLE.map("{:.6g}".format).assign(
            x=[f"{x:.6g}".replace(".", ",") for x in TABLE["x"]]
        ),
        (1 + TABLE.abs()).map("{:.3f}".format).map(lambda text: text.replace(".", ",")),
        TABLE.map("{:.6g}".format).assign(u=["0", "1e-3", *["11.120"] * 298]),
    ],
)
def test_decimal_commas_are_read_wherever_they_begin(tmp_path, table):
    (tmp_path / "log.csv").write_text(table.to_csv(index=False, sep=";"))
    numbers = table.map(lambda text: float(text.replace(",", ".")))
    file = read_file(tmp_path / "log.csv")
    np.testing.assert_array_equal(file.tables[""], numbers)
    is_unsure = table["x"].str.contains("^[1-9],...$").all()
    assert [finding.kind for finding in file.findings] == ["decimal mark"] * int(
        is_unsure
    )


@pytest.mark.parametrize(
    ("rows", "mark"),
    [
        ('0.00,"950"\n0.01,"1,024"\n', "comma"),
        ('0,"950"\n10,"1,024"\n', "comma"),
        ("0.00\t950\n0.01\t1,024\n", "comma"),
        ("0;950\n" * 60 + "10;1,024\n", "comma"),
        ("0;1,024\n" * 60 + "10;950\n", "comma"),
        ("0,00;950\n0,01;1.024\n", "point"),
        ("0;950\n10;1.024\n", "point"),
    ],
)
def test_marks_of_thousands_are_refused_where_they_are_read(tmp_path, rows, mark):
    delimiter = next(sign for sign in ";\t," if sign in rows)
    (tmp_path / "log.csv").write_text(f"t{delimiter}rpm\n{rows}")
    reason = f"column 'rpm' .*950.* a decimal {mark}.*thou"
    for runs in ({}, {"a": {"x": "rpm"}}):
        columns = ["x"] if runs else ["rpm"]
        mapping = {"time": "t", "states": {"x": columns}, "inputs": {"u": ["t"]}}
        with pytest.raises(DataError, match=reason):
            read_log(tmp_path / "log.csv", {**mapping, "runs": runs})
    (finding,) = read_file(tmp_path / "log.csv").findings
    assert finding.kind == "thousands"


@pytest.mark.parametrize(
    ("header", "unit", "said"),
    [
        ("t,x,u\n[s],[mm],[V]\n", "", "x in mm (taken as no unit)"),
        ("t,x,u\ns,mm,N\n", "m", "x in mm (taken as m)"),
        ("t,x [km/h],u\n", "m/s", "x [km/h] in km/h (taken as m/s)"),
        ("t,x [km/h],u\n", "km/h", ""),
        ("t,x (left),u [A]\n", "m", ""),
        ("t,x[1],u (1)\n", "cm", ""),
        ("t,x [\N{MICRO SIGN}m],u\n", "", ""),
        ("t,x [\N{DEGREE SIGN}/s],u\n", "rad/s", "{x} in {unit} (taken as rad/s)"),
    ],
)
def test_units_of_the_file_that_the_mapping_lacks_are_found(
    tmp_path, header, unit, said
):
    (tmp_path / "log.csv").write_text(header + TEXT.partition("\n")[2])
    x, u = header.split("\n")[0].split(",")[1:]
    states = {"x": {"columns": [x], "unit": unit}}
    log = read_log(
        tmp_path / "log.csv", {"time": "t", "states": states, "inputs": {"u": [u]}}
    )
    texts = [finding.text for finding in log.findings]
    unit_in_file = x.partition("[")[2].rstrip("]")
    said = said.format(x=x, unit=unit_in_file)
    whole = f"the file says other units than the mapping: {said}"
    assert texts == ([whole] if said else [])


@pytest.mark.parametrize("missing", [1, 5, 12, 20, 30])
def test_a_last_line_without_an_end_is_left_out_and_said(tmp_path, missing):
    cut = TEXT[:-missing]
    assert not cut.endswith("\n")
    for name, content in {
        "log.csv": cut.encode(),
        "log.csv.gz": gzip.compress(cut.encode()),
    }.items():
        (tmp_path / name).write_bytes(content)
        log = read_log(tmp_path / name, MAPPING)
        assert len(log) == 299
        np.testing.assert_array_equal(log.runs[0].states[:, 0], TABLE["x"][:299])
        (finding,) = log.findings
        assert finding.kind == "cut line"
        assert "the last line has no end" in finding.text


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (TABLE.to_csv(index=False, decimal=",", sep=";").replace(";", ","), "comma"),
        ("t;x;u [°]\n0;1;2\n".encode("latin-1"), "byte 0xb0 near line 1 is no text in"),
        (b"", "no line with the names"),
        (b"\n\n# nothing\n", "no line with the names"),
        ("t,x,x\n0,1,2\n", r"column 'x' stands there 2 times: .* 'x \(column 3\)'"),
        ("0,1,2\n0,1,2\n", "column 't' is missing; it has 1, 2, 3"),
        ("t,x,u\n1,5.5,2,OK\n2,5.5,2,OK\n", "column 't' is missing; it has 1, 2, 3, 4"),
        ("x\n1,5\n2,5\n", "is the comma the decimal mark too"),
        ("t x u\n0 1 2\n1 2\n", "row 2 has 2 fields, others 3"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(tmp_path, content, reason):
    content = content.encode() if isinstance(content, str) else content
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(DataError, match=rf"log.csv: .*{reason}"):
        read_log(tmp_path / "log.csv", MAPPING)


@pytest.mark.parametrize(
    ("text", "kind", "count"),
    [
        (TEXT.replace("\n0.5,", "\n\n\n0.5,"), "blank lines", 2),
        (TEXT.replace("\n0.0,", "\n\n0.0,", 1) + "\n", "", 0),
        (
            TEXT.replace("t,x,u", "note,t,x,u")
            .replace("\n", "\n,")[:-1]
            .replace("\n,0.5,", '\n"off,0.5,')
            .replace("\n,1.0,", '\non again",1.0,'),
            "lines in quotes",
            50,
        ),
    ],
)
def test_lines_that_are_no_rows_are_counted(tmp_path, text, kind, count):
    (tmp_path / "log.csv").write_text(text)
    findings = read_log(tmp_path / "log.csv", MAPPING).findings
    found = [(f.kind, f.count) for f in findings if f.kind != "gap"]
    assert found == ([(kind, count)] if kind else [])


@pytest.mark.parametrize("time", [{"time": {"step": 0.01}}, {"rate": 100}])
@pytest.mark.parametrize("every", [100, 1])
def test_counted_rows_behind_blank_lines_are_pieces(tmp_path, time, every):
    lines = TABLE[["x", "u"]].to_csv(index=False, header=False).splitlines(True)
    blocks = ["".join(lines[k : k + every]) for k in range(0, len(lines), every)]
    (tmp_path / "log.csv").write_text("x,u\n" + "\n".join(blocks))
    signals = {key: MAPPING[key] for key in ("states", "inputs")}
    log = read_log(tmp_path / "log.csv", {**signals, **time})
    assert log.runs[0].begins == ((0, 100, 200) if every > 1 else (0,))
    assert len(log) == 300
    (finding,) = [f for f in log.findings if f.kind == "blank lines"]
    assert ("are pieces of their own" in finding.text) == (every > 1)


def test_a_column_may_be_called_by_a_hexadecimal_number(tmp_path):
    text = "time: t\nstates: {x: [0x1A]}\ninputs: {u: [010, 0b1, 10]}\nrate: 10"
    empty = "\ncontext: []\nnames: {}\nruns: []\nkeep: ''\nnominal: {}"
    (tmp_path / "map.yaml").write_text(text + empty)
    mapping = LogMapping.load(tmp_path / "map.yaml")
    assert mapping.signal_columns == ("0x1A", "010", "0b1", "10")
    assert mapping.rate == 10


@pytest.mark.parametrize("settings", [1, 60, 400])
@pytest.mark.parametrize("dates", [False, True])
def test_any_number_of_settings_may_stand_before_the_rows(tmp_path, settings, dates):
    table = TABLE.assign(t=pandas.to_datetime(TABLE["t"], unit="s")) if dates else TABLE
    lines = [f'"setting {k}","{k}"\n' for k in range(settings)]
    (tmp_path / "log.csv").write_text("".join(lines) + table.to_csv(index=False))
    file = read_file(tmp_path / "log.csv")
    np.testing.assert_array_equal(file.tables[""][["x", "u"]], TABLE[["x", "u"]])
    (finding,) = file.findings
    assert (finding.kind, finding.count) == ("lines before the rows", settings)


def test_rows_that_begin_with_a_text_may_be_short(tmp_path):
    text = "a,1\na,2\n" + "".join(f"a,{k},{k % 7}\n" for k in range(60))
    (tmp_path / "log.csv").write_text(text)
    assert len(read_file(tmp_path / "log.csv").tables[""]) == 62


@pytest.mark.parametrize("delimiter", [" ", ",", "\t"])
def test_rows_that_r_numbers_have_their_columns(tmp_path, delimiter):
    numbers = [str(number) for number in TABLE.index + 1]
    text = TABLE.set_axis(numbers).to_csv(sep=delimiter, quoting=2)
    (tmp_path / "log.csv").write_text(text.removeprefix(f'""{delimiter}'))
    file = read_file(tmp_path / "log.csv")
    np.testing.assert_array_equal(file.tables[""][["t", "x", "u"]], TABLE)
    assert not file.findings


def test_counted_columns_are_no_row(tmp_path):
    (tmp_path / "log.csv").write_text("0,1,2\n" + TEXT.partition("\n")[2])
    mapping = {"time": 1, "states": {"x": [2]}, "inputs": {"u": [3]}}
    log = read_log(tmp_path / "log.csv", mapping)
    np.testing.assert_array_equal(log.runs[0].states[:, 0], TABLE["x"])


def test_units_in_capitals_are_no_names(tmp_path):
    rows = TEXT.partition("\n")[2].replace(",", " ")
    header = "values of a flight\n\nT THE PHI\nS RAD RAD\n"
    (tmp_path / "log.asc").write_text(header + rows)
    mapping = {"time": "T", "states": {"pitch": ["THE"]}, "inputs": {"roll": ["PHI"]}}
    log = read_log(tmp_path / "log.asc", mapping)
    np.testing.assert_array_equal(log.runs[0].states[:, 0], TABLE["x"])
    titled = "Data of run\nt x u u\n"
    (tmp_path / "titled.txt").write_text(titled + rows.replace("\n", " 0\n"))
    mapping = {"time": "t", "states": {"x": ["x"]}, "inputs": {"u": [3]}}
    log = read_log(tmp_path / "titled.txt", mapping)
    np.testing.assert_array_equal(log.runs[0].states[:, 0], TABLE["x"])


def test_a_run_that_comes_twice_is_found(tmp_path):
    for name in ("flight.csv", "flight (1).csv"):
        (tmp_path / name).write_text(TEXT)
    log = read_log([tmp_path / "flight.csv", tmp_path / "flight (1).csv"], MAPPING)
    (finding,) = log.findings
    assert (finding.kind, finding.run) == ("equal runs", "flight (1)")


def test_a_column_may_hold_a_comment_sign_in_its_name(tmp_path):
    table = parse(tmp_path, "t,motor#1\n0,1\n1,2\n")
    assert list(table) == ["t", "motor#1"]
    assert len(table) == 2


def test_only_text_is_unpacked(tmp_path):
    packed = tmp_path / "log.npz.gz"
    packed.write_bytes(gzip.compress(b"an archive"))
    with pytest.raises(DataError, match="log.npz.gz: unknown kind of file; .* .tsv.gz"):
        read_log(packed, MAPPING)


@pytest.mark.parametrize("write", [str, lambda v: str(np.array(v)), tuple])
def test_lists_in_cells_are_columns_of_their_numbers(tmp_path, write):
    values = [[0.5 * i, -1.0 + i, 2e-7] for i in range(200)]
    table = TABLE.head(200).assign(p=[str(write(v)) for v in values], R="[[1, 0]]")
    table.loc[7, "p"] = None
    read = parse(tmp_path, table.to_csv(index=False))
    assert list(read.columns) == ["t", "x", "u", "p[0]", "p[1]", "p[2]", "R"]
    np.testing.assert_array_equal(
        read["p[1]"].drop(7), np.delete(values, 7, axis=0)[:, 1]
    )
    assert np.isnan(read["p[2]"][7])


@pytest.mark.parametrize("odd", ["[1, 2]", "[1, two, 3]", "broken", "[]"])
def test_lists_of_several_lengths_stay_texts(tmp_path, odd):
    table = TABLE.head(100).assign(p="[1, 2, 3]")
    table.loc[60, "p"] = odd
    assert list(parse(tmp_path, table.to_csv(index=False)).columns) == [*"txu", "p"]
