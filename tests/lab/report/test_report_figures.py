"""The page stands alone; figures hold the runs that they show, on one pair of axes for the page and for files."""

import html
import html.parser
import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from lavender import bench, report
from lavender.lab.bench.record import file_name
from lavender.lab.report import curves
from lavender.lab.report.axes import Axis
from lavender.lab.report.draw import looks, matplotlib_figure
from lavender.lab.report.svg import svg


class Page(html.parser.HTMLParser):
    """What a page loads, and whether its elements close."""

    VOID = frozenset({"meta", "br", "hr", "img", "input", "link"})

    def __init__(self, text):
        super().__init__()
        self.open, self.loads, self.ids, self.links, self.wrong = [], [], set(), set(), []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids.add(values.get("id"))
        if values.get("href", "").startswith("#"):
            self.links.add(values["href"][1:])
        self.loads += [v for k, v in attrs if k in ("src", "srcset", "data")]
        self.loads += [values["href"]] if tag == "link" else []
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if self.open.pop() != tag:
            self.wrong.append(tag)


def test_the_page_stands_alone_is_well_formed_and_its_folder_is_whole(real, tmp_path):
    records, evil = real
    text = report.write(records, tmp_path).read_text()
    page = Page(text)
    assert page.open == []
    assert page.wrong == []
    assert page.loads == []  # nothing from anywhere
    assert "<script>alert" not in text
    assert "<b>row" not in text
    assert evil not in text
    assert page.links <= page.ids
    assert text.count("<svg") == len(list(curves.figures(records)))
    for name in ("pgs", "jacobi", "Limitations", bench.cpu_name(), "numpy " + np.__version__):
        assert name in text
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {"records.csv", "records.json", "index.html", "summary.md", "figures"}
    shown = [file_name(figure.name) for figure in curves.figures(records)]
    saved = sorted(p.name for p in (tmp_path / "figures").iterdir())
    assert saved == sorted(f"{name}.{suffix}" for name in shown for suffix in ("svg", "png"))
    kinds = [name.split("_")[0] for name in shown]
    assert [kinds.count(kind) for kind in ("work-precision", "budget", "profile")] == [3, 3, 2]
    assert all(p.stat().st_size > 1000 for p in (tmp_path / "figures").iterdir())
    text = (tmp_path / "summary.md").read_text()
    for solver in ("pgs", "direct", "jacobi", "gauss_seidel"):
        assert text.count(f"\n| chain | {solver} |") == 1


def test_looks_tell_solvers_apart():
    names = [f"s{i}" for i in range(24)] + ["pgs", "direct"]
    found = looks(names)
    assert len({(k.color, k.line, k.marker) for k in found.values()}) == len(names)
    assert found["pgs"].color != found["direct"].color
    assert found == looks(reversed(names))


def test_a_curve_is_the_runs_of_its_solver(real):
    records, _ = real
    figure = curves.work_precision(records, "chain")
    by = {c.label: c for c in figure.curves}
    assert set(by) == {"pgs", "direct", "jacobi", "gauss_seidel"}
    mine = [r for r in records if r.case == "chain" and r.solver == "pgs" and r.order == "given"]
    assert sorted(zip(by["pgs"].x, by["pgs"].y, strict=True)) == sorted(
        (r.time_min, r.relative) for r in mine
    )
    best = min(
        (r for r in records if r.case == "chain" and r.order == "given" and r.floor > 0),
        key=lambda r: (r.relative, r.floor),
    )
    assert figure.floor == best.floor


def read_back(drawing):
    """Label -> (x, y) of each point of a drawing, from the places of points and the axes that it carries."""

    def value(axis, place):
        log, low, high, first, last = map(float, axis.split())
        x = low + (high - low) * (place - first) / (last - first)
        return 10.0**x if log else x

    root = ElementTree.fromstring(drawing)
    found = {}
    for curve in root.iter("g"):
        dots = next(p for p in curve.iter("path") if p.get("class") == "d")
        places = re.findall(r"M(\d+) (\d+)", dots.get("d"))
        found[curve.get("data-l")] = [
            (value(root.get("data-x"), int(x)), value(root.get("data-y"), int(y))) for x, y in places
        ]
    return found


def test_a_drawing_holds_the_points_of_its_figure(real):
    records, evil = real
    for name in ("chain", evil):
        figure = curves.work_precision(records, name)
        found = read_back(svg(figure, {"pgs": 1}, ["pgs"]))
        assert list(found) == [c.label for c in figure.curves]
        for c in figure.curves:
            x, y = np.array(found[c.label]).T
            # A unit of the drawing: 672 for at least a decade of time, some 17 decades of residual on 494.
            assert np.abs(np.log10(x / np.array(c.x))).max() < 0.01
            assert np.abs(np.log10(y / np.array(c.y))).max() < 0.04


@pytest.mark.parametrize("steps", [True, False])
def test_names_at_the_ends_of_curves_neither_cover_each_other_nor_leave_the_drawing(steps):
    names = ["auto", "block_gauss_seidel", "sequential_impulses"]
    made = [
        curves.Curve(n, n, (1.0, 2.0 + i, 9.0), (50.0, 100.0, 100.0), steps=steps)
        for i, n in enumerate(names)
    ]
    root = ElementTree.fromstring(svg(curves.Figure("f", "t", "x", "y", tuple(made), y_log=False), {}, names))
    texts = [
        (t.text, int(t.get("x")), int(t.get("y"))) for t in root.iter() if t.tag == "text" and t.text in names
    ]
    assert sorted(t[0] for t in texts) == names
    heights = sorted(t[2] for t in texts)
    assert min(np.diff(heights)) >= 26  # the largest letters, on a phone
    assert all(x + 12.2 * len(name) <= 1000 for name, x, _ in texts)  # 22 units high: 0.55 of it wide


def test_a_drawing_survives_what_has_no_place_on_its_axes():
    odd = curves.Curve("a", "a", (0.0, 1e-300, 1.0, math.inf), (1.0, math.nan, 0.0, 1.0))
    for drawn in (
        curves.Figure("f", "<t>&", "x", "y", (odd,)),
        curves.Figure("f", "t", "x", "y", (), x_log=False, y_log=False),
        curves.Figure(
            "f", "t", "x [s]", "y", (curves.Curve("a", "a", (1.0,), (1.0,), ("<&",)),), levels=(0.0,)
        ),
        curves.Figure("f", "t", "x", "y", (curves.Curve("a", "a", (1.0, 1.0), (5.0, 5.0)),), False, False),
    ):
        ElementTree.fromstring(svg(drawn, {}))
        matplotlib_figure(drawn, looks(["a"])).draw_without_rendering()


@pytest.mark.parametrize("name", ["time", "budget", "profile"])
def test_a_file_and_the_page_have_the_same_axes(name, real):
    records, _ = real
    figure = curves.work_precision(records, "chain")
    if name == "budget":  # less than a decade, and a straight axis
        made = curves.Curve("pgs", "pgs", (4.0, 8.0, 16.0), (0.1, 0.5, 0.9))
        figure = curves.Figure("f", "t", "iterations", "share", (made,), y_log=False)
    if name == "profile":
        made = curves.Curve("pgs", "pgs", (1e-5, 1e3), (0.3, 0.3), steps=True)
        figure = curves.Figure("f", "t", "time [s]", "share", (made,), y_log=False)
    root = ElementTree.fromstring(svg(figure, {}))
    (axes,) = matplotlib_figure(figure, looks(c.solver for c in figure.curves)).axes
    words = [t.text for t in root.iter("text") if t.get("class") == "a"]
    for drawn, data, limits in (
        (axes.xaxis, "data-x", axes.get_xlim()),
        (axes.yaxis, "data-y", axes.get_ylim()),
    ):
        log, low, high, *_ = map(float, root.get(data).split())
        ends = np.log10(limits) if log else limits
        np.testing.assert_allclose(ends, (low, high), atol=1e-4)  # the page has four digits of them
        ticks = [t.get_text() for t in drawn.get_ticklabels()]
        assert 2 <= len(ticks) <= 9
        assert ticks == words[: len(ticks)]
        del words[: len(ticks)]
        assert not drawn.get_minorticklocs().size


@pytest.mark.parametrize(
    ("low", "high", "unit", "tick"),
    [(1e-5, 1e-4, "µs", "100"), (1e-4, 1.0, "ms", "0.1"), (0.5, 50.0, "s", "10"), (1e-9, 1e-8, "ns", "1")],
)
def test_an_axis_and_its_ticks_have_one_unit(low, high, unit, tick):
    axis = Axis([low, high], True, "time: set-up and solve [s]")
    assert axis.title == f"time: set-up and solve [{unit}]"
    words = [axis.text(t) for t in axis.ticks()]
    assert tick in words and all(re.fullmatch(r"[\d.]+(e-?\d+)?", word) for word in words)
