"""The page in a real browser without a window: what it shows is what the native kernels compute."""

import numpy as np
import pytest
from newton_steps import NewtonSteps

import lavender as lv
from lavender.sim.engine import SOLVER_FIELDS
from lavender.sim.scene import SCENES as SCENES_OF_GALLERY
from lavender.sim.scene.parts import rotation
from lavender.sim.web.scenes import EXPERIMENTS, PRESETS

pytestmark = pytest.mark.slow  # the module is the same whatever checks the native kernels are built with

WHOLE = ("iterations", "warm_start", "contacts", "cache_matches")


def native(scene, steps, **parameters):
    """The eight values of the last of `steps` steps."""
    simulation = lv.Simulation(lv.Scene(scene, **parameters))
    for _ in range(steps):
        observation = simulation.step()[0]
    return observation["solver"].tolist()


def as_shown(values):
    """How the page writes them: whole numbers and zeros as they are, else six digits."""
    return [
        str(int(v)) if field in WHOLE or v == 0 else f"{v:.5e}"
        for field, v in zip(SOLVER_FIELDS, values, strict=True)
    ]


def readable(text):
    # JavaScript writes 1.5e-4 where Python writes 1.5e-04.
    head, e, power = text.partition("e")
    return f"{head}e{int(power):+03d}" if e else head


def test_120_steps_show_the_native_numbers(visit):
    v = visit("#pyramid")
    assert v.page.locator("#scene").input_value() == "pyramid"
    v.page.click("#second")
    assert v.page.locator("#clock").text_content() == "1.000 s, step 120"
    for i, warm in enumerate((True, False)):
        exact, shown = v.values(i)
        expected = native("pyramid", 120, warm_start=warm)
        assert exact == expected
        assert [readable(text) for text in shown] == as_shown(expected)


def test_settings_of_each_side_are_the_native_ones(visit):
    v = visit("#pyramid")
    v.side(0).locator(".sweeps input").fill("40")
    v.side(0).locator(".order").select_option(label="top down")
    v.side(1).locator(".sweeps input").fill("4")
    v.side(0).locator(".warm input").uncheck()
    v.side(1).locator(".warm input").check()
    v.side(1).locator(".order").select_option(label="random")
    v.side(1).locator(".box input").check()
    assert v.js("location.hash").split("&b=")[1].startswith("4,warm,random,box")
    assert v.side(0).locator(".sweeps output").text_content() == "40"
    for _ in range(3):
        v.page.click("#step")
    v.page.click("#reset")  # settings stay
    for _ in range(5):
        v.page.click("#step")
    cold = {"warm_start": False, "order": "top_down", "solver_iterations": 40}
    assert v.values(0)[0] == native("pyramid", 5, **cold)
    assert v.values(1)[0] == native("pyramid", 5, order="random", solver_iterations=4, friction_shape="box")


def test_plots_hold_the_native_errors(visit):
    v = visit()
    for _ in range(10):
        v.page.click("#step")
    simulation = lv.Simulation("stack")
    for _ in range(9):
        simulation.step()
    state = simulation.state.copy()
    assert state.kernel.substeps(1) == (0, 1)  # the last substep of two is watched
    assert state.kernel.prepare() == 0
    curve = np.zeros((17, 2))
    state.kernel.solve_watched(curve)
    for k, name in enumerate(("normal", "energy")):
        assert v.js(f"lavender.charts.{name}.data[0]") == list(range(17))
        assert v.js(f"lavender.charts.{name}.data[1]") == curve[:, k].tolist()
    matched = v.js("lavender.charts.contacts.data")
    assert matched[1] == [24] * 10  # made, A
    assert matched[3] == [24] * 10  # matched, A: the first substep of all found none
    assert matched[4] == [0] * 10  # matched, B: no warm start
    assert v.js("lavender.charts.settings.data")[3] == [16] * 10


def test_a_run_of_its_own_shows_one_step_when_it_pauses(visit):
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
    for i, warm in enumerate((True, False)):
        assert v.values(i)[0] == native("stack", steps, warm_start=warm)
    shown = v.js("lavender.charts.energy.data")
    again = visit()
    again.js(f"lavender.advance({steps})")
    assert again.js("lavender.charts.energy.data") == shown
    assert v.js("lavender.charts.residual.data[0].length") == steps


def test_restore_leads_back(visit):
    v = visit()
    v.page.keyboard.press("p")  # a push, so that there is something to differ
    v.page.click("#second")
    v.page.click("#snapshot")
    v.page.click("#second")
    first = [v.values(i)[0] for i in (0, 1)]
    v.side(0).locator(".sweeps input").fill("64")
    v.side(1).locator(".warm input").check()
    v.page.click("#second")
    assert [v.values(i)[0] for i in (0, 1)] != first
    v.page.click("#restore")
    assert v.page.locator("#clock").text_content() == "1.000 s, step 120"
    assert v.side(0).locator(".sweeps input").input_value() == "16"
    assert not v.side(1).locator(".warm input").is_checked()
    v.page.click("#second")
    assert [v.values(i)[0] for i in (0, 1)] == first


def test_keyboard_does_everything(visit):
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
        reached.add(v.js("(({ id, className, type }) => id || className || type)(document.activeElement)"))
    buttons = {"play", "step", "second", "reset", "speed", "snapshot", "restore", "push"}
    assert buttons | {"order", "range"} <= reached


def colors_in(v, i):
    return v.js(
        "(() => { const c = document.querySelectorAll('.side canvas')[" + str(i) + "];"
        "const d = new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer);"
        "return new Set(d).size; })()"
    )


def test_phone_without_network(visit):
    size = {"viewport": {"width": 360, "height": 640}, "device_scale_factor": 2}
    v = visit("#chain", **size, has_touch=True, is_mobile=True)
    v.context.set_offline(True)
    assert v.js("document.documentElement.scrollWidth") == 360
    v.page.locator("#second").tap()
    assert v.values(0)[0] == native("chain", 120)
    for name in ("#play", "#step", "#reset", "#snapshot", "#push"):
        box = v.page.locator(name).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["height"] >= 32
    assert all(colors_in(v, i) > 10 for i in (0, 1))  # background, faces, edges, marks: something is drawn


def test_a_page_that_cannot_start_says_so(new_page, address):
    page = new_page()
    page.route("**/scenes.json", lambda route: route.fulfill(body="{", content_type="application/json"))
    page.goto(address)
    page.wait_for_selector("#failure:not([hidden])")
    assert page.locator("#failure").text_content().startswith("The page could not start")


def test_a_lost_state_is_named(visit):
    v = visit()
    v.js("lavender.sides[1].simulation.array('v')[6] = Infinity")
    v.page.click("#second")
    assert "Side B: the state of" in v.page.locator("#failure").text_content()
    v.page.click("#reset")
    assert v.page.locator("#failure").is_hidden()


def test_it_opens_moving_with_two_settings_that_make_the_point(visit):
    v = visit("")
    _, title, scene, (one, two), note, _ = PRESETS[0]
    assert v.page.locator("#scene").input_value() == scene
    assert v.page.locator("#note").text_content() == note
    assert v.page.locator("#play").get_attribute("aria-pressed") == "true"
    assert v.page.locator("#presets button[aria-pressed=true]").text_content() == title
    assert v.side(0).locator(".warm input").is_checked() == one.warm_start
    assert v.side(1).locator(".warm input").is_checked() == two.warm_start
    v.page.wait_for_function("lavender.steps > 3")
    v.page.keyboard.press(" ")
    v.page.click("#reset")  # a slow machine is at any step by now
    v.js("lavender.advance(300)")
    gaps = v.js("lavender.sides.map((side) => side.gap())")
    assert gaps == [
        pytest.approx(native_gap(scene, 300, s.iterations, s.warm_start), rel=1e-9) for s in (one, two)
    ]
    assert gaps[1] > 5.0 * gaps[0]  # the sentence says that links part
    caption = v.page.locator("#caption").text_content()
    assert caption == "A's joints are open by {}, B's by {}".format(*(said(v, x) for x in gaps))


def test_joints_have_values_too(visit):
    v = visit("#chain")
    v.page.click("#second")
    for i, warm in enumerate((True, False)):
        simulation = lv.Simulation(lv.Scene("chain", warm_start=warm))
        for _ in range(120):
            observation = simulation.step()[0]
        impulse, opened = (
            float(v.side(i).locator(f"td[data-field='{name}']").get_attribute("data-value"))
            for name in ("joint impulse", "joints open")
        )
        assert impulse == np.abs(observation["joint_impulses"]).max() > 0.0
        assert opened == pytest.approx(native_gap("chain", 120, simulation.solver_iterations, warm), rel=1e-9)
    v.page.select_option("#scene", "stack")
    assert v.side(0).locator("td[data-field='joints open']").is_hidden()


def said(v, x):
    return v.js(f"import('./app.js').then((module) => module.length({x!r}))")


def native_gap(scene, steps, iterations, warm_start):
    """Largest distance between the ends of a ball joint after some steps."""
    simulation = lv.Simulation(lv.Scene(scene, solver_iterations=iterations, warm_start=warm_start))
    for _ in range(steps):
        observation = simulation.step()[0]
    most = 0.0
    for joint in simulation.scene.joints:
        ends = []
        for body, local in ((joint.a, joint.anchor_a), (joint.b, joint.anchor_b)):
            turn = np.eye(3) if body < 0 else rotation(observation["quaternions"][body])
            ends.append(turn @ local + (0.0 if body < 0 else observation["positions"][body]))
        most = max(most, float(np.linalg.norm(ends[1] - ends[0])))
    return most


def test_reduced_motion_opens_at_rest(visit):
    v = visit("", reduced_motion="reduce")
    assert v.page.locator("#play").get_attribute("aria-pressed") == "false"


@pytest.mark.parametrize("preset", PRESETS, ids=lambda preset: preset[0])
def test_presets_set_everything_and_are_part_of_the_address(visit, preset):
    _, title, scene, sides, note, _ = preset
    v = visit()
    v.page.get_by_role("button", name=title, exact=True).click()
    v.page.keyboard.press("Escape")
    v.js("lavender.play(false)")
    v.js("lavender.choose(lavender.scene.name)")
    assert v.page.locator("#scene").input_value() == scene
    assert v.page.locator("#note").text_content() == note
    v.page.wait_for_function("!lavender.waiting")
    v.js("lavender.advance(30)")
    displaced = v.js("lavender.sides.map((side) => side.displacement())")
    for i, side in enumerate(sides):
        values, moved = run(scene, 30, **side._asdict())
        assert v.values(i)[0] == values
        assert displaced[i] == pytest.approx(moved, abs=1e-12)


def medians(number, side):
    """Of the native engine, the median that a line of an experiment shows."""
    settings = {"warm_start": side.warm_start, "order": side.order}
    if side.solver == "newton":
        steps_of = NewtonSteps("stack", **settings)
        values = [steps_of.step() for _ in range(number.last)]
    else:
        settings["solver_iterations"] = side.iterations
        if number.last == 0:
            one_solve = lv.Simulation(lv.Scene("stack", dt=1 / 240, substeps=1, **settings))
            return one_solve.step()[0]["solver"][SOLVER_FIELDS.index(number.field)]
        simulation = lv.Simulation(lv.Scene("stack", **settings))
        values = [simulation.step()[0]["solver"] for _ in range(number.last)]
    return np.median(np.array(values)[number.first :, SOLVER_FIELDS.index(number.field)])


@pytest.mark.parametrize(
    ("preset", "phone"),
    [
        *((preset, {}) for preset in EXPERIMENTS),
        (EXPERIMENTS[0], {"viewport": {"width": 390, "height": 844}}),
    ],
)
def test_an_experiment_opens_by_its_link_and_tells_its_numbers(visit, preset, phone):
    v = visit("#" + preset.name, **phone)
    assert v.page.locator("#experiments button[aria-pressed=true]").text_content() == preset.title
    assert v.page.locator("#note").text_content() == preset.note
    v.js("lavender.play(false)")
    v.page.click("#reset")
    v.page.wait_for_function("!lavender.waiting")
    assert v.page.locator("#numbers").is_visible()
    v.js("lavender.advance(240)")
    lines = v.page.locator("#numbers tbody tr").all()
    assert len(lines) == len(preset.numbers) > 0
    for line, number, seen in zip(lines, preset.numbers, v.js("lavender.seen"), strict=True):
        a, b = (medians(number, side) for side in preset.sides)
        assert [seen["a"], seen["b"]] == [a, b]
        assert number.text in line.text_content()
        if number.over:
            ratio = a / b if number.over == "AB" else b / a
            shown = float(line.text_content().rsplit("= ")[1])
            assert shown == pytest.approx(ratio, rel=6e-3 if ratio < 1000 else 0.5)  # three digits, or one
    assert v.js("document.documentElement.scrollWidth <= innerWidth")
    pressed = v.page.locator("#experiments button[aria-pressed=true]").bounding_box()
    assert 0 <= pressed["x"] < pressed["x"] + pressed["width"] <= v.js("innerWidth")


def test_numbers_of_an_experiment_are_of_an_undisturbed_run(visit):
    v = visit("#experiment=4")
    v.js("lavender.play(false)")
    v.page.click("#reset")
    v.js("lavender.advance(30)")
    v.page.click("#push")
    v.js("lavender.advance(300)")
    first, *later = v.js("lavender.seen")
    assert first is not None and later == [None, None]
    v.page.click("#reset")
    v.js("lavender.advance(240)")
    assert None not in v.js("lavender.seen")
    v.page.select_option("#scene", "pyramid")
    assert v.page.locator("#numbers").is_hidden()


def run(scene, steps, iterations, solver="sweeps", **settings):
    """The eight values of the last step, and how far a body is from its start at most: sideways, and below it."""
    if solver == "newton":
        steps_of = NewtonSteps(scene, **settings)
        simulation = steps_of.simulation
        for _ in range(steps):
            values = steps_of.step().tolist()
        positions = steps_of.state.a["x"].reshape(-1, 3)
    else:
        settings.setdefault("order", "given")
        simulation = lv.Simulation(lv.Scene(scene, solver_iterations=iterations, **settings))
        for _ in range(steps):
            observation = simulation.step()[0]
        values, positions = observation["solver"].tolist(), observation["positions"]
    moved = positions - np.array([body.position for body in simulation.scene.bodies])
    return values, [float(np.hypot(*moved[:, :2].T).max()), float(max(-moved[:, 2].min(), 0.0))]


def test_the_module_of_newton_is_fetched_when_it_is_asked_for(visit):
    v = visit("#scene=bridge&a=16,warm,given&b=16,warm,given&play=0")
    assert not any(url.endswith("newton.wasm") for url in v.requests)
    v.side(0).locator(".solver").select_option("newton")
    v.page.wait_for_function("!lavender.waiting")
    assert sum(url.endswith("newton.wasm") for url in v.requests) == 1
    assert v.side(0).locator(".sweeps input").is_disabled()
    v.side(1).locator(".solver").select_option("newton")
    v.page.click("#reset")
    v.page.wait_for_function("!lavender.waiting")
    assert sum(url.endswith("newton.wasm") for url in v.requests) == 1
    assert (
        v.js("location.hash") == "#scene=bridge&a=16,warm,given,newton&b=16,warm,given,newton&speed=1&play=0"
    )
    v.js("lavender.advance(20)")
    twin = NewtonSteps("bridge")
    for _ in range(20):
        values = twin.step().tolist()
    assert v.values(0)[0] == v.values(1)[0] == values
    short = sum(how == 0 for how in twin.ended)
    told = v.side(0).locator(".told").text_content()
    assert told.endswith(f"{short} of {len(twin.ended)} solves short of 1e-6")
    assert v.js("lavender.charts.energy.data[0]") == twin.trace[:, 0].tolist()
    assert v.js("lavender.charts.energy.data[1]") == twin.trace[:, 1].tolist()
    v.side(1).locator(".solver").select_option("sweeps")
    v.page.click("#reset")
    v.js("lavender.advance(2)")
    assert v.values(1)[0] == native("bridge", 2)


def test_without_the_module_of_newton_both_sides_sweep(new_page, address):
    page = new_page()
    page.route("**/newton.wasm", lambda route: route.fulfill(status=404))
    page.goto(address + "#newton-against-sweeps")
    page.wait_for_selector("#failure:not([hidden])")
    assert "could not be loaded" in page.locator("#failure").text_content()
    assert page.locator(".solver").first.input_value() == "sweeps"
    page.wait_for_function("lavender.steps > 3")


def test_the_address_holds_every_setting_and_is_followed(visit):
    v = visit("#scene=pyramid&a=8,cold,top_down&b=40,warm,random&speed=0.25&play=0")
    assert v.page.locator("#scene").input_value() == "pyramid"
    assert v.page.locator("#speed").input_value() == "0.25"
    v.js("lavender.advance(3)")
    assert v.values(0)[0] == native("pyramid", 3, solver_iterations=8, warm_start=False, order="top_down")
    assert v.values(1)[0] == native("pyramid", 3, solver_iterations=40, order="random")
    v.side(0).locator(".sweeps input").fill("12")
    v.side(1).locator(".warm input").uncheck()
    v.page.locator("#speed").select_option("0.05")
    assert v.js("location.hash") == "#scene=pyramid&a=12,cold,top_down&b=40,cold,random&speed=0.05&play=0"
    v.js("location.hash = '#scene=table&a=5,warm,given&b=6,warm,given&play=1'")
    v.page.wait_for_function("lavender.scene.name === 'table' && lavender.playing")
    assert v.side(0).locator(".sweeps output").text_content() == "5"
    v.js("location.hash = '#no such scene'")
    v.page.wait_for_function("lavender.scene.name === 'stack'")
    assert v.page.text_content("#failure") == 'There is no scene "no such scene": this is stack.'
    v.js("location.hash = '#half%'")  # that encodes nothing
    v.page.wait_for_function("document.querySelector('#failure').textContent.includes('half%')")
    v.js("location.hash = '#pyramid'")
    v.page.wait_for_function("lavender.scene.name === 'pyramid'")
    assert v.page.locator("#failure").is_hidden()
    v.js("location.hash = '#scene=stack&a=1000,x,y&b='")  # senseless values leave what was set
    v.page.wait_for_function("!lavender.playing")
    assert v.side(0).locator(".sweeps output").text_content() == "5"


def test_every_scene_of_the_gallery_runs_and_is_captioned(visit):
    v = visit()
    names = v.js("lavender.contents.scenes.map((scene) => scene.name)")
    gallery = (
        name for name, build in SCENES_OF_GALLERY.items() if build.__module__ == "lavender.sim.scene.gallery"
    )
    assert sorted(names) == sorted(gallery)
    for name in names:
        v.page.locator("#scene").select_option(name)
        v.js("lavender.advance(2)")
        assert v.values(0)[0] == native(name, 2)
        assert v.page.locator("#caption").text_content() != ""


def test_a_body_can_be_pulled_at_and_both_sides_are_pulled_alike(visit):
    v = visit("#scene=heavy_on_light&a=16,warm,given&b=16,warm,given")
    box = v.side(0).locator("canvas").bounding_box()
    upper = v.js("lavender.sides[0].view.places.find((place) => place.body === 2).middle")
    start = v.js("Array.from(lavender.sides[0].simulation.array('x').slice(6, 9))")
    x, y = box["x"] + upper[0], box["y"] + upper[1]
    v.page.mouse.move(x, y)
    v.page.mouse.down()
    v.page.mouse.move(x, y - 60, steps=4)
    v.js("lavender.advance(240)")
    ends = [v.js(f"Array.from(lavender.sides[{i}].simulation.array('x').slice(6, 9))") for i in (0, 1)]
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


def test_panels_with_nothing_to_show_give_way(visit):
    v = visit("#chain")
    v.page.click("#second")
    hidden = {name: v.page.locator(f"#chart-{name}").is_hidden() for name in ("energy", "normal", "contacts")}
    assert hidden == {"energy": False, "normal": True, "contacts": True}
    v.page.locator("#scene").select_option("stack")
    v.page.click("#second")
    assert v.page.locator("#chart-contacts").is_visible()
    width = v.js("lavender.charts.contacts.plot.width")
    assert width == v.js("document.querySelector('#chart-contacts').clientWidth")
    assert v.page.locator("figure .legend").first.text_content() == "AB"


def test_a_run_is_shown_live_and_again(visit):
    simulation = lv.Simulation("bridge")
    with simulation.view(browser=False) as viewer:
        v = visit("", viewer.address, viewport={"width": 1200, "height": 800})
        for _ in range(60):
            simulation.step()
        v.page.wait_for_function("lavender.frames.length === 61")
        assert v.page.text_content("#clock") == "0.500 s, frame 61 of 61"
        shown = v.js("Array.from(lavender.state.array('x'))")
        assert shown == simulation.state.a["x"].astype(np.float32).ravel().tolist()
        # something is painted, in the middle of the picture and not at its edge
        painted = """(() => {
            const c = document.querySelector("canvas");
            const colors = new Uint32Array(c.getContext("2d").getImageData(0, 0, c.width, c.height).data.buffer);
            return [new Set(colors).size, new Set(colors.subarray(0, 2 * c.width)).size];
        })()"""
        everywhere, edge = v.js(painted)
        assert everywhere > 20 and edge == 1
        v.page.evaluate("lavender.seek(10)")
        assert v.page.text_content("#clock") == "0.083 s, frame 11 of 61"
        viewer.film.ended = True
        v.page.wait_for_function("document.querySelector('#live').disabled")
        for width in (1200, 420):
            v.page.set_viewport_size({"width": width, "height": 800})
            assert v.js("document.documentElement.scrollWidth") <= width
        _open_files(v, viewer.film.to_bytes())


def _open_files(v, film):
    """A film, and what is none: that is said, and what is shown stays."""
    head = film.index(b"{")
    length = int.from_bytes(film[head - 8 : head], "little")
    of = film[:head], film[head : head + length], film[head + length :]

    def changed(old, new):
        return of[0] + of[1].replace(old, new.ljust(len(old))) + of[2]

    wrong = {
        "empty": b"", "torn": film[:-2], "frame": film[:-4], "word": b"x" + film[1:], "text": changed(b'{"', b"{{"),
        "version": changed(b'"version": 1', b'"version": 9'), "bodies": changed(b'"bodies"', b'"b"'),
        "number": film[:-4] + np.float32(np.nan).tobytes(), "head": film[: head + 5],
    }  # fmt: skip
    for name, data in wrong.items():
        v.page.set_input_files("#file", {"name": name, "mimeType": "", "buffer": data})
        v.page.wait_for_function(
            f"document.querySelector('#failure').textContent.startsWith('{name} is no film')"
        )
        assert v.js("lavender.frames.length") == 61
    v.page.set_input_files("#file", {"name": "film", "mimeType": "", "buffer": film[: -len(of[2]) // 61]})
    v.page.wait_for_function("document.querySelector('#failure').hidden && lavender.frames.length === 60")
