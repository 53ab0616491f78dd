"""`python -m benchmarks score`: the truths of its scenes, its records, and LavenderSim as a contestant."""

import importlib
import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.score import scenes, worker
from benchmarks.score.adapters import Running
from benchmarks.score.causes import PARTS, list_cells, measure_causes, read_causes
from benchmarks.score.records import read_records
from benchmarks.score.run import (
    COLUMNS,
    add_record,
    command,
    get_settings_key,
    make_record,
    measure_cell,
    needs_run,
    run_cells,
)
from benchmarks.score.settings import ENGINES, RULE
from lavender.base.errors import LavenderError

ROOT = Path(__file__).resolve().parents[2]
DT = 1 / 240
#: Largest error of LavenderSim with default settings at 1/240 s: twice the measured one, and at least rounding.
LAVENDER = {
    "stick": 1e-9,
    "slip": 1e-9,
    "slide": 0.0125,
    "spin": 0.0125,
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


def test_score_table_of_the_repository_has_the_versions_and_settings_of_the_command():
    for row in read_records().values():
        assert row.scene in scenes.SCENES
        assert (row.level, row.rate) in COLUMNS
        entry = ENGINES[row.engine]
        assert row.settings == get_settings_key(entry, row.level), row.key
        assert not entry.packages or entry.packages[0].endswith(row.version), row.key
        assert not row.note.startswith("failed"), row.key


@pytest.fixture
def drawing(monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module("scorecard")


def test_score_pages_have_the_tables_and_sentences_of_records_and_settings(drawing):
    rows = read_records()
    for page, parts in (
        ("scorecard.md", drawing.make_tables(rows)),
        ("scorecard-settings.md", drawing.make_settings(rows)),
    ):
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        for name, part in parts.items():
            assert part in text, (page, name)
    settings = ROOT / "docs" / "static" / "scorecard" / "settings.csv"
    assert settings.read_text(encoding="utf-8") == drawing.make_settings_file()
    by_default = drawing.get_engines(rows, COLUMNS[:1])
    assert {row.engine for row in rows.values()} == set(by_default)
    for column in COLUMNS[1:]:  # A column has been run as a whole, or not at all.
        begun = {row.engine for row in rows.values() if (row.level, row.rate) == column}
        assert begun <= set(drawing.get_engines(rows, (column,)))
    assert len({ENGINES[name].engine for name in by_default}) >= 19


def test_score_page_outside_of_computed_parts_has_no_number_of_an_engine():
    text = (ROOT / "docs" / "scorecard.md").read_text(encoding="utf-8")
    text = re.sub(r"<!-- table: .*?<!-- end of table -->|```.*?```", "", text, flags=re.DOTALL)
    names = {entry.title.split(" ")[0] for entry in ENGINES.values()}
    for sentence in re.split(r"(?<=[.:])\s|\n\n", text):
        if any(name in sentence for name in names):
            assert not re.search(r"\d", sentence), sentence


def test_score_sentences_change_with_the_records(drawing):
    rows = read_records()
    before = drawing.make_findings(rows)
    key = ("mujoco", "default", 240, "stick")
    assert f"slides at {rows[key].error:.2g} m/s" in before
    changed = rows | {key: replace(rows[key], error=1.25)}
    assert "slides at 1.2 m/s" in drawing.make_findings(changed)
    default = [row for row in rows.values() if (row.level, row.rate) == COLUMNS[0] and not row.note]
    passed = Counter(row.engine for row in default if scenes.classify(row.scene, row.error) < 2)
    best = [name for name, count in passed.items() if count == max(passed.values())]
    assert f"{drawing.join_names(best, rows)} " in before and f"{max(passed.values())} of" in before


def integrate_cube(loads, dt=5e-4):
    """Return way [m] and turn [rad] of the cube of `spin` by Coulomb's law at its corners.

    The balance of moments leaves one of the four normal forces free between two limits; `loads` chooses from them.
    """
    corners = np.array([(x, y) for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    position = np.zeros(2)
    velocity = 3.0 * scenes.DIRECTION[:2]
    angle = 0.0
    spin = 5.0
    while np.linalg.norm(velocity) + abs(spin) > 0.01:
        c, s = math.cos(angle), math.sin(angle)
        r = corners @ np.array([[c, s], [-s, c]])
        slip = velocity + spin * np.stack([-r[:, 1], r[:, 0]], axis=1)
        direction = slip / np.maximum(np.linalg.norm(slip, axis=1), 1e-9)[:, None]
        balance = np.vstack([np.ones(4), (r - 0.5 * scenes.FRICTION * direction).T])
        particular = np.linalg.lstsq(balance, np.array([9.81, 0, 0]), rcond=None)[0]
        free = np.linalg.svd(balance)[2][3]
        free = free * np.sign(free[0] + free[3] - free[1] - free[2])
        ends = -particular / free
        low, high = ends[free > 0].max(), ends[free < 0].min()
        normal = particular + (low + loads * (high - low)) * free
        force = -scenes.FRICTION * normal[:, None] * direction
        torque = (r[:, 0] * force[:, 1] - r[:, 1] * force[:, 0]).sum()
        # The last step of each motion would reverse it.
        velocity = (
            velocity + dt * force.sum(axis=0)
            if velocity @ (velocity + dt * force.sum(axis=0)) > 0
            else 0 * velocity
        )
        spin = max(0.0, spin + dt * 6.0 * torque)
        position = position + dt * velocity
        angle += dt * spin
    return float(np.linalg.norm(position)), angle


def test_score_range_of_the_spinning_cube_is_that_of_coulomb_at_its_corners():
    found = np.array([integrate_cube(loads) for loads in (0.0, 0.5, 1.0)])
    for (low, high), column, name in zip(
        (scenes.SPIN_WAY, scenes.SPIN_TURN), found.T, "wt", strict=True
    ):
        assert low < column.min() and column.max() < high, name
        # The range is at most a twentieth wider than that of these three.
        assert high - low < column.max() - column.min() + 0.05 * column.mean(), name
    way, turn = found[1]

    def stop(way, turn):
        def spin_by(t):
            return (0.0, 0.0, 0.0)

        run = follow(along(lambda t: way * min(t, 1.0)), still, spin_by)

        def turned(scene, dt, every):
            t, x = run(scene, dt, every)
            half = 0.5 * turn * np.minimum(t, 1.0)
            x[:, 0, 3], x[:, 0, 6] = np.cos(half), np.sin(half)
            return t, x

        return scenes.measure_spin(turned, DT)

    assert stop(way, turn) == 0.0
    assert stop(0.911, 0.56) == pytest.approx(math.sqrt(0.5) * (scenes.SPIN_TURN[0] - 0.56))
    assert stop(1.0, turn) == pytest.approx(scenes.SPIN_WAY[0] - 1.0)


def test_score_of_failed_cells_exits_1_and_keeps_the_record(tmp_path, monkeypatch):
    def run(*arguments):
        table = ["--engine", "lavender", "--scene", "roll", "--rate", "240", "--level", "default"]
        return CliRunner().invoke(
            command, [*table, "--out", str(tmp_path / "table.csv"), *arguments]
        )

    assert run().exit_code == 0
    before = (tmp_path / "table.csv").read_text(encoding="utf-8")
    monkeypatch.setitem(ENGINES, "lavender", replace(ENGINES["lavender"], adapter="missing"))
    failed = run("--again")
    assert failed.exit_code == 1 and "failed" in failed.output
    assert (tmp_path / "table.csv").read_text(encoding="utf-8") == before
    uninstalled = replace(ENGINES["lavender"], packages=("lavender-no-such-package==0",))
    monkeypatch.setitem(ENGINES, "lavender", uninstalled)
    monkeypatch.setattr("benchmarks.score.run.create_environment", raise_not_installed)
    assert run("--again").exit_code == 1
    assert (tmp_path / "table.csv").read_text(encoding="utf-8") == before


def raise_not_installed(entry, folder):
    raise LavenderError(f"{entry.engine} does not install")


def test_score_environments_of_a_relative_folder_are_absolute(tmp_path, monkeypatch):
    seen = []

    def run_cells(name, cells, envs, runs, limit):
        seen.append(envs)
        return iter(())

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("benchmarks.score.run.run_cells", run_cells)
    done = CliRunner().invoke(command, ["--engine", "cannon", "--envs", "envs", "--out", "t.csv"])
    assert done.exit_code == 0 and seen == [tmp_path / "envs"]


def test_score_runs_cells_again_whose_settings_changed():
    entry = ENGINES["lavender"]
    key = get_settings_key(entry, "accurate")
    row = make_record("lavender", ("accurate", 240, "roll"), 1, (0.0,), (1.0,))
    assert row.settings == key != get_settings_key(entry, "default")
    assert not needs_run(row, 1) and needs_run(row, 2) and needs_run(None, 1)
    assert needs_run(replace(row, settings="other"), 1)
    rows = {row.key: row}
    assert not add_record(rows, replace(row, error=math.nan, note="too slow: over 1 s"))
    assert rows[row.key] is row
    assert add_record(rows, replace(row, error=1.0)) and rows[row.key].error == 1.0


def test_score_causes_are_of_the_records_and_sum_to_one(drawing):
    rows = read_records()
    causes = read_causes()
    cells = {row.key: row for row in list_cells(rows)}
    found = {(c["engine"], c["level"], c["rate"], c["scene"]): c for c in causes}
    assert found.keys() == cells.keys()
    # Several rows of one engine are one engine.
    assert len({ENGINES[row.engine].engine for row in cells.values()}) >= 3
    for key, cell in found.items():
        assert cell["settings"] == cells[key].settings
        assert cell["error"] == pytest.approx(cells[key].error, rel=1e-3)
        # 4 digits of each of the parts
        assert sum(cell[part] for part in PARTS) == pytest.approx(1.0, abs=1e-3), key


def test_score_cause_of_a_slab_on_a_pyramid_is_not_the_solver():
    pytest.importorskip("mujoco")
    error, shares, steps = measure_causes("mujoco", ("default", 240), "stick")
    assert steps == 40 and error > 1.0
    assert sum(shares.values()) == pytest.approx(1.0)
    assert abs(shares["solver"]) < 1e-6  # Newton's method solves it to its tolerance, 1e-8.
    assert shares["cone"] > 0.5 and shares["time step"] == 0.0
    _, shares, _ = measure_causes("mujoco", ("default", 240), "tumble")
    assert shares["time step"] == 1.0


def test_score_cause_of_a_heavy_box_in_lavender_sim_is_the_solver():
    error, shares, steps = measure_causes("lavender", ("default", 240), "ratio")
    row = read_records()["lavender", "default", 240, "ratio"]
    assert steps == 40 and error == pytest.approx(row.error, rel=1e-3)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["solver"] == pytest.approx(
        1.0, abs=1e-3
    )  # Sweeps of a rigid problem with a round cone.


def test_score_counts_the_steps_of_all_simulations_of_a_cell():
    assert scenes.count_steps("stack", DT) == 5 * 240
    assert scenes.count_steps("heading", DT) == len(scenes.HEADINGS) * 9 * 2 * 240
    assert scenes.count_steps("ratios", DT) == len(scenes.RATIOS) * 3 * 240
    # `rates` has rates of its own.
    assert scenes.count_steps("rates", DT) == scenes.count_steps("rates", 1e-3) == sum(scenes.RATES)


@pytest.mark.parametrize(
    ("expected", "done"), [(2000, 2000), (3900, 2000), (4200, worker.PROBE), (10**6, worker.PROBE)]
)
def test_score_ends_a_cell_that_would_take_twice_its_limit(monkeypatch, expected, done):
    now = [0.0]
    steps = []

    def step():
        now[0] += 1e-3
        steps.append(1)

    monkeypatch.setattr(worker, "process_time", lambda: now[0])
    engine = Running(step, lambda: [[0.0]], list)
    asked = {"steps": 2000, "every": 1000, "limit": 2.0, "expected": expected}
    answer = worker.advance(engine, asked)
    assert answer["done"] == len(steps) == done
    assert answer["cpu"] == pytest.approx(1e-3 * done)


class Stub:
    """A simulator of known cost: each run takes two million steps of 3 µs, the engine's start 5 s."""

    def __init__(self):
        self.cpu, self.steps, self.residual, self.residuals = 5.0, 7, 1e-9, True

    def start_cell(self, expected=0):
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
