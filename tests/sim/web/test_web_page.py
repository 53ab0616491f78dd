"""The page in a real browser without a window: its numbers are the native kernels', its words those of a file.

`told.json` holds all that the page says at each stop of each tour. Whoever changes that on purpose writes it anew, by
LAVENDER_TOLD=write, and reads what changed.
"""

import json
import os
from collections import namedtuple
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pytest
from newton_steps import NewtonSteps

import lavender as lv
from lavender.sim.scene import SCENES as SCENES_OF_GALLERY
from lavender.sim.web.scenes import PRESETS_PATH, write_scene

pytestmark = (
    pytest.mark.slow
)  # the module is the same whatever checks the native kernels are built with

Side = namedtuple(
    "Side", ["iterations", "warm_start", "order", "solver"], defaults=["given", "sweeps"]
)
PRESETS = json.loads(PRESETS_PATH.read_text(encoding="utf-8"))["presets"]
for preset in PRESETS:
    preset["sides"] = [Side(**side) for side in preset["sides"]]
EXPERIMENTS = [preset for preset in PRESETS if preset["numbers"]]

GOLDEN = Path(__file__).with_name("told.json")
WARM, COLD = Side(16, True, ""), Side(16, False, "")  # in the scene's own order
TELL = """() => {
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const shown = (element) => element.checkVisibility(), text = (element) => element.textContent.trim();
  const words = (selector) => all(selector).filter(shown).map(text).join(" | ");
  return {
    address: location.hash, clock: words("#clock"), note: words("#note"), caption: words("#caption"),
    failure: words("#failure"), pressed: words("button[aria-pressed=true]"), numbers: words("#numbers tbody tr"),
    panels: all("[id^=chart-]").filter(shown).map((panel) => panel.id.slice(6)).join(" "),
    sides: all(".side").map((side) => ({
      set: all("select, input", side).map((of) => of.type === "checkbox" ? of.checked : of.value).join(" "),
      sweeps: text(side.querySelector(".sweeps output")), told: text(side.querySelector(".told")),
      values: all("td[data-field]", side).filter(shown).map((td) => `${td.dataset.field} ${text(td)}`).join(", "),
    })),
  };
}"""


def native(scene, steps, side=WARM, **settings):
    """The eight values of the last of `steps` steps."""
    settings["warm_start"] = side.warm_start
    if side.order:
        settings["order"] = side.order
    if side.solver == "newton":
        made = NewtonSteps(scene, **settings)
        return [made.step().tolist() for _ in range(steps)][-1]
    simulation = lv.Simulation(lv.Scene(scene, solver_iterations=side.iterations, **settings))
    return [simulation.step()[0]["solver"].tolist() for _ in range(steps)][-1]


def both(scene, steps, sides=(WARM, COLD)):
    return [native(scene, steps, side) for side in sides]


# Tours: generators that lead a visit from stop to stop, and give the native values of both sides there, or None.


def settings(v):
    yield v.page.click("#second") or both("pyramid", 120)
    for i, sweeps, order, warm in ((0, "40", "top down", "uncheck"), (1, "4", "random", "check")):
        v.side(i).locator(".sweeps input").fill(sweeps)
        v.side(i).locator(".order").select_option(label=order)
        getattr(v.side(i).locator(".warm input"), warm)()
    v.side(1).locator(".box input").check()
    for _ in range(3):
        v.page.click("#step")
    yield None
    v.page.click("#reset")  # settings stay
    for _ in range(5):
        v.page.click("#step")
    a = native("pyramid", 5, Side(40, False, "top_down"))
    yield a, native("pyramid", 5, Side(4, True, "random"), friction_shape="box")


def restore(v):
    v.page.keyboard.press("p")  # a push, so that there is something to differ
    v.page.click("#second")
    v.page.click("#snapshot")
    v.page.click("#second")
    first = v.js(TELL)
    v.side(0).locator(".sweeps input").fill("64")
    v.side(1).locator(".warm input").check()
    yield v.page.click("#second")
    yield v.page.click("#restore")
    v.page.click("#second")
    assert v.js(TELL) == first


def gallery(v):
    names = v.js("lavender.contents.scenes.map((scene) => scene.name)")
    made = {
        name
        for name, of in SCENES_OF_GALLERY.items()
        if of.__module__ == "lavender.sim.scene.gallery"
    }
    assert len(names) == len(made) and set(names) == made
    for name in names:
        v.page.locator("#scene").select_option(name)
        v.js("lavender.advance(2)")
        yield both(name, 2)


def joints(v):
    """Values of joints, which other scenes have not, and panels that give way where they have nothing to show."""
    yield v.page.click("#second") or both("chain", 120)
    v.page.select_option("#scene", "stack")
    yield v.page.click("#second") or both("stack", 120)
    width = v.js("lavender.charts.contacts.plot.width")
    assert width == v.js("document.querySelector('#chart-contacts').clientWidth")
    assert v.page.locator("figure .legend").first.text_content() == "AB"


def opening(v):
    """It opens moving, with two settings that make the point."""
    assert v.page.locator("#play").get_attribute("aria-pressed") == "true"
    v.page.wait_for_function("lavender.steps > 3")
    v.page.keyboard.press(" ")
    v.page.click("#reset")  # a slow machine is at any step by now
    v.js("lavender.advance(300)")
    yield both(PRESETS[0]["scene"], 300, PRESETS[0]["sides"])
    a, b = v.js("lavender.sides.map((side) => side.gap())")
    assert b > 5.0 * a  # the sentence says that links part


def presets(v):
    for preset in PRESETS:
        v.page.get_by_role("button", name=preset["title"], exact=True).click()
        v.page.keyboard.press("Escape")
        v.js("lavender.play(false)")
        v.js("lavender.choose(lavender.scene.name)")
        v.page.wait_for_function("!lavender.waiting")
        v.js("lavender.advance(30)")
        yield both(preset["scene"], 30, preset["sides"])


def address(v):
    """It holds every setting, and is followed."""
    v.js("lavender.advance(3)")
    yield both("pyramid", 3, (Side(8, False, "top_down"), Side(40, True, "random")))
    v.side(0).locator(".sweeps input").fill("12")
    v.side(1).locator(".warm input").uncheck()
    yield v.page.locator("#speed").select_option("0.05") and None
    for to, done in (
        ("#scene=table&a=5,warm,given&b=6,warm,given&play=0", "lavender.scene.name === 'table'"),
        ("#no such scene", "lavender.scene.name === 'stack'"),
        (
            "#half%",
            "document.querySelector('#failure').textContent.includes('half%')",
        ),  # that encodes nothing
        ("#scene=pyramid&play=0", "lavender.scene.name === 'pyramid'"),
        (
            "#scene=stack&a=1000,x,y&b=&play=0",
            "lavender.scene.name === 'stack'",
        ),  # leaves what was set
    ):
        v.js(f"location.hash = {to!r}")
        v.page.wait_for_function(done)
        v.js("lavender.play(false)")
        yield v.page.click("#reset")


def fetched(v):
    """The module of Newton's method is fetched when it is asked for, once."""

    def times():
        v.page.wait_for_function("!lavender.waiting")
        return sum(url.endswith("newton.wasm") for url in v.requests)

    assert times() == 0
    v.side(0).locator(".solver").select_option("newton")
    assert times() == 1 and v.side(0).locator(".sweeps input").is_disabled()
    v.side(1).locator(".solver").select_option("newton")
    v.page.click("#reset")
    assert times() == 1
    v.js("lavender.advance(20)")
    twin = NewtonSteps("bridge")
    values = [twin.step().tolist() for _ in range(20)][-1]
    yield values, values
    short = sum(how == 0 for how in twin.ended)
    told = v.side(0).locator(".told").text_content()
    assert told.endswith(f"{short} of {len(twin.ended)} solves short of 1e-6")
    assert v.js("lavender.charts.energy.data.slice(0, 2)") == twin.trace[:, :2].T.tolist()
    v.side(1).locator(".solver").select_option("sweeps")
    v.page.click("#reset")
    v.js("lavender.advance(2)")
    yield both("bridge", 2, (Side(16, True, "given", "newton"), Side(16, True)))


def disturbed(v):
    """Numbers of an experiment are of an undisturbed run."""
    v.js("lavender.play(false)")
    v.page.click("#reset")
    v.js("lavender.advance(30)")
    v.page.click("#push")
    yield v.js("lavender.advance(300)")
    first, *later = v.js("lavender.seen")
    assert first is not None and later == [None, None]
    v.page.click("#reset")
    yield v.js("lavender.advance(240)")
    assert None not in v.js("lavender.seen")
    yield v.page.select_option("#scene", "pyramid") and None


TOURS = {
    "#pyramid": settings,
    "#stack": restore,
    "#stack&gallery": gallery,
    "#chain": joints,
    "": opening,
    "#": presets,
    "#scene=pyramid&a=8,cold,top_down&b=40,warm,random&speed=0.25&play=0": address,
    "#scene=bridge&a=16,warm,given&b=16,warm,given&play=0": fetched,
    "#experiment=4": disturbed,
}


def compare_told(name, told):
    golden = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}
    if os.environ.get("LAVENDER_TOLD") == "write":
        golden[name] = told
        stops = {
            k: ",\n".join(json.dumps(x, ensure_ascii=False) for x in golden[k])
            for k in sorted(golden)
        }
        GOLDEN.write_text("{" + ",\n".join(f'"{k}": [\n{x}]' for k, x in stops.items()) + "}\n")
    for stop, (now, before) in enumerate(zip_longest(told, golden[name])):
        assert now == before, (name, stop)


@pytest.mark.parametrize("start", TOURS)
def test_web_tour_shows_native_numbers(visit, start):
    tour = TOURS[start]
    told = []
    v = visit("#stack" if start == "#stack&gallery" else "#stack" if start == "#" else start)
    for expected in tour(v):
        if expected is not None:
            assert [v.values(i)[0] for i in (0, 1)] == list(expected)
        told.append(v.js(TELL))
    compare_told(tour.__name__, told)


@pytest.mark.parametrize(
    ("preset", "phone"),
    [
        *((preset, {}) for preset in EXPERIMENTS),
        (EXPERIMENTS[0], {"viewport": {"width": 390, "height": 844}}),
    ],
)
def test_web_page_opened_by_the_link_of_an_experiment_shows_its_numbers(visit, preset, phone):
    v = visit("#" + preset["name"], **phone)
    v.js("lavender.play(false)")
    v.page.click("#reset")
    v.page.wait_for_function("!lavender.waiting")
    v.js("lavender.advance(240)")
    assert [v.values(i)[0] for i in (0, 1)] == both(preset["scene"], 240, preset["sides"])
    compare_told(preset["name"], [v.js(TELL)])
    assert v.js("document.documentElement.scrollWidth <= innerWidth")
    pressed = v.page.locator("#experiments button[aria-pressed=true]").bounding_box()
    assert 0 <= pressed["x"] < pressed["x"] + pressed["width"] <= v.js("innerWidth")


def test_open_a_written_scene_steps_as_the_native_engine_and_its_table_is_downloaded(
    visit, tmp_path
):
    scene = lv.Scene("stack", n=3, friction=0.3)
    scene.add_sphere(0.2, mass=2.0, position=(0.0, 0.0, 4.0))
    write_scene(scene, tmp_path / "three.json", title="Three boxes and a ball")
    v = visit("#stack")
    v.page.set_input_files("#file", tmp_path / "three.json")
    v.page.wait_for_function("lavender.scene.name === 'Three boxes and a ball'")
    v.js("lavender.advance(40)")
    simulation = lv.Simulation(scene)
    values = [simulation.step()[0]["solver"].tolist() for _ in range(40)]
    assert v.values(0)[0] == values[-1]
    with v.page.expect_download() as download:
        v.page.click("#download")
    table = np.genfromtxt(download.value.path(), delimiter=",", skip_header=1)
    assert table.shape == (40, 17)
    assert table[:, 1:9].tolist() == values  # the shortest text that reads back as the same number
    np.testing.assert_allclose(table[:, 0], scene.parameters.dt * np.arange(1, 41))


def test_plots_hold_the_native_errors(visit):
    v = visit()
    for _ in range(10):
        v.page.click("#step")
    simulation = lv.Simulation("stack")
    for _ in range(9):
        simulation.step()
    state = simulation.state.copy()
    assert state.kernel.run_substeps(1) == (0, 1)  # the last substep of two is watched
    assert state.kernel.prepare_substep() == 0
    curve = np.zeros((17, 2))
    state.kernel.sweep_and_record_errors(curve)
    for k, name in enumerate(("normal", "energy")):
        assert v.js(f"lavender.charts.{name}.data[0]") == list(range(17))
        assert v.js(f"lavender.charts.{name}.data[1]") == curve[:, k].tolist()
    matched = v.js("lavender.charts.contacts.data")
    assert matched[1] == [24] * 10  # made, A
    assert matched[3] == [24] * 10  # matched, A: the first substep of all found none
    assert matched[4] == [0] * 10  # matched, B: no warm start
    assert v.js("lavender.charts.settings.data")[3] == [16] * 10


def test_web_page_paused_shows_one_step(visit):
    """While it runs few steps are watched and the page follows in parts; a pause shows all of its last step."""
    v = visit()
    v.js(
        """() => {
          window.watched = 0;
          const { simulation } = lavender.sides[0], inner = simulation.stepWatched;
          simulation.stepWatched = function () { window.watched += 1; return inner.call(this); };
        }"""
    )
    v.page.click("#play")
    v.page.wait_for_function("lavender.steps > 60")
    v.page.click("#play")
    steps = v.js("lavender.steps")
    assert 0 < v.js("window.watched") < steps
    assert v.page.locator("#clock").text_content() == f"{steps / 120:.3f} s, step {steps}"
    for i, side in enumerate((WARM, COLD)):
        assert v.values(i)[0] == native("stack", steps, side)
    shown = v.js("lavender.charts.energy.data")
    again = visit()
    again.js(f"lavender.advance({steps})")
    assert again.js("lavender.charts.energy.data") == shown
    assert v.js("lavender.charts.residual.data[0].length") == steps


def test_web_page_is_controlled_by_keyboard(visit):
    v = visit()
    press = v.page.keyboard.press
    press("2")
    assert v.page.locator("#scene").input_value() == "pyramid"
    press(".")
    assert v.page.locator("#clock").text_content().endswith("step 1")
    press("w")
    assert not v.side(0).locator(".warm input").is_checked()
    press("Shift+W")
    assert v.side(1).locator(".warm input").is_checked()
    press("+")
    press("Shift+_")
    assert [v.side(i).locator(".sweeps input").input_value() for i in (0, 1)] == ["20", "12"]
    press("s")
    press(" ")
    assert v.page.locator("#play").get_attribute("aria-pressed") == "true"
    v.page.wait_for_function("lavender.steps > 3")
    press(" ")
    assert v.page.locator("#play").text_content() == "Play"
    press("r")
    assert v.page.locator("#clock").text_content().endswith("step 1")
    press("0")
    assert v.page.locator("#clock").text_content().endswith("step 0")
    turn = v.js("lavender.sides[1].view.turn")
    v.side(0).locator("canvas").focus()
    press("ArrowLeft")
    assert v.js("lavender.sides[1].view.turn") != turn  # both pictures turn together
    press("s")
    # Every control is reached by Tab alone.
    v.page.locator("#scene").focus()
    reached = set()
    for _ in range(25):
        press("Tab")
        reached.add(
            v.js("(({ id, className, type }) => id || className || type)(document.activeElement)")
        )
    buttons = {"play", "step", "second", "reset", "speed", "snapshot", "restore", "push"}
    assert buttons | {"order", "range"} <= reached


def colors_in(v, i):
    return v.js(
        "(() => { const c = document.querySelectorAll('.side canvas')[" + str(i) + "];"
        "const d = new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer);"
        "return new Set(d).size; })()"
    )


def test_web_page_runs_on_a_phone_without_network(visit):
    size = {"viewport": {"width": 360, "height": 640}, "device_scale_factor": 2}
    v = visit("#chain", **size, has_touch=True, is_mobile=True)
    v.context.set_offline(True)
    assert v.js("document.documentElement.scrollWidth") == 360
    v.page.locator("#second").tap()
    assert v.values(0)[0] == native("chain", 120)
    for name in ("#play", "#step", "#reset", "#snapshot", "#push"):
        box = v.page.locator(name).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["height"] >= 32
    assert all(
        colors_in(v, i) > 10 for i in (0, 1)
    )  # background, faces, edges, marks: something is drawn


def test_web_page_of_a_lost_state_names_it(visit):
    v = visit()
    v.js("lavender.sides[1].simulation.array('v')[6] = Infinity")
    v.page.click("#second")
    assert "Side B: the state of" in v.page.locator("#failure").text_content()
    v.page.click("#reset")
    assert v.page.locator("#failure").is_hidden()


def test_web_page_without_the_newton_module_sweeps_on_both_sides(new_page, address):
    page = new_page()
    page.route("**/newton.wasm", lambda route: route.fulfill(status=404))
    page.goto(address + "#newton-against-sweeps")
    page.wait_for_selector("#failure:not([hidden])")
    assert "could not be loaded" in page.locator("#failure").text_content()
    assert page.locator(".solver").first.input_value() == "sweeps"
    page.wait_for_function("lavender.steps > 3")


def test_web_page_pull_at_a_body_acts_on_both_sides(visit):
    v = visit("#scene=heavy_on_light&a=16,warm,given&b=16,warm,given")
    box = v.side(0).locator("canvas").bounding_box()
    upper = v.js("lavender.sides[0].view.places.find((place) => place.body === 2).middle")
    start = v.js("Array.from(lavender.sides[0].simulation.array('x').slice(6, 9))")
    x, y = box["x"] + upper[0], box["y"] + upper[1]
    v.page.mouse.move(x, y)
    v.page.mouse.down()
    v.page.mouse.move(x, y - 60, steps=4)
    v.js("lavender.advance(240)")
    ends = [
        v.js(f"Array.from(lavender.sides[{i}].simulation.array('x').slice(6, 9))") for i in (0, 1)
    ]
    assert ends[0] == ends[1]
    assert ends[0][2] > start[2] + 0.3  # lifted off
    turn = v.js("lavender.sides[0].view.turn")
    v.page.mouse.up()
    v.js("lavender.advance(240)")
    assert v.js("lavender.sides[0].simulation.array('x')[8]") < ends[0][2] - 0.2  # and falls
    assert v.js("lavender.sides[0].view.turn") == turn
    v.page.mouse.move(box["x"] + 8, box["y"] + 8)  # beside all bodies: the picture turns
    v.page.mouse.down()
    v.page.mouse.move(box["x"] + 40, box["y"] + 8)
    v.page.mouse.up()
    assert v.js("lavender.sides[1].view.turn") != turn
