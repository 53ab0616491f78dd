"""`python -m benchmarks score`: the truths of its scenes, its records, and LavenderSim as a contestant."""

import importlib
import math
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.score import scenes
from benchmarks.score.records import read_records
from benchmarks.score.run import command, measure_cell, run_cells
from benchmarks.score.settings import ENGINES, RULE

ROOT = Path(__file__).resolve().parents[2]
DT = 1 / 240
#: Largest error of LavenderSim with default settings at 1/240 s: twice the measured one, and at least rounding.
LAVENDER = {
    "stick": 1e-9,
    "slip": 1e-9,
    "slide": 0.0125,
    "roll": 1e-9,
    "stack": 1.3e-3,
    "ratio": 0.09,
    "bounce": 0.015,
    "tumble": 1e-9,
    "grip": 1e-9,
    "cards": 1e-5,
    "belt": 4.2e-3,
    "pendulum": 1.4,
    "four-bar": 9e-3,
    "motor": 1e-9,
    "heading": 1e-3,
    "rates": 3.2e-3,
    "ratios": 1.4,
}


def follow(position, velocity, spin=(0, 0, 0)):
    """Return a simulation whose first body follows functions of time, and whose other bodies rest."""

    def run(scene, dt, every):
        t = np.linspace(0, scene["seconds"], round(scene["seconds"] / every) + 1)
        moving = [body for body in scene["bodies"] if body["mass"] > 0]
        x = np.zeros((len(t), len(moving), 13))
        for i, body in enumerate(moving):
            x[:, i, :3], x[:, i, 3:7], x[:, i, 7:10] = (
                body["position"],
                body["quaternion"],
                body["velocity"],
            )
        x[:, -1, :3] += np.array([position(s) for s in t])
        x[:, -1, 7:10] = [velocity(s) for s in t]
        x[:, -1, 10:13] = [spin(s) if callable(spin) else spin for s in t]
        return t, x

    return run


def simulate_ball(scene, dt, every):
    """Fall by symplectic Euler steps; the step that would overlap reverses the velocity by Newton's law instead."""
    z = scene["bodies"][1]["position"][2] - 0.1
    v = 0.0
    heights = []
    for _ in range(round(scene["seconds"] / dt) + 1):
        heights.append(z)
        free = v - 9.81 * dt
        v = -scene["restitution"] * free if z + free * dt < 0.0 else free
        z = z + v * dt
    x = np.zeros((len(heights), 1, 13))
    x[:, 0, 2] = np.array(heights) + 0.1
    return dt * np.arange(len(heights)), x


def still(_):
    return (0.0, 0.0, 0.0)


def along(distance):
    return lambda t: distance(t) * scenes.DIRECTION


def test_score_of_an_exact_motion_is_zero():
    angle = math.atan(0.5) + math.radians(1)
    a = 9.81 * (math.sin(angle) - 0.5 * math.cos(angle))
    stop = 3 / (0.5 * 9.81)
    roll = 2 / 7 * 2 / (0.3 * 9.81)
    rest = follow(still, still)
    exact = {
        "stick": rest,
        "slip": follow(along(lambda t: a * t * t / 2), along(lambda t: a * t)),
        "slide": follow(
            along(lambda t: 3 * min(t, stop) - 0.5 * 9.81 * min(t, stop) ** 2 / 2), still
        ),
        "roll": follow(still, along(lambda t: 2 - 0.3 * 9.81 * min(t, roll))),
        "stack": rest,
        "ratio": rest,
        "grip": rest,
        "cards": rest,
        "belt": follow(along(lambda t: t - 1 / (2 * 0.5 * 9.81) if t > 0 else 0.0), still),
        "motor": follow(still, still, lambda t: (0.0, min(10 * t, 5.0), 0.0)),
        "ratios": rest,
    }
    for name, run in exact.items():
        error = scenes.SCENES[name].measure(run, DT)
        assert (error[0] if isinstance(error, tuple) else error) < 1e-12, name
    assert scenes.measure_stick(follow(along(lambda t: 0.01 * t), still), DT) == pytest.approx(0.01)
    assert scenes.measure_cards(follow(lambda t: (0, 0, -0.02 * t), still), DT) == pytest.approx(
        0.1
    )


def test_score_of_bounces_between_steps_vanishes_with_the_step():
    errors = [scenes.measure_bounce(simulate_ball, 1 / rate) for rate in (240, 2400, 24000)]
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 5e-4


def test_score_of_a_slope_finds_the_friction_coefficient_of_each_heading():
    def run(scene, dt, every):
        g = np.array(scene["gravity"])
        heading = math.atan2(g[1], g[0])
        pyramid = 0.5 / max(abs(math.cos(heading)), abs(math.sin(heading)))  # a box of friction
        a = max(0.0, math.hypot(*g[:2]) - pyramid * -g[2])
        x = np.zeros((2, 1, 13))
        x[1, 0, 7] = 2 * a
        return np.array([0.0, 2.0]), x

    error, found = scenes.measure_heading(run, DT)
    assert found == pytest.approx(
        [0.5 / math.cos(math.radians(h)) for h in scenes.HEADINGS], abs=2e-3
    )
    assert error == pytest.approx(0.5 * math.sqrt(2) - 0.5, abs=2e-3)


def test_score_of_a_gap_is_the_distance_of_the_anchors():
    scene = scenes.describe(
        "two",
        1.0,
        [scenes.make_body((0.1, 0.1, 0.1), 1.0, (0, 0, 0.5 * i)) for i in range(2)],
        ground=False,
        joints=[scenes.make_hinge(0, 1, (0, 0, 0.2))],
    )
    x = np.zeros((1, 2, 13))
    x[0, :, 3], x[0, 1, 2] = 1.0, 0.5
    assert scenes.measure_gaps(scene, x) == pytest.approx(0.0)
    x[0, 1, 3:7] = (
        math.cos(0.1),
        0,
        math.sin(0.1),
        0,
    )  # turns the second body by 0.2 rad about its centre
    assert scenes.measure_gaps(scene, x) == pytest.approx(2 * 0.3 * math.sin(0.1))


def test_score_of_a_free_box_is_the_change_of_its_angular_momentum():
    slower = scenes.measure_tumble(
        follow(still, still, lambda t: np.array((1, 4, 1)) * (1 - 0.01 * t)), DT
    )
    inertia = np.array([0.13, 0.1, 0.05]) / 12
    assert slower == pytest.approx(0.1 * np.linalg.norm(inertia * (1, 4, 1)))


def test_score_of_lavender_has_the_published_errors(tmp_path):
    cells = [("default", 240, name) for name in scenes.SCENES]
    rows = {row.scene: row for row in run_cells("lavender", cells, tmp_path, runs=1, limit=10.0)}
    for name, limit in LAVENDER.items():
        assert not rows[name].note and rows[name].error < limit, name
        assert rows[name].cost > 0.0
    assert rows["stick"].residual < 1e-6
    assert len(rows["ratios"].values) == len(scenes.RATIOS)


def test_score_runs_only_cells_that_the_table_lacks(tmp_path):
    def run(*arguments):
        return CliRunner().invoke(
            command,
            [
                "--engine",
                "lavender",
                "--rate",
                "240",
                "--out",
                str(tmp_path / "table.csv"),
                *arguments,
            ],
        )

    first = run("--scene", "stick,roll", "--level", "default")
    assert first.exit_code == 0 and first.output.count("µs a step") == 2
    second = run("--scene", "stick,roll,slip", "--level", "default", "--repeat", "1")
    assert second.output.count("µs a step") == 1 and "| LavenderSim |" in second.output
    assert (
        run("--scene", "stick", "--level", "default", "--repeat", "2").output.count("µs a step")
        == 1
    )
    rows = read_records(tmp_path / "table.csv")
    assert sorted((row.scene, row.runs) for row in rows.values()) == [
        ("roll", 1),
        ("slip", 1),
        ("stick", 2),
    ]


def test_score_settings_say_for_each_kind_of_knob_what_is_set_or_why_not():
    packages = {}
    for name, entry in ENGINES.items():
        kinds = [knob.kind for knob in entry.knobs]
        assert sorted([*kinds, *entry.unset]) == sorted(RULE), name
        assert all(knob.options and knob.source for knob in entry.knobs), name
        assert sum(len(knob.options) for knob in entry.knobs) == len(entry.accurate), name
        assert packages.setdefault(entry.engine, entry.packages) == entry.packages, name


def test_score_table_of_the_repository_has_the_pinned_versions():
    for row in read_records().values():
        assert row.scene in scenes.SCENES
        pinned = ENGINES[row.engine].packages
        assert not pinned or pinned[0].endswith(row.version), row.key


def test_score_page_has_the_tables_of_records_and_settings(monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(ROOT / "docs")
    drawing = importlib.import_module("scorecard")
    page = (ROOT / "docs" / "scorecard.md").read_text(encoding="utf-8")
    rows = read_records()
    for table in (
        drawing.make_scene_table(),
        drawing.make_settings_table(),
        drawing.make_residual_table(rows),
    ):
        assert table in page
    for name in ENGINES:
        assert all(
            drawing.find(rows, name, level, scene)
            for level in drawing.COLUMNS
            for scene in scenes.SCENES
        ), name


def test_score_page_has_the_numbers_of_the_table():
    text = re.sub(r"\s+", " ", (ROOT / "docs" / "scorecard.md").read_text(encoding="utf-8"))
    rows = [
        row
        for row in read_records().values()
        if (row.level, row.rate) == ("default", 240) and not row.note
    ]
    passed = Counter(row.engine for row in rows if scenes.classify(row.scene, row.error) < 2)
    assert max(passed, key=passed.get) == "physx"
    total = len(scenes.SCENES)
    assert f"good or fair in {passed['physx']} of {total} scenes" in text
    assert f"**LavenderSim** in {passed['lavender']}:" in text
    errors = {(row.engine, row.scene): row.error for row in rows}
    assert f"at {errors['mujoco', 'stick']:.1f} m/s" in text
    repeated = [row for row in read_records().values() if row.runs >= 3 and not row.note]
    assert len(repeated) > 200 and all(row.spread == 0.0 for row in repeated)
    assert "Repeated cells have equal errors" in text


class Stub:
    """A simulator of known cost: each run takes two million steps of 3 µs, the engine's start 5 s."""

    def __init__(self):
        self.cpu, self.steps, self.residual, self.residuals = 5.0, 7, 1e-9, True

    def start_cell(self):
        self.cpu = self.steps = 0

    def run(self, scene, dt, every):
        self.steps += 2_000_000
        self.cpu += 6.0
        return follow(still, still)(scene, dt, every)


def test_score_cost_is_the_time_of_one_step_in_microseconds():
    errors, costs, *_ = measure_cell(Stub(), "stick", 240, 3)
    assert costs == pytest.approx([3.0] * 3) and len(errors) == 3


@pytest.mark.parametrize("scene", scenes.SCENES)
def test_score_class_of_an_error_counts_the_limits_that_it_exceeds(scene):
    limits = scenes.SCENES[scene].limits
    for i, limit in enumerate(limits):
        assert scenes.classify(scene, limit) == i and scenes.classify(scene, 1.001 * limit) == i + 1
    assert scenes.classify(scene, 0.0) == 0
    assert scenes.classify(scene, math.nan) == scenes.classify(scene, math.inf) == len(limits)
