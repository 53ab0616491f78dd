"""Every number of the chapter's pages is what the command beside it prints.

Comments in chapter_claims.txt hold the claims, under the headings of all sections of the pages: a command in the
first line, then `numbers | line`, the line as it is printed with `{}` for a number, `_` for a word, `…` for anything
and blanks of any width. A number is held to half a unit of its last digit, or to a tolerance after `±` where
libraries of other machines may round otherwise; `<0.1` holds where what is printed is less.
`given:` lists settings and numbers of theory, `measured once:` those of another project's engine; a section has no
further numbers but those claimed elsewhere on the pages. LAVENDER_PRINTED names a folder with what the commands printed
before, in files of their names with `_` for `/`.
"""

import contextlib
import io
import os
import re
import shlex
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from click.testing import CliRunner
from worked import example

from lavender.cli import cli

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = [ROOT / "docs" / "course" / f"{name}.md" for name in ("chapter", "answers")]
PAGE = "\n".join(path.read_text(encoding="utf-8") for path in PAGES)
COMMENT = re.compile(r"<!-- (.*?) ?-->", re.DOTALL)
CODE = re.compile(r"^```.*?^```$|`[^`\n]*`|\]\([^)]*\)", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e-?\d+)?(?!\w|\.\d)")
NUMERAL = r"(?<![\w.])([-+\d.e]*\d)(?!\d)"
HEADING = re.compile(r"^#+ .*\n", re.MULTILINE)
CLAIMS_TEXT = Path(__file__).with_name("chapter_claims.txt").read_text(encoding="utf-8")
SECTIONS = [
    page + comments
    for page, comments in zip(HEADING.split(PAGE), HEADING.split(CLAIMS_TEXT), strict=True)
]


def value(text):
    return float(text.replace(",", ""))


def claims(text):
    """Command -> [(numbers as they stand, tolerance [%] or "", printed line)], and the set of other numbers."""
    by = {}
    others = set()
    for comment in COMMENT.findall(text):
        first, *lines = comment.strip().splitlines()
        kind, colon, listed = first.partition(": ")
        if colon and kind in ("given", "measured once"):
            others |= set(listed.split())
            continue
        for line in lines:
            numbers, _, printed = line.partition(" | ")
            numbers, _, tolerance = numbers.partition(" ± ")
            by.setdefault(first, []).append((numbers.split(), tolerance.rstrip("%"), printed))
    return by, others


@cache
def printed(command):
    """What a command of the page prints."""
    if folder := os.environ.get("LAVENDER_PRINTED"):
        return Path(folder, command.replace("/", "_")).read_text(encoding="utf-8")
    words = shlex.split(command)
    if words[0] == "python":
        name = Path(words[1]).stem
        out = io.StringIO()
        with TemporaryDirectory() as folder, contextlib.redirect_stdout(out):
            figure = Path(
                folder, f"{name}.png"
            )  # the script's own name: all numbers and all panels
            example(name).main(str(figure))
            assert figure.read_bytes().startswith(b"\x89PNG")
        return out.getvalue()
    assert words[0] == "lavender"
    result = CliRunner().invoke(cli, words[1:])
    assert result.exit_code == 0, result.output
    return result.output


def check(numbers, tolerance, line, text):
    """The numbers are what the first such line says."""
    places = {"_": r"\S+", "…": ".*?"}
    pattern = " ".join(
        places.get(w) or re.escape(w).replace(r"\{\}", NUMERAL) for w in line.split()
    )
    found = next(
        filter(None, (re.fullmatch(pattern, " ".join(x.split())) for x in text.splitlines())), None
    )
    assert found, f"no line {line!r} in\n{text}"
    for number, shown in zip(numbers, found.groups(), strict=True):
        if number.startswith("<"):
            assert value(shown) < value(number[1:]), f"{number}, but {found[0]!r} is printed"
            continue
        mantissa, _, exponent = number.replace(",", "").partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        allowed = float(tolerance) / 100.0 * value(number) if tolerance else 0.5 * unit
        # what is printed is decimal, too
        assert abs(value(shown) - value(number)) <= allowed * (1.0 + 1e-9), (
            f"{number}, but {found[0]!r} is printed"
        )


def claimed(by):
    """The numbers of all claims of some commands."""
    return {
        number.lstrip("<") for found in by.values() for numbers, *_ in found for number in numbers
    }


CLAIMS = claims(CLAIMS_TEXT)[0]


@pytest.mark.parametrize("command", sorted(CLAIMS))
def test_chapter_numbers_equal_the_command(command):
    assert f"`{command}`" in PAGE
    for numbers, tolerance, line in CLAIMS[command]:
        check(numbers, tolerance, line, printed(command))


@pytest.mark.parametrize("section", SECTIONS[1:], ids=re.findall(r"^#+ (.*)\n", PAGE, re.MULTILINE))
def test_chapter_numbers_and_claims_match_one_to_one(section):
    by, others = claims(section)
    stand = set(NUMBER.findall(CODE.sub(" ", COMMENT.sub("", section))))
    assert claimed(by) | others <= stand <= claimed(CLAIMS) | others


def test_claims_have_the_headings_of_the_pages():
    assert HEADING.findall(CLAIMS_TEXT) == HEADING.findall(PAGE)


def test_chapter_panel_is_drawn_by_the_command_of_its_example():
    """Its picture is there without a build, and none is there that the page does not show."""
    pictures = ROOT / "docs" / "static" / "chapter"
    shown = re.findall(
        r"\(\.\./static/chapter/(\w+)\.png\)\n\n\*[^`]*\*\s`python examples/(\w+)\.py (\w+)\.png`",
        PAGE,
    )
    assert sorted(f"{file}.png" for file, *_ in shown) == sorted(
        path.name for path in pictures.iterdir()
    )
    assert len(shown) > 12 and PAGE.count("(../static/chapter/") == len(shown)
    for file, name, panel in shown:
        assert file == panel and panel in example(name).PANELS
        assert (pictures / f"{file}.png").stat().st_size <= 150_000
    for name, panel in re.findall(r"`python examples/(\w+)\.py (\w+)\.png`", PAGE):
        assert panel in example(name).PANELS
    other = "".join(
        path.read_text(encoding="utf-8") for path in [*(ROOT / "docs").glob("*.md"), *PAGES]
    )
    assert set(re.findall(r"\((?:\.\./)?static/chapter/(\w+)\.png\)", other)) == {
        file for file, *_ in shown
    }
    for name, panel in re.findall(r"generated/figures/(\w+)/(\w+)\.svg", other):
        assert panel in example(name).PANELS
    named = {re.match(r"python examples/(\w+)\.py", command) for command in CLAIMS}
    for module in (example(found[1]) for found in named if found):
        assert all(f"{panel}.png" in module.__doc__ for panel in module.PANELS)


def test_chapter_panel_computes_only_its_own_curves(tmp_path, monkeypatch, capsys):
    module = example("engine_sweeps")
    for name in (
        "solve_first",
        "judge",
        "run",
        "compare_orders",
        "predict_residual",
        "run_without_friction",
    ):
        monkeypatch.setattr(module, name, None)  # neither tables nor the other panels
    monkeypatch.setattr(module, "numbers", module.numbers.__wrapped__)
    monkeypatch.setattr(module, "LIMIT", 0.1)
    module.main(str(tmp_path / "stand.png"))
    assert capsys.readouterr().out == f"figure: {tmp_path / 'stand.png'}\n"
    for name in {
        re.match(r"python examples/(\w+)\.py", command)[1]
        for command in CLAIMS
        if "examples/" in command
    }:
        assert len(example(name).numbers()) >= 1 and callable(example(name).print_numbers)


def test_chapter_python_block_runs_by_itself():
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    assert len(blocks) > 8
    for block in blocks:
        exec(compile(block, "chapter.md", "exec"), {})


def test_chapter_figure_file_named_after_a_panel_holds_it_alone(tmp_path):
    module = example("two_particles")
    module.main(str(tmp_path / "two_particles.svg"))
    module.main(str(tmp_path / "distance.svg"))
    whole, alone = (
        (tmp_path / f"{name}.svg").read_text(encoding="utf-8")
        for name in ("two_particles", "distance")
    )
    assert [text.count('<g id="axes_') for text in (whole, alone)] == [len(module.PANELS), 1]


def test_chapter_failure_has_a_command_that_shows_it():
    tables = re.findall(
        r"^\| failure \| how it shows \| command \|\n\|[-|]+\|\n((?:\|.*\n)+)", PAGE, re.MULTILINE
    )
    assert len(tables) == 5  # one for each experiment
    rows = [
        re.split(r"(?<!\\)\| ", row.strip("|")) for table in tables for row in table.splitlines()
    ]
    assert len(rows) > 14
    for row in rows:
        command = row[-1].strip().strip("`")
        numbers = set(NUMBER.findall(CODE.sub(" ", row[1])))
        assert numbers & claimed({command: CLAIMS[command]}), row


@pytest.mark.parametrize(
    ("number", "shown"),
    [
        ("5e-4", "8.0e-04"),
        ("15", "7.4"),
        ("45.4", "45.6"),
        ("0.40", "0.4060"),
        ("<1e-9", "1.1e-09"),
    ],
)
def test_chapter_comparison_detects_a_wrong_number(number, shown):
    with pytest.raises(AssertionError, match="is printed"):
        check([number], "", "at most {} N s", f"first line\nat  most {shown} N s")
