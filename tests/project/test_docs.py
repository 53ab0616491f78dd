"""What the documentation says runs: its Python, the doctests of the docstrings, and its command lines."""

import doctest
import importlib
import json
import pkgutil
import re
import shlex
import sys
import textwrap
from pathlib import Path

import click
import numpy as np
import pytest

import benchmarks.__main__ as benchmarks
import lavender as lv
from lavender.cli import cli

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "course").glob("*.md")),
]
BLOCK = re.compile(r"^( *)```(python|pycon|sh|console)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def blocks(page, *kinds):
    """(line, kind, text) of the fenced blocks of a page."""
    text = page.read_text(encoding="utf-8")
    return [
        (text.count("\n", 0, found.start(3)) + 1, found[2], textwrap.dedent(found[3]))
        for found in BLOCK.finditer(text)
        if found[2] in kinds
    ]


def modules_with_doctests():
    names = (
        m.name
        for m in pkgutil.walk_packages(lv.__path__, "lavender.")
        if not m.name.endswith("__main__")
    )
    for name in names:
        spec = importlib.util.find_spec(name)
        if (
            spec.origin
            and spec.origin.endswith(".py")
            and ">>> " in Path(spec.origin).read_text(encoding="utf-8")
        ):
            yield name


@pytest.fixture(scope="module")
def generate():
    """Return the module that writes pages, docs/generate.py."""
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        return importlib.import_module("generate")
    finally:
        sys.path.remove(str(ROOT / "docs"))


def run_session(text, names, where):
    """A `>>>` session in the namespace of its page."""
    test = doctest.DocTestParser().get_doctest(text, names, where, where, 0)
    found = []
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    runner.run(test, out=found.append, clear_globs=False)
    names.update(test.globs)
    assert runner.failures == 0, "".join(found)


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder with the files that pages speak of."""
    problem = lv.Problem.contact(np.diag([1.0, 2.0, 2.0] * 2), [1.0, 0.5, 0.0] * 2, mu=[0.5, 0.5])
    solution = lv.solve(problem, "newton", tol=1e-10)
    lv.io.save(problem, tmp_path / "problem.npz")
    if importlib.util.find_spec("h5py") is not None:
        lv.io.save(problem, tmp_path / "pile.hdf5", impulse=solution.impulse)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "examples" / "plugin")  # the module of plugin.md


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.parent.name != "course"], ids=lambda page: page.name
)
def test_python_of_a_page_runs(page, files, capsys):
    whole = "".join(text for *_, text in blocks(page, "python", "pycon"))
    if ".hdf5" in whole:
        pytest.importorskip("h5py", reason="the page reads HDF5 files")
    for engine in ("newton", "genesis"):
        if f"import {engine}\n" in whole or f"import {engine} as" in whole:
            pytest.importorskip(engine, reason=f"the page steps {engine}")
    names = {"np": np, "lv": lv}
    for line, kind, text in blocks(page, "python", "pycon"):
        where = f"{page.name}:{line}"
        if kind == "pycon":
            run_session(text, names, where)
        else:
            exec(compile("\n" * (line - 1) + text, str(page), "exec"), names)


@pytest.mark.parametrize("name", list(modules_with_doctests()))
def test_doctests_of_a_module(name):
    failures, tried = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert tried > 0
    assert failures == 0


def commands_of(page):
    """(where, words) of the commands of a page: lines of blocks, and code within the text without places left open."""
    lines = [
        (line, text)
        for line, _, block in blocks(page, "sh", "console")
        for text in block.splitlines()
    ]
    text = page.read_text(encoding="utf-8")
    for found in re.finditer(r"`((?:lavender|python -m benchmarks) [^`]+)`", BLOCK.sub("", text)):
        if not set("[…") & set(found[1]) and not found[1].endswith("..."):
            lines.append((0, found[1]))
    for line, command in lines:
        yield (
            f"{page.name}, block at line {line}: {command}",
            shlex.split(command.removeprefix("$ "), comments=True),
        )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_command_lines_of_a_page_are_understood(page):
    for where, words in commands_of(page):
        group, rest = (cli, words[1:]) if words[:1] == ["lavender"] else (benchmarks.cli, words[3:])
        if words[:1] != ["lavender"] and words[:3] != ["python", "-m", "benchmarks"]:
            continue
        try:
            sub = group.get_command(None, rest[0])
            assert sub is not None, where
            sub.make_context(rest[0], rest[1:])
        except (click.exceptions.Exit, click.exceptions.MissingParameter):
            pass  # --help, or named without what it is for
        except click.ClickException as error:
            # An option that is spoken of without its value, and a file of the reader's own, are well.
            if not (words[-1].startswith("--") or "does not exist" in error.format_message()):
                pytest.fail(f"{where}: {error.format_message()}")


def anchors(page):
    """Return the anchors that the headings of a page get from MyST."""
    text = re.sub(
        r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    )
    return {
        re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-")
        for title in re.findall(r"^#{1,4} (.+)$", text, re.MULTILINE)
    }


LINKED = [
    *PAGES,
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / ".github").glob("*.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
]


def links(page):
    """Return the relative targets of the links and images of a page, outside of code."""
    text = re.sub(
        r"^ *```.*?^ *```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    )
    text = re.sub(r"`[^`\n]*`", "code", text)
    targets = re.findall(r"\]\(([^()\s]+)\)", text) + re.findall(r"(?:src|href)=\"([^\"]+)\"", text)
    return [target for target in targets if not re.match(r"[a-z]+:", target)]


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.name)
def test_links_resolve_in_a_checkout(page):
    """And on a forge: they lead to files that are checked in, below the root, and to headings that exist."""
    for target in links(page):
        name, _, anchor = target.partition("#")
        other = (page.parent / name).resolve() if name else page
        assert other.exists() and other.is_relative_to(ROOT), f"{page.name} links to {target}"
        assert not {"generated", "_build"} & set(other.relative_to(ROOT).parts), (
            f"{page.name}: {target}"
        )
        if anchor and "=" not in anchor:
            assert anchor in anchors(other), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_install_from_the_checkout_until_a_version_is_published(page):
    assert "No wheel has been published" in (ROOT / "docs" / "install.md").read_text(
        encoding="utf-8"
    )
    assert not re.search(r"pip install [^`\n]*lavender-contact", page.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.name)
def test_pages_shown_by_a_forge_have_no_markup_of_sphinx(page):
    text = page.read_text(encoding="utf-8")
    assert (
        re.findall(r"^ *(?:`{3,}|:{3,}) *\{.*|^: .*|\{(?:doc|ref|numref)\}`.*", text, re.MULTILINE)
        == []
    )


def test_the_page_on_plug_ins_shows_the_project_file_of_the_example():
    (shown,) = re.findall(
        r"^   ```toml\n(.*?)^   ```$", (ROOT / "docs/plugin.md").read_text("utf-8"), re.M | re.S
    )
    file = ROOT / "examples" / "plugin" / "pyproject.toml"
    assert textwrap.dedent(shown) == file.read_text(encoding="utf-8")


def test_written_pages_are_current(generate):
    for name, text in generate.committed_pages().items():
        current = (ROOT / "docs" / name).read_text(encoding="utf-8") == text
        assert current, f"docs/{name} is not current: run `python docs/generate.py --pages`"


def test_every_test_that_a_page_names_exists():
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py"))
    known = {path.stem for path in (ROOT / "tests").rglob("test_*.py")} | set(
        re.findall(r"def (test_\w+)", sources)
    )
    for page in PAGES:
        named = set(re.findall(r"\btest_\w+", page.read_text(encoding="utf-8")))
        assert named <= known, f"{page.name} names {sorted(named - known)}"
        for file in re.findall(r"\btests/[\w/]+\.py\b", page.read_text(encoding="utf-8")):
            assert (ROOT / file).is_file(), f"{page.name} names {file}"


def test_every_module_that_a_page_asks_help_for_exists():
    names = {
        name
        for page in PAGES
        for name in re.findall(r'help\("([\w.]+)"\)', page.read_text("utf-8"))
    }
    assert names
    for name in names:
        assert importlib.import_module(name).__doc__, name


def test_the_page_of_examples_lists_every_example():
    page = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"`examples/(\w+\.py)`", page))
    assert listed == {path.name for path in (ROOT / "examples").glob("*.py")}


def test_the_page_on_failures_has_every_status_and_every_error():
    text = (ROOT / "docs" / "failures.md").read_text(encoding="utf-8")
    for name in (
        *lv.Status.__members__,
        "InputError",
        "UnknownName",
        "CapabilityError",
        "SolverUnavailable",
    ):
        assert f"| `{name}` |" in text


def test_documentation_has_every_column_of_records():
    page = (ROOT / "docs" / "report.md").read_text(encoding="utf-8")
    table = page.partition("## The columns of records")[2].partition("\n## ")[0]
    lines = lv.report.run(
        ["toy_stack"], ["pgs"], lv.report.Plan(tolerances=(1e-3,), budgets=(), repeats=1)
    )
    assert set(re.findall(r"`(\w+)`", table)) >= set(lv.report.select_runs(lines))


def test_readme_has_the_numbers_of_its_figure():
    numbers = json.loads((ROOT / "docs" / "static" / "hero.json").read_text(encoding="utf-8"))
    text = re.sub(r"\s+", " ", (ROOT / "README.md").read_text(encoding="utf-8"))
    curves = numbers["curves"]
    left = sorted(1e3 * curves[name][-1][1] for name in ("pgs", "nncg"))  # mm/s after their budget
    auto, newton = (  # at the first tolerance that leaves so little
        next(1e3 * seconds for seconds, error in curves[name] if error <= 1e-9)
        for name in ("auto", "newton")
    )
    before, after = numbers["worst"].values()
    assert lv.registry.get("pgs").max_iter == lv.registry.get("nncg").max_iter == 1000
    for part in (
        f"a pile of {numbers['rows']} rows",
        f"1000 sweeps of `pgs` or `nncg` leave {left[0]:.1f} to {left[1]:.1f} mm/s",
        f"to 1e-9 m/s the default `auto` takes {auto:.0f} ms, `newton` alone {newton:.0f} ms",
        f"all {numbers['steps']} steps",
        f"from {before:.1e} to {after:.1e} rad/s".replace("e-0", "e-"),
    ):
        assert part in text, part


def test_readme_has_the_programs_on_which_auto_is_slow():
    record = json.loads((ROOT / "docs" / "static" / "backends.json").read_text(encoding="utf-8"))
    times = {}
    for line in record["lines"]:
        if line["found"]:
            program = times.setdefault((line["structure"], line["n"]), {})
            program.setdefault(line["solver"], []).append(line["time"])
    slow = {}
    for (structure, _), solvers in times.items():
        medians = {name: np.median(seconds) for name, seconds in solvers.items()}
        best = min(medians, key=medians.__getitem__)
        if medians["auto"] > 2.0 * medians[best]:
            slow.setdefault((structure, best), []).append(medians["auto"] / medians[best])
    assert list(slow) == [("bounds, sparse", "piqp")]
    ((few, many),) = slow.values()
    row = f"| sparse programs with bounds alone | PIQP | **{few:.0f} to {many:.0f}** |"
    assert row in (ROOT / "README.md").read_text(encoding="utf-8")


def test_readme_counts_the_solvers_that_are_registered():
    specs = lv.registry.specs().values()
    own = sum(spec.builtin and not spec.external for spec in specs)
    backends = sum(spec.builtin and spec.external for spec in specs)
    text = re.sub(r"\s+", " ", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert f"any of {own} own solvers or {backends} QP and cone backends" in text
