"""What holds for every phenomenon and every engine: ranges, starts, bounds that our exact solver keeps, notes."""

import dataclasses
import importlib.util
import json
import math
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from broken_engines import simulate as simulate_broken

import lavender as lv
from lavender.base.errors import LavenderError
from lavender.lab.phenomena import (
    ENGINE_VARIANTS,
    PHENOMENA,
    Record,
    Track,
    run,
    select_phenomena,
    select_variants,
)
from lavender.lab.phenomena import table as tables
from lavender.lab.phenomena.engines import PACKAGES_OF_NODE, get_npm_versions, make_engine, record_track
from lavender.lab.phenomena.engines.node import JsonLines
from lavender.lab.phenomena.engines.tree import get_collision_shape
from lavender.lab.phenomena.parts import find_crossing_time, measure_track
from lavender.lab.phenomena.running import EngineProcess
from lavender.sim.scene.steppers import STEPPERS

NAMES = tuple(PHENOMENA)
QUICK = (
    "stick", "slide", "stop", "lift", "roll", "roll_to_rest", "spin_down", "free_rotation", "chain_load", "tipping",
)  # fmt: skip
OTHERS = [w for w in ENGINE_VARIANTS.values() if w.module != "own"]


def first(name):
    return PHENOMENA[name].complete_parameters(PHENOMENA[name].cases[0])


@pytest.fixture
def process():
    """A process for engines, killed at the end of the test."""
    process = EngineProcess(limit=600.0)
    yield process
    process.close()


@pytest.fixture
def broken(request, monkeypatch):
    """The same for engines that fail."""
    monkeypatch.setattr("lavender.lab.phenomena.running.record_track_of_engine", simulate_broken)
    return request.getfixturevalue("process")


# -- phenomena ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_every_phenomenon_is_whole(name):
    p = PHENOMENA[name]
    assert p.name == name
    assert all(len(text) > 10 for text in (p.title, p.why, p.truth))
    assert p.cases
    assert p.quantities
    for x in p.parameters.values():
        assert x.low <= x.default <= x.high
    for q in p.quantities:
        assert q.bound >= 0.0
        assert q.text
    for case in p.cases:
        values = p.complete_parameters(case)
        assert math.isfinite(p.seconds(values))
        assert p.build_scene(values).n_bodies > 0
    for low in (True, False):  # the ends of all ranges build too
        values = p.complete_parameters({k: x.low if low else x.high for k, x in p.parameters.items()})
        lv.Simulation(p.build_scene(values, stepper="impulses"))
        assert p.seconds(values) > 0.0


@pytest.mark.parametrize("name", NAMES)
def test_parameters_out_of_their_range_are_refused(name):
    p = PHENOMENA[name]
    for key, x in p.parameters.items():
        for bad in (x.low - 1, x.high + 1, math.nan, "one"):
            with pytest.raises(lv.InputError, match=f"{key} of '{name}'"):
                p.build_scene({key: bad})
    with pytest.raises(lv.UnknownName, match="nonsense"):
        p.build_scene({"nonsense": 1.0})


def cells(text):
    """Worst value with its unit, and cases that passed, by engine and phenomenon, of the tables in a text."""
    found, heads = {}, []
    for line in text.splitlines():
        name, *row = (cell.strip(" *") for cell in line.removeprefix("|").rstrip(" |").split("|"))
        heads = heads if name else row
        found |= {(name, head): cell.split(", ") for head, cell in zip(heads, row, strict=False)}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("stepper", STEPPERS)
def test_what_the_page_says_of_a_stepper_is_what_it_does(stepper):
    page = cells((Path(__file__).resolve().parents[3] / "docs" / "phenomena.md").read_text(encoding="utf-8"))
    found = cells(tables.format_markdown_table(run(QUICK, steppers=[stepper])))
    for variant in select_variants([stepper], []):
        for key in ((variant.name, name) for name in QUICK):
            (value, *passed), (told, *counted) = found[key], page[key]
            assert passed == counted, key
            if passed:
                (x, *unit), (y, *other) = value.split(), told.split()
                assert (float(x), unit) == (pytest.approx(float(y), rel=0.05, abs=1e-10), other), key


@pytest.mark.parametrize("name", sorted({*NAMES} - {"pendulum"}))
def test_the_exact_solver_keeps_every_bound_of_the_first_case(name):
    # it dissipates what swings, at first order in the step: a pendulum it does not keep
    (record,) = run([name], steppers=["impulses newton"], parameters=dict(PHENOMENA[name].cases[0]))
    assert record.passed, tables.format_record(record)


@pytest.mark.parametrize(
    ("name", "of"),
    [("slide", "mu"), ("stop", "mu"), ("roll", "mu"), ("roll_to_rest", "rolling"), ("spin_down", "mu")],
)
def test_friction_of_four_fifths_is_out_of_a_bound(name, of):
    p, values = PHENOMENA[name], PHENOMENA[name].complete_parameters()
    weak = {of: 0.8 * values[of]} | ({"slope": values["slope"] / 0.8} if name == "slide" else {})  # of mu
    scene = p.build_scene(values | weak, stepper="impulses")
    track = record_track(
        make_engine(ENGINE_VARIANTS["impulses newton"], scene), p.seconds(values), p.interval
    )
    assert not measure_track(p, "weak", values, track).passed


@pytest.mark.parametrize("stepper", STEPPERS)
def test_a_pendulum_loses_less_in_shorter_steps(stepper):
    p = PHENOMENA["pendulum"]
    case = p.complete_parameters({"swings": 10})
    left = []
    for substeps in (4, 16):
        scene = p.build_scene(case, stepper=stepper, dt=1 / 60, substeps=substeps)
        left.append(
            p.measure(
                case, record_track(make_engine(ENGINE_VARIANTS[stepper], scene), p.seconds(case), p.interval)
            )["energy"]
        )
    assert left[1] < 0.5 * left[0]


@pytest.mark.slow
def test_what_stands_and_what_falls_are_told_apart():
    for name, key in (("tipping", "slope"), ("overhang", "reach"), ("arch", "thickness")):
        for value in (0.95, 1.05):
            (record,) = run([name], steppers=["impulses newton"], parameters={key: value})
            assert record.get_value("wrong side") == 0.0, tables.format_record(record)


def test_a_track_that_stays_where_it_began_is_wrong_about_what_moves():
    for name, case in (
        ("slide", {"slope": 1.5}),
        ("stop", {}),
        ("tipping", {"slope": 1.1}),
        ("arch", {"thickness": 0.9}),
    ):
        p = PHENOMENA[name]
        values = p.complete_parameters(case)
        scene = p.build_scene(values)
        t = np.arange(0.0, p.seconds(values), p.interval)
        x, q = (np.array([getattr(b, f) for b in scene.bodies]) for f in ("position", "quaternion"))
        still = Track(
            t, np.tile(x, (len(t), 1, 1)), np.tile(q, (len(t), 1, 1)), np.zeros((len(t), len(x), 6))
        )
        assert not measure_track(p, "still", values, still).passed, name


def test_crossings():
    t = np.array([0.0, 1.0, 2.0])
    assert find_crossing_time(t, np.array([2.0, 1.0, 0.0]), 0.5) == pytest.approx(1.5)
    assert find_crossing_time(t, np.ones(3), 0.5) == math.inf


# -- engines --------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", [w.name for w in OTHERS if not w.explain_missing()])
def test_every_engine_starts_as_the_scene_says_and_falls_as_it_should(variant):
    one = ENGINE_VARIANTS[variant]
    for name, p in PHENOMENA.items():
        if any(x in one.cannot for x in p.needs):
            continue
        scene = p.build_scene(first(name))
        engine = make_engine(one, scene)
        try:
            x, q, v = engine.get_state()
            moves = np.array([not b.is_static for b in scene.bodies])
            # lavendersim keeps 32 bits
            for found, key in ((x, "position"), (v[:, :3], "velocity"), (v[:, 3:], "angular_velocity")):
                wanted = np.array([getattr(b, key) for b in scene.bodies])
                np.testing.assert_allclose(found[moves], wanted[moves], atol=2e-6, err_msg=f"{name} {key}")
            turned = np.array([b.quaternion for b in scene.bodies])[moves]
            np.testing.assert_allclose(np.abs((q[moves] * turned).sum(axis=1)), 1.0, atol=2e-6, err_msg=name)
        finally:
            engine.close()
    free = lv.Scene(friction=0.3)
    free.add_plane()
    free.add_box((0.4, 0.2, 0.3), position=(0, 0, 9), velocity=(1, 2, 3))
    engine = make_engine(one, free)
    try:
        track = record_track(engine, 0.5, 1 / 60)
    finally:
        engine.close()
    fall = track.positions[-1, 1] - [0, 0, 9] - track.time[-1] * np.array([1, 2, 3])
    # first order: half a step of 1/60 s at most; lavendersim damps what flies
    np.testing.assert_allclose(fall, [0, 0, -0.5 * 9.81 * track.time[-1] ** 2], atol=0.06)


@pytest.mark.parametrize("variant", [w.name for w in OTHERS if not w.explain_missing()])
def test_what_an_engine_cannot_build_is_said(variant):
    soft = lv.Scene()
    body = soft.add_sphere()
    soft.add_joint("ball", -1, body, anchor=(0, 0, 1), hertz=2.0)
    rough = lv.Scene()
    rough.add_box(friction=0.3)
    for scene, word in ((lv.Scene("four_bar"), "loop"), (soft, "rigid"), (rough, "one friction")):
        with pytest.raises(lv.CapabilityError, match=word):
            make_engine(ENGINE_VARIANTS[variant], scene)


def test_a_static_box_is_refused_where_an_engines_file_makes_none():
    scene = lv.Scene()
    scene.add_box(static=True, name="shelf")
    scene.add_box(position=(0.0, 0.0, 2.0))
    held, moving = scene.bodies
    assert get_collision_shape(held, "engine") is held.shape
    assert get_collision_shape(moving, "engine", static=False) is moving.shape
    with pytest.raises(
        lv.CapabilityError, match="shelf has no collision shape, or a static one that is not a plane"
    ):
        get_collision_shape(held, "engine", static=False)


@pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="needs mujoco")
def test_mujoco_creeps_and_lifts_as_it_is_known_to():
    creep = run(
        ["stick"],
        steppers=[],
        engines=["mujoco elliptic", "mujoco elliptic noslip"],
        parameters={"slope": 0.9},
    )
    assert 1e-5 < creep[0].get_value("creep") < 1e-2  # some 1e-4 m/s: its friction is regularised
    assert creep[1].get_value("creep") < 1e-2 * creep[0].get_value("creep")
    (lift,) = run(["lift"], steppers=[], engines=["mujoco pyramidal"], parameters={})
    assert 1e-3 < lift.get_value("lift") < 1e-2


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("dies", "SIGABRT"),
        ("sleeps", "no answer within 2 s"),
        ("babbles", "not a track"),
        ("leaves", "exit status 0"),
    ],
)
def test_an_engine_that_fails_is_a_note_and_the_next_has_a_process(name, words, broken):
    broken.limit = 2.0 if name == "sleeps" else 600.0
    scene = PHENOMENA["stick"].build_scene()
    variant = dataclasses.replace(OTHERS[0], name=name)
    found = broken.record_track(variant, scene, 1.0, 0.1)
    assert isinstance(found, str)
    assert words in found
    if name != "babbles":  # it sleeps on
        broken.limit = 600.0
        again = broken.record_track(dataclasses.replace(variant, name="leaves"), scene, 1.0, 0.1)
        assert again == "its process ended: exit status 0"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
def test_a_program_that_an_engine_waits_for_ends_with_it(broken, tmp_path):
    broken.limit = 6.0
    variant = dataclasses.replace(OTHERS[0], name=f"waits {tmp_path / 'number'}")
    assert broken.record_track(variant, PHENOMENA["stick"].build_scene(), 1.0, 0.1) == "no answer within 6 s"
    number = int((tmp_path / "number").read_text())
    state = Path(f"/proc/{number}/stat")
    for _ in range(12_000):  # the system takes a moment
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("it runs on")


def test_a_system_that_starts_no_process_is_a_note(process, monkeypatch):
    def refuse(*_, **__):
        raise OSError(11, "no more processes")

    monkeypatch.setattr("lavender.base.subprocesses.subprocess.Popen", refuse)
    found = process.record_track(OTHERS[0], PHENOMENA["stick"].build_scene(), 1.0, 0.1)
    assert found == "its process does not start: [Errno 11] no more processes"


def test_what_an_engine_raises_is_told_and_its_process_stays(process):
    scene = PHENOMENA["stick"].build_scene()
    for _ in range(2):
        found = process.record_track(dataclasses.replace(OTHERS[0], name="nobody's"), scene, 1.0, 0.1)
        assert found == 'it failed: KeyError: "nobody\'s"'
        assert process.is_alive


def test_an_engine_that_is_missing_is_a_note(monkeypatch):
    gone = dataclasses.replace(OTHERS[0], package="no_such_package")
    monkeypatch.setitem(ENGINE_VARIANTS, gone.name, gone)
    (record,) = run(["lift"], steppers=[], engines=[gone.name], parameters={})
    assert record.note == "not installed: pip install no_such_package"
    assert not record.passed


def test_an_engine_without_what_a_scene_needs_is_a_note_and_starts_no_process(monkeypatch):
    bare = dataclasses.replace(OTHERS[0], package="", cannot={"hinge": "it has no hinges"})
    monkeypatch.setitem(ENGINE_VARIANTS, bare.name, bare)
    monkeypatch.setattr("lavender.lab.phenomena.running.ProcessBackend.start", None)  # a start would fail
    (record,) = run(["pendulum"], steppers=[], engines=[bare.name], parameters={})
    assert (record.note, record.values, record.passed) == ("it has no hinges", {}, False)


# -- engines under Node ---------------------------------------------------------------------------


class Answers:
    """In the place of the other process: what it was told to say, one answer after the other."""

    said = ()

    def __init__(self, command):
        self.command, self.left = command, list(self.said)

    def request_answer(self, message):
        assert json.loads(json.dumps(message, allow_nan=False)) == message  # a line of JSON
        return self.left.pop(0)

    def close(self):
        self.left = None


@pytest.fixture
def under_node(monkeypatch, tmp_path):
    from lavender.lab.phenomena.engines import node

    for package in PACKAGES_OF_NODE.values():
        (tmp_path / package).mkdir(parents=True)
        (tmp_path / package / "package.json").write_text('{"version": "1.2.3"}')
    monkeypatch.setenv("NODE_PATH", f"{tmp_path / 'nowhere'}{os.pathsep}{tmp_path}")
    monkeypatch.setattr(node, "JsonLines", Answers)

    def made(*said):
        monkeypatch.setattr(Answers, "said", said)
        return make_engine(ENGINE_VARIANTS["rapier"], PHENOMENA["stick"].build_scene())

    return made


def test_poses_that_an_engine_under_node_loses_are_a_note(under_node):
    p = PHENOMENA["stick"]
    state = [0.0, 0.0, 0.0, 1.0, *[0.0] * 9] * 2
    lost = [*state[:13], None, *state[14:]]  # JSON has no nan
    engine = under_node(*({"cpu": 0.5, "state": x} for x in (state, state, lost)))
    track = record_track(engine, 3 / 60, 1 / 60)
    assert len(track.time) == 3  # it ends with what is not finite
    assert track.cpu == pytest.approx(1.0 / (2 / 60))  # of the other process, without what building took
    assert "not finite from 0.0333 s" in measure_track(p, "rapier", p.complete_parameters(), track).note


def test_what_an_engine_under_node_says_is_told(under_node):
    with pytest.raises(lv.CapabilityError, match="no such shape"):
        under_node({"cannot": "no such shape"})
    with pytest.raises(LavenderError, match="unreachable"):
        under_node({"error": "unreachable"})


def test_packages_of_node_are_found_or_what_to_install_is_said(under_node, monkeypatch, tmp_path):
    monkeypatch.setattr("lavender.lab.phenomena.engines.shutil.which", lambda name: name)
    assert ENGINE_VARIANTS["rapier"].explain_missing() == ""
    assert get_npm_versions() == dict.fromkeys(PACKAGES_OF_NODE.values(), "1.2.3")
    monkeypatch.delenv("NODE_PATH")
    monkeypatch.chdir(tmp_path)
    assert "not installed: npm install jolt-physics" in ENGINE_VARIANTS["jolt"].explain_missing()
    with pytest.raises(LavenderError, match="npm install @dimforge/rapier3d-compat"):
        under_node()
    monkeypatch.setattr("lavender.lab.phenomena.engines.shutil.which", lambda name: None)
    assert "under Node" in ENGINE_VARIANTS["jolt"].explain_missing()


def test_a_program_is_asked_by_lines_and_its_end_is_told():
    echo = "import sys\nfor line in sys.stdin:\n    if '7' in line: sys.exit(3)\n    print(line, flush=True, end='')"
    program = JsonLines([sys.executable, "-c", echo])
    try:
        assert program.request_answer({"a": [1.5, "ü"]}) == {"a": [1.5, "ü"]}
        with pytest.raises(EOFError, match="status 3"):
            program.request_answer(7)
    finally:
        program.close()
    sleeper = "import os, time; input(); print(os.getpid(), flush=True); time.sleep(60)"
    program = JsonLines([sys.executable, "-c", sleeper])
    pid = program.request_answer({})
    program.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_stepper_that_does_not_take_a_scene_is_a_note_and_the_others_go_on():
    found = run(["spin_down"], steppers=["xpbd", "impulses"], parameters={})
    notes = {r.engine: r.note for r in found}
    assert "torsional friction" in notes["xpbd"]
    assert not notes["impulses"]


@pytest.mark.parametrize("limit", [math.nan, 0.0, -1.0, "long"])
def test_a_limit_that_is_none_is_refused(limit):
    with pytest.raises(lv.InputError, match="limit"):
        run(["stick"], steppers=["impulses"], limit=limit)


def test_names_of_engine_variants():
    assert [p.name for p in select_phenomena(["stick", "stop", "stick"])] == ["stick", "stop"]
    assert {w.name for w in select_variants(["soft_step"], [])} == {"soft_step", "soft_step 16x4"}
    assert [w.name for w in select_variants([], ["pybullet 4x100"])] == ["pybullet 4x100"]
    assert len(select_variants()) == len(ENGINE_VARIANTS)
    with pytest.raises(lv.UnknownName, match="soft_step"):
        select_variants(["softstep"])
    with pytest.raises(lv.UnknownName, match="engine"):
        select_variants([], ["impulses"])


# -- the table and the command --------------------------------------------------------------------


def test_the_table_has_worst_values_cases_out_of_bounds_and_reasons():
    case = {"mu": 0.5, "slope": 0.9}
    found = [
        Record("stick", "impulses", case, {"creep": 0.02}),
        Record("stick", "soft_step", case, {"creep": 1e-9}, passed=True),
        Record("stick", "drake", case, note="it has no cause"),
    ]
    text = tables.format_markdown_table(found)
    assert "| impulses | **0.02 m/s, 0/1** |" in text
    assert "| soft_step | 1.0e-09 m/s, 1/1 |" in text
    assert "| drake | – |" in text
    assert tables.list_out_of_bound_cases(found) == [
        "stick, impulses: 1 of 1 cases out, creep 0.02 m/s (bound 1.0e-06 m/s); within it: soft_step"
    ]
    assert tables.list_notes(found) == ["drake: stick: it has no cause"]
