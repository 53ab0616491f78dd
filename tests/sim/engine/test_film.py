"""Films of a run: what was stepped is what is kept, served and painted."""

import json
import pickle
import shutil
import threading
import urllib.error
import urllib.request

import numpy as np
import pytest

import lavender as lv
from lavender.sim.engine import Film
from lavender.sim.engine import film as films
from lavender.sim.engine.picture import save_picture


def run(sim, steps):
    return [sim.step()[0] for _ in range(steps)]


def test_a_film_holds_every_step_and_its_file_the_same():
    scene = lv.Scene("bridge", n=4)
    sim, twin = lv.Simulation(scene), lv.Simulation(scene)
    film = sim.film(30)
    seen = run(twin, 30)
    assert (sim.steps, len(film), film.ended) == (30, 31, True)
    for i, observation in enumerate(seen):
        np.testing.assert_array_equal(film.positions[i + 1], observation["positions"].astype(np.float32))
        np.testing.assert_array_equal(film.quaternions[i + 1], observation["quaternions"].astype(np.float32))
        np.testing.assert_array_equal(film.solver[i + 1], observation["solver"].astype(np.float32))
    np.testing.assert_allclose(film.time, np.arange(31) / 120, rtol=1e-6)
    sim.step()
    assert len(film) == 31  # it has ended


def test_files_lead_back_and_what_is_no_film_is_refused(tmp_path):
    film = lv.Simulation("pile").film(5)
    path = tmp_path / "pile.film"
    film.save(path)
    for back in (Film.load(path), pickle.loads(pickle.dumps(film))):
        assert back.header == film.header and back.ended
        np.testing.assert_array_equal(back.frames(), film.frames())
    data = path.read_bytes()
    head = len(films.MAGIC) + 8 + int.from_bytes(data[len(films.MAGIC) : len(films.MAGIC) + 8], "little")
    for bad in (
        b"",
        b"no film",
        data[:30],
        data[:-4],
        data[:head] + b"\0\0\xc0\x7f" * ((len(data) - head) // 4),  # NaN
        films.MAGIC + (5).to_bytes(8, "little") + b"[[[[[",
        films.MAGIC + (2**62).to_bytes(8, "little"),
        films.MAGIC + (12).to_bytes(8, "little") + b'{"version":1}',
        films.MAGIC + (200_000).to_bytes(8, "little") + b"[" * 200_000,
    ):
        path.write_bytes(bad)
        with pytest.raises(lv.InputError, match="film"):
            Film.load(path)


def test_the_film_of_a_run_that_was_lost_can_be_read_and_drawn(tmp_path):
    simulation = lv.Simulation("stack")
    film = simulation.start_film()
    simulation.step()
    simulation.state.a["v"][2, 0] = np.inf
    simulation.step()
    film.save(tmp_path / "lost.film")
    assert len(Film.load(tmp_path / "lost.film")) == len(film) == 2  # what was finite
    assert save_picture(film, tmp_path / "lost.png", frames=1).is_file()


def test_a_long_film_drops_every_other_frame_and_keeps_its_end(monkeypatch):
    monkeypatch.setattr(films, "MAX_FILM_BYTES", 64 * 4 * (9 + 7 * 3))
    sim = lv.Simulation(lv.Scene("heavy_on_light"))
    film = sim.film(1000)
    assert film.frames().nbytes <= films.MAX_FILM_BYTES
    assert film.stride == 16
    steps = np.rint(film.time * 120).astype(int)
    np.testing.assert_array_equal(steps, np.arange(len(steps)) * film.stride)
    assert steps[-1] > 1000 - film.stride


def get(viewer, path, **headers):
    request = urllib.request.Request(viewer.address.replace("view.html", path), headers=headers)
    with urllib.request.urlopen(request, timeout=600) as answer:
        return answer.read(), answer.headers


def test_the_page_gets_the_frames_as_they_come():
    sim = lv.Simulation("bridge")
    with sim.view(browser=False) as viewer:
        assert viewer.address.startswith("http://127.0.0.1:")
        header = json.loads(get(viewer, "film.json")[0])
        assert len(header["bodies"]) == 17 and all(joint["body"] >= 0 for joint in header["joints"])
        first, more = get(viewer, "frames?from=0&stride=1")
        width = 9 + 7 * 17
        assert len(first) == 4 * width and (more["X-First"], more["X-Ended"]) == ("0", "0")
        expected = run(sim, 7)
        rest, more = get(viewer, "frames?from=1&stride=1")
        rest = np.frombuffer(rest, "<f4").reshape(7, width)
        assert more["X-First"] == "1"
        for row, observation in zip(rest, expected, strict=True):
            np.testing.assert_array_equal(row[9:].reshape(-1, 7)[:, :3], observation["positions"].astype("f4"))
        beside = ("../film.py", "none", "%00", "a%00b/", "%ff", "x" * 5000)
        for path in ("frames?from=-1", "frames?from=x", *beside):
            with pytest.raises(urllib.error.HTTPError):
                get(viewer, path)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            get(viewer, "film.json", Host="example.org")
        assert b"view.js" in get(viewer, "view.html")[0]
        viewer.film.ended = True
        assert get(viewer, "frames?from=8&stride=1")[1]["X-Ended"] == "1"
    sim.step()
    assert len(viewer.film) == 8  # nobody looks any more
    viewer.close()


def test_a_port_that_is_taken_is_refused_and_nothing_is_filmed():
    sim = lv.Simulation("spinner")
    with sim.view(browser=False) as viewer:
        port = int(viewer.address.split(":")[2].split("/")[0])
        with pytest.raises(lv.InputError, match=f"port {port}"):
            sim.view(port=port, browser=False)
        assert len(sim.films) == 1
    assert sim.films == []


@pytest.mark.parametrize(("dt", "rate"), [(1 / 7, 20), (1 / 240, 15)])
def test_a_gif_takes_the_time_of_its_film_and_is_480_pixels_wide(dt, rate, tmp_path):
    image = pytest.importorskip("PIL.Image")
    film = lv.Simulation(lv.Scene("stack", n=1, dt=dt)).film(round(0.4 / dt))
    shown = 0.0
    with image.open(save_picture(film, tmp_path / "a.gif", rate=rate)) as found:
        assert found.size[0] >= 480
        for i in range(found.n_frames):
            found.seek(i)
            shown += 1e-3 * found.info["duration"]
    # the last frame stands for one more, and the grid of frames ends within one of the film's end
    assert shown == pytest.approx(film.time[-1] - film.time[0], abs=2.0 / rate)


def test_an_mp4_needs_ffmpeg(tmp_path, monkeypatch):
    film = lv.Simulation(lv.Scene("stack", n=1)).film(3)
    if shutil.which("ffmpeg"):
        assert save_picture(film, tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"
    monkeypatch.setenv("PATH", "")
    with pytest.raises(lv.InputError, match="needs ffmpeg"):
        save_picture(film, tmp_path / "b.mp4")


@pytest.mark.parametrize("suffix", [".png", ".svg", ".gif"])
def test_pictures_of_every_scene_with_spheres_boxes_and_joints(suffix, tmp_path):
    more = {".png": {"n": 6, "kind": "mixed"}, ".svg": {}, ".gif": {}}[suffix]
    path = tmp_path / f"drawn{suffix}"
    sim = lv.Simulation(lv.Scene("pile" if more else "newtons_cradle", **more))
    assert sim.frames(path, steps=4, frames=2, size=2.0) == path
    assert path.read_bytes().startswith({".png": b"\x89PNG", ".svg": b"<?xml", ".gif": b"GIF8"}[suffix])
    assert list(tmp_path.iterdir()) == [path]  # no part is left


def test_a_body_is_painted_where_it_is():
    # a ball alone, seen from the front: where it is dark in the picture is where it is in the film
    from matplotlib.figure import Figure

    from lavender.sim.engine.picture import FilmView

    scene = lv.Scene(gravity=0.0)
    scene.add_sphere(0.5, position=(0, 0, 0), velocity=(2.0, 0, 0))
    film = lv.Simulation(scene).film(60)
    stage = FilmView(film, 0.0, 0.0)
    axes = Figure().subplots()
    for frame in (0, 60):
        stage.paint(axes, frame)
        (ball,) = axes.patches
        assert ball.center == pytest.approx((frame / 60, 0.0), abs=1e-5)
        assert ball.radius == 0.5
    assert stage.bounds == pytest.approx((-0.87, 1.87, -0.87, 0.87), abs=0.01)


def test_pictures_refuse_what_they_cannot_do(tmp_path):
    film = lv.Simulation("spinner").film(2)
    wrong = ({"frames": 0}, {"rate": 0}, {"size": "wide"}, {"turn": float("nan")}, {"frames": True})
    for bad in ({"path": "x.txt"}, *({"path": "x.png", **more} for more in wrong)):
        with pytest.raises(lv.InputError):
            save_picture(film, tmp_path / bad.pop("path"), **bad)


def test_a_film_may_be_read_while_another_thread_steps():
    sim = lv.Simulation("stack")
    film = sim.start_film()
    worker = threading.Thread(target=run, args=(sim, 300))
    worker.start()
    lengths = []
    while worker.is_alive():
        lengths.append(len(film.frames()))
    worker.join()
    sim.end_film(film)
    assert lengths == sorted(lengths) and len(film) == 301
