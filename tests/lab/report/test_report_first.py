"""What is read first: the first screen of a page, the terminal's 25 lines, a warning of a busy machine, a paper."""

import dataclasses
import html
import re
import sys

import pytest

import lavender as lv
from lavender import bench, report
from lavender.lab.report import curves, paper, tables
from lavender.lab.report.contents import advice_table
from lavender.lab.report.draw import looks
from lavender.lab.report.findings import Report
from lavender.lab.report.paper import write_paper
from lavender.lab.report.terminal import ADDED, LINES
from lavender.lab.report.verdict import verdict
from tests.lab.report.test_report import record, records_of, shown


def test_each_run_says_how_busy_the_machine_was(real):
    assert all(r.load is None or r.load >= 1.0 for r in real[0])  # this process at least
    assert sys.platform != "linux" or not any(r.load is None for r in real[0])


def test_a_time_in_which_nothing_serves_names_nobody_and_says_what_time_it_takes():
    """Who serves 8 of 17 leaves all of the residual at the 90th percentile: noise decides who that is."""
    budget = {"mode": "budget", "tol": 0.0, "max_iter": 4, "claims": False, "work": {"sweeps": 4}}
    made = [record(f"c{i}", "auto", 1e-2, 1e-7) for i in range(17)]
    for solver in ("anderson", "block_gauss_seidel"):
        made += [record(f"c{i}", solver, 5e-5 if i < 8 else 4e-4, 1e-1, **budget) for i in range(17)]
    found = records_of(*made)
    (said,) = (t for t in verdict(found, [1e-4]).told if t.asked)
    assert said.text.startswith(
        "Nothing serves in 100 µs: to leave at most half of the start's residual on nine cases of ten takes 400 µs."
    )
    assert said.code == ()
    (line,) = report.advice(found, [1e-4, 4e-4])
    assert [line.by_time[t].best and line.by_time[t].best.solver for t in (1e-4, 4e-4)] == [None, "anderson"]
    assert "nobody (8/17 at most)" in str(advice_table(Report(found, None, [1e-4])).texts)


def busy_report(busy):
    """Of 20 runs, so many under a load of 6 on two cores."""
    made = [record(f"c{i}", "pgs", 1e-3, 1e-7, load=6.0 if i < busy else 1.1) for i in range(20)]
    return Report(records_of(*made))


def test_a_loaded_machine_is_told_in_terminal_page_summary_and_paper(tmp_path):
    """By the mean over the runs, of which a few may meet something else: load 6 on two cores is void, 2.3 is not."""
    found = busy_report(20)
    said = "The machine was busy: load 6.0 on 2 cores while this was timed."
    index = report.write(found, tmp_path, figures=False)
    method = write_paper(found, tmp_path / "paper") / "method.tex"
    places = (index, tmp_path / "summary.md", method)
    for text in (shown(found), *(p.read_text(encoding="utf-8") for p in places)):
        assert said in text
    assert found.busy.startswith(said)
    assert (busy_report(0).busy, busy_report(5).busy) == ("", "")


@pytest.mark.parametrize("width", [60, 80, 120])
def test_tables_stay_within_the_terminal_and_nothing_is_cut(real, width):
    out = shown(Report(real[0]), width, whole=True)
    assert max(map(len, out.splitlines())) <= width
    assert "…" not in out
    found = report.advice(real[0])
    for name in {line.name for line in found}:
        assert name in out
    for best in (a.best for line in found for a in (*line.by_level.values(), *line.by_time.values())):
        assert best is None or best.solver in out


@pytest.mark.parametrize(("cases", "width"), [(1, 40), (40, 20), (40, 80), (40, 10_000)])
def test_in_short_the_terminal_shows_25_lines_within_its_width(cases, width):
    """Warnings of every kind, names of any length and as many structures as there are words."""
    made, names = [], [f"case {i} of a folder with a long name" for i in range(cases)]
    for name in names:
        for j in range(30):
            more = (
                {"claim_check": "contradicted", "status_conflict": "says CONVERGED " * 9}
                if j > 27
                else {"load": 9.0}
            )
            made.append(record(name, f"solver_{j}", 1e-3 * (1 + j), 1e-7, **more))
    found = records_of(*made, structure={name: (f"structure {i}",) for i, name in enumerate(names)})
    for name in names:
        found.add(dataclasses.replace(found.cases[name], suspicions=("something looks wrong",)))
        found.add(bench.Skip("run", name + "b", "", "did not load: " + "x" * 100))
        found.add(bench.Skip("run", name, "newton", "takes laws linear"))
    lines = shown(Report(found), width).splitlines()
    assert len(lines) + ADDED <= (LINES if width > 20 else 35)  # a sentence takes what it takes
    assert max(map(len, lines)) <= width
    assert lines[0].startswith("Use solver_0")
    assert sum("more: --tables" in line for line in lines) == 1
    assert any(line.startswith("false claim, the ") for line in lines)


def test_the_first_screen_is_a_sentence_a_line_and_a_figure(real, tmp_path):
    page = report.write(real[0], tmp_path, figures=False).read_text(encoding="utf-8")
    first = html.unescape(page[page.index("<body>") : page.index('<details class="part"')])
    told = verdict(real[0]).told
    assert [t.text in first for t in told] == [True] + [False] * (len(told) - 1)
    assert re.findall(r"<pre>(.*?)</pre>", first, re.DOTALL) == [
        told[0].line,
        told[0].in_c,
    ]  # C is in a tab of its own
    assert 'id="in-python" checked' in first
    assert first.count("<svg") == 1
    assert 'class="b"' in first
    assert "<table" not in first and "<p>" not in first
    rest = page[page.index("<main>") : page.index("</main>")]
    assert not re.search(r'<details class="part"[^>]* open', rest)
    assert all(t.text in html.unescape(rest) for t in told[1:])


def test_a_paper_is_written_from_records_alone(real, tmp_path):
    records = real[0]
    folder = write_paper(Report(records), tmp_path / "paper")
    pdf = {p.name for p in folder.glob("*.pdf")}
    assert "over-all.pdf" in pdf
    assert any(name.startswith("profile-") for name in pdf)
    assert all(p.read_bytes().startswith(b"%PDF") for p in folder.glob("*.pdf"))
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    write_paper(Report(records), folder)
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before  # no clock in it
    text, method = ((folder / name).read_text(encoding="utf-8") for name in ("tables.tex", "method.tex"))
    assert (
        text.count(r"\begin{tabular}")
        == text.count(r"\end{tabular}")
        == 2 + len(tables.geometric_means(records))
    )
    for line in text.splitlines():
        if line.endswith(r" \\"):  # as many cells as the head has
            head = next(
                h for h in text[: text.index(line) + len(line)].splitlines()[::-1] if "tabular}{" in h
            )
            assert len(re.findall(r"(?<!\\)&", line)) == len(head.split("{")[-1].rstrip("}")) - 1
    assert not any(b"/Type3" in p.read_bytes() for p in folder.glob("*.pdf"))  # publishers refuse such fonts
    captions = (folder / "figures.tex").read_text(encoding="utf-8")
    assert set(re.findall(r"includegraphics{(.*?)}", captions)) == pdf
    unescaped = re.findall(
        r"(?<!\\)[_#%]",
        (text + method + re.sub(r"\\(label|includegraphics){.*?}", "", captions)).replace(
            "% \\usepackage", ""
        ),
    )
    assert unescaped == []
    for number in (len(records), len({r.solver for r in records}), len({r.case for r in records})):
        assert re.search(rf"\b{number} ", method)
    with pytest.raises(lv.InputError, match="runs with times"):
        write_paper(Report(records_of()), tmp_path / "none")


@pytest.mark.slow
def test_a_paper_has_a_figure_for_each_folder_and_backends_by_their_own_interface(tmp_path):
    """What is not drawn, and whose time is another, stands in the caption."""
    made, places = [], {"a": "mine/piles", "b": "mine/piles", "c": "mine/chains", "d": "mine/chains"}
    for case in places:
        for i in range(6):
            made.append(record(case, f"solver_{i}", 1e-3 * (1 + i), 10.0 ** (i - 9)))
        made.append(record(case, "osqp", 12.7e-3, 1e-12, own_min=1.1e-3))
    found = records_of(*made)
    for case, folder in places.items():
        found.add(dataclasses.replace(found.cases[case], source=f"{folder}/{case}.npz"))
    kept, drawn = paper.matplotlib_figure, {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            paper, "matplotlib_figure", lambda f, *more: drawn.update({f.name: f}) or kept(f, *more)
        )
        folder = write_paper(Report(found), tmp_path)
    assert {"over all", "class piles", "class chains"} <= set(drawn)
    for name in ("over all", "class piles", "class chains"):
        (osqp,) = (c for c in drawn[name].curves if c.solver == "osqp")
        assert osqp.x[0] == pytest.approx(1.1e-3, rel=0.04)  # a step of the grid: 6^(1/48)
        assert len(drawn[name].curves) == curves.LINES and len(drawn[name].left_out) == 2
    captions = (folder / "figures.tex").read_text(encoding="utf-8").splitlines()
    for line in (line for line in captions if "over all" in line):
        assert "Time of its own interface, on data given before, without conversion: osqp." in line
        assert "Not drawn: solver\\_4, solver\\_5." in line
    assert "without conversion: osqp" in (folder / "method.tex").read_text(encoding="utf-8")
    assert (folder / "tables.tex").read_text(encoding="utf-8").count("without conversion: osqp") == 1
    assert "Left out" not in "".join(captions) and "no result" not in "".join(captions)
    found.add(bench.Skip("run", "e", "", "did not load: mine/chains/e.npz is empty"))
    some = found.having(r for r in found if (r.case, r.solver) != ("a", "osqp"))
    write_paper(Report(some), tmp_path)
    for name in ("figures.tex", "tables.tex"):
        said = [s for s in (folder / name).read_text(encoding="utf-8").splitlines() if "\\caption" in s]
        assert said and all("Left out, for it did not load: 1 problem." in s for s in said)
    over = [s for s in (folder / "figures.tex").read_text(encoding="utf-8").splitlines() if "over all" in s]
    assert ["no result: 1" in s for s in over if "caption" in s] == [True, False, True]
    canvas = kept(
        dataclasses.replace(drawn["over all"], title=""), looks(["osqp"] + [f"solver_{i}" for i in range(6)])
    )
    place = canvas.axes[0].get_position()
    assert place.x0 < 0.15 and place.x1 > 0.95  # no third of it is left to a legend
    assert canvas.axes[0].get_legend().get_title().get_text() == "5 of 7 solvers"
