"""A report survives what it finds: names, records and other reports that mean it harm."""

import dataclasses
import io as text_io
import json
import os

import pytest
from mujoco_scene import scene
from stacks import stack
from worked import python

import lavender as lv
from lavender import bench, cli, io
from lavender.io.stored import lock_output
from lavender.lab.bench import machine
from lavender.lab.bench.record import KINDS, file_name, printable, to_json
from lavender.lab.bench.timed_call import format_call
from lavender.lab.report.findings import Report
from lavender.lab.report.terminal import print_report

POSIX = pytest.mark.skipif(os.name != "posix", reason="processes and file names of POSIX")
QUICK = ("--solvers", "pgs", "--levels", "1e-3", "--budgets", "4", "--repeats", "1", "--orders", "reverse")


@pytest.fixture
def lavender(lavender, tmp_path, monkeypatch):
    """The command, beside what it reads."""
    monkeypatch.chdir(tmp_path)
    return lavender


# -- names ----------------------------------------------------------------------------------------


def test_what_cannot_be_shown_is_written_as_its_code():
    assert printable("a\udce9\ud800\n\x1b\u202eé²") == "a\\xe9\\ud800\\n\\x1b\\u202eé²"
    assert printable("a\nb\r", lines=True) == "a\nb\\r"


@POSIX
def test_what_commands_print_of_paths_is_text(lavender, tmp_path):
    pytest.importorskip("mujoco")
    path = tmp_path / "evil\x1b]0;title\x07.xml"
    path.write_text(scene())
    to = "to\x1b[31m"
    for line in (
        ["bench", "mujoco", path, "--steps", "1"],
        ["record", path, "--steps", "15", "--every", "15", "--out", to],
        ["problems", "@walking", "--out", f"{to}1"],
        ["run", "stack", "--set", "n=1", "--steps", "2", "--trace", f"{to}.csv", "--record", f"{to}2"],
        ["solve", "stack(n=2)", "--output", f"{to}.npz"],
    ):
        code, out, err = lavender(*line)
        assert code == 0, err
        assert "\\x1b" in out + err and "\x1b" not in out + err


def test_what_a_plug_in_calls_itself_is_text(lavender, register):
    register(dataclasses.replace(lv.registry.get("pgs"), name="p\x1b[31m[red]q", summary="of [bold]a\x1b[0m"))
    code, out, _ = lavender("solvers")
    assert code == 0 and "\x1b" not in out
    assert r"p\x1b[31m[red]q" in out and r"of [bold]a\x1b[0m" in out


def test_long_names_that_differ_at_the_end_keep_files_of_their_own():
    names = ["n" * 300 + str(i) for i in range(3)]
    assert len({file_name(name) for name in names}) == 3
    items = bench.resolve([stack(name=n) for n in [*names, names[0], "x", "x", "x #2"]])
    assert len({file_name(item.name).lower() for item in items}) == len(items)


def test_a_reader_that_raises_costs_its_own_case(tmp_path, monkeypatch):
    load = io.load
    for name in ("good", "bad"):
        io.save(stack(), tmp_path / f"{name}.npz")

    def broken(path, **more):
        if "bad" in str(path):
            raise RecursionError("[/x]")
        return load(path, **more)

    monkeypatch.setattr(io, "load", broken)
    records = bench.run([tmp_path], ["pgs"], bench.Plan(levels=(1e-3,), budgets=(), repeats=1))
    assert {r.case for r in records} == {"good"}
    assert ["RecursionError: [/x]" in s.reason for s in records.skips] == [True]


def test_a_campaign_takes_files_and_folders(lavender, tmp_path):
    (tmp_path / "problems").mkdir()
    for name in ("x", "y"):
        io.save(stack(), tmp_path / "problems" / f"{name}.npz")
    io.save(stack(), tmp_path / "z.npz")
    more = (*QUICK[:6], "--workers", 1, "--seeds", "2")
    code, _, err = lavender("report", "problems/", "z.npz", "./z.npz", "random_spd(n=4)", *more)
    assert (code, err.strip()) == (0, "")
    cases = {r.case for r in bench.read("lavender-report")}
    assert cases == {"x", "y", "z", "z #2", "random_spd(n=4, seed=0)", "random_spd(n=4, seed=1)"}
    code, _, err = lavender("report", "nothing.npz", *more)
    assert code == 2
    assert "no such file" in err


# -- records --------------------------------------------------------------------------------------

HOSTILE = [
    None, True, -1, 2**70, 1e400, float("nan"), "", "[/x]", "\ud800", "a$\\frac$b", "<b>", [], [[]], ["a", 2],
    ["\x1b"], {}, {"levels": ["x"]}, {"a": {"b": 1}}, {"x": 1.5},
]  # fmt: skip


@pytest.fixture(scope="module")
def lines():
    """The entries of a small report with a sequence and a skip."""
    plan = bench.Plan(levels=(1e-3,), budgets=(2, 4), repeats=1, orders=("reverse",))
    cases = [stack(name="one"), *bench.sequence([stack(), stack()], "walk")]
    records = bench.run(cases, ["pgs", "direct", "gauss_seidel"], plan)
    entries = [*records.runs.values(), *records.cases.values(), *records.skips, *records.records]
    return [to_json(e) for e in entries]


def show_all(records):
    """Everything that is made of records but the files of figures, in memory."""
    from rich.console import Console

    from lavender.lab.report.figures import build_figures
    from lavender.lab.report.markdown import summarise_report
    from lavender.lab.report.page import render_page

    shown = records.latest()
    report = Report(shown, shown)
    print_report(report, Console(file=text_io.StringIO(), width=140))
    for record in shown.records:  # whichever is the fastest, and so shown, differs from run to run
        assert format_call(record)
    render_page(report, build_figures(shown)).encode("utf-8")
    summarise_report(report).encode("utf-8")


def test_records_of_any_content_are_shown_or_refused(tmp_path, lines):
    """What a field takes is shown with what all others take at once: a page takes longer than a look at a file."""
    path = tmp_path / "records.jsonl"
    first = {kind: next(i for i, e in enumerate(lines) if e["kind"] == kind) for kind in KINDS}

    def read(changes):
        changed = [e | changes.get(e["kind"], {}) if i in first.values() else e for i, e in enumerate(lines)]
        path.write_text("".join(json.dumps(e) + "\n" for e in changed))
        try:
            return bench.read(path)
        except lv.InputError:
            return None

    taken = {}
    for kind, cls in KINDS.items():
        names = [f.name for f in dataclasses.fields(cls)]
        taken[kind] = {n: [v for v in HOSTILE if read({kind: {n: v}}) is not None] for n in names}
        assert any(len(values) < len(HOSTILE) for values in taken[kind].values())
    shown = 0
    for turn in range(max(len(values) for of in taken.values() for values in of.values())):
        some = {kind: {n: x[turn % len(x)] for n, x in of.items() if x} for kind, of in taken.items()}
        records = read(some)
        if records is not None:
            show_all(records)
            shown += 1
    assert shown > 0


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000 + "\n",
        '{"kind": ' * 5000 + "\n",
        "1" * 5000 + "\n",
        '{"kind": ["run"]}\n',
        '{"kind": {}}\n',
        "null\n",
        '"run"\n',
        "\x00\x00\n",
        "\ufffe\n",
        '{"kind": "case"}\n',
    ],
)
def test_a_file_of_anything_is_an_input_error(tmp_path, text):
    (tmp_path / "records.jsonl").write_text(text)
    with pytest.raises(lv.InputError, match="line 1"):
        bench.read(tmp_path)


def test_a_record_of_a_case_that_nobody_described_is_refused(tmp_path, lines):
    kept = [e for e in lines if e["kind"] != "case"]
    (tmp_path / "records.jsonl").write_text("".join(json.dumps(e) + "\n" for e in kept))
    with pytest.raises(lv.InputError, match="record of a case that no line before it describes"):
        bench.read(tmp_path)


def test_the_newest_run_shows_its_own_cases_and_only_as_they_are_now(tmp_path, monkeypatch):
    plan = bench.Plan(levels=(1e-3,), budgets=(), repeats=1)
    path = tmp_path / "records.jsonl"
    bench.run([stack(name="a"), stack(name="b")], ["pgs"], plan, path)
    monkeypatch.setattr(machine, "cpu_name", lambda: "another")
    bench.run([stack(name="a")], ["pgs"], plan, path)
    monkeypatch.undo()
    bench.run([stack(8, name="b")], ["pgs"], plan, path)  # the first run again; b has changed
    newest = bench.read(path).latest()
    assert sorted((r.case, newest.cases[r.case].rows) for r in newest) == [("a", 6), ("b", 8)]
    show_all(newest)


# -- two reports in one folder --------------------------------------------------------------------


def test_one_process_writes_records_and_who_died_holds_nothing(tmp_path):
    path = tmp_path / "records.jsonl"
    with bench.Store(path) as store:
        for _ in range(2):  # and the refusal took nothing away
            with pytest.raises(lv.InputError, match="is being written by another command"):
                bench.Store(path)
        other = python("-c", f"from lavender import bench; bench.Store({str(path)!r})", status=1)
        assert "is being written by another command" in other.stderr
        store.close()
        bench.Store(path).close()
    killed = f"import os; from lavender import bench; s = bench.Store({str(path)!r}); os.kill(os.getpid(), 9)"
    python("-c", killed, status=-9)
    bench.Store(path).close()
    assert list(tmp_path.iterdir()) == [path]


#: Each command that writes a folder, and its words.
WRITE_A_FOLDER = {
    "audit": ("audit", "MODEL", "--worlds", 1, "--steps", 1, "--out", "OUT"),
    "tune": ("tune", "MODEL", "--worlds", 1, "--steps", 1, "--out", "OUT"),
    "record": ("record", "MODEL", "--steps", 1, "--out", "OUT"),
    "report": ("report", "stack(n=2)", *QUICK, "--out", "OUT"),
    "records shown again": ("report", "records.jsonl", "--out", "OUT"),
    "campaign": ("report", "--workers", "1", "stack(n=2)", *QUICK[:6], "--out", "OUT"),
    "problems": ("problems", "@walking", "--out", "OUT"),
    "run": ("run", "stack", "--steps", 1, "--record", "OUT"),
    "export": ("export", "c", "OUT"),
    "web": ("web", "page", "OUT"),
}


@pytest.mark.parametrize("name", WRITE_A_FOLDER)
def test_a_folder_that_another_command_writes_is_refused_before_the_work(lavender, tmp_path, name):
    (tmp_path / "model.xml").write_text(scene())
    (tmp_path / "records.jsonl").touch()
    out = tmp_path / "out"
    words = [{"MODEL": tmp_path / "model.xml", "OUT": out}.get(word, word) for word in WRITE_A_FOLDER[name]]
    with lock_output(out, folder=True):
        held = list(out.iterdir())
        code, _, err = lavender(*words)
        assert code == 2 and "is being written by another command" in err
        assert list(out.iterdir()) == held
    assert not out.exists()  # it was made for the lock alone


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"file": "../../x.npz", "left_out": "\\u202e<i>why"}',
        '{"file": "a\\u0000b", "left_out": ["why"]}',
        '{"file": ["x"], "left_out": null}',
        '{"file": "", "left_out": "why"}',
        pytest.param(None, marks=POSIX, id="a pipe"),
    ],
)
def test_what_an_engine_said_of_a_folder_harms_nothing(lavender, tmp_path, text):
    """Its file may be of anybody: at most it names steps that are not there."""
    folder = tmp_path / "steps"
    folder.mkdir()
    io.save(stack(4), folder / "step_1.npz")
    if text is None:
        os.mkfifo(folder / "engine.jsonl")
    else:
        (folder / "engine.jsonl").write_text(text)
    items = bench.resolve(folder)
    assert items[0].problem.m == 4 and len(items) <= 2
    assert all(item.name.isprintable() for item in items)
    code = lavender("report", folder, *QUICK, "--no-figures")[0]
    assert code == (cli.EXIT_UNMET if len(items) == 2 else 0)
    assert "<i>" not in (tmp_path / "lavender-report" / "index.html").read_text()
