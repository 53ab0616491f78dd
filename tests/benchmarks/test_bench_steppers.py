"""Steppers against a reference, and films of phenomena: `python -m benchmarks steppers` and `film`."""

import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks import film, steppers
from lavender.lab.phenomena import PHENOMENA, Track


@pytest.mark.parametrize("suffix", ["gif", "png"])
def test_a_film_shows_engines_beside_each_other(suffix, tmp_path):
    image = pytest.importorskip("PIL.Image")
    sizes = []
    for names in ("impulses newton", "impulses newton,soft_step 16x4"):
        path = tmp_path / f"film.{suffix}"
        words = ["lift", str(path), "--steppers", names, "--set", "speed=1", "--magnify", "10"]
        done = CliRunner().invoke(film.command, words)
        assert done.exit_code == 0, done.output
        with image.open(path) as found:
            sizes.append(found.size)
    side = 0 if suffix == "gif" else 1  # a strip has a row for each
    assert sizes[1][side] > 1.5 * sizes[0][side]


def test_a_film_tells_distances_from_its_first_engine_magnified(tmp_path, monkeypatch):
    p = PHENOMENA["lift"]
    case = p.values({})
    scene = p.scene(case)
    t, x = np.arange(3) / 60, np.array([b.position for b in scene.bodies])
    still = Track(t, np.tile(x, (3, 1, 1)), np.tile([1.0, 0, 0, 0], (3, 2, 1)), np.zeros((3, 2, 6)))
    high = replace(still, positions=still.positions + np.array([0.0, 0.0, 0.01]))
    seen = {}
    monkeypatch.setattr(film, "save_picture", lambda films, path, **more: seen.update(films))
    film.save_film(p, case, {"a": still, "b": high}, tmp_path / "x.gif", magnify=5.0)
    np.testing.assert_allclose(seen["a"].positions, still.positions, atol=1e-6)  # a film keeps 32 bits
    np.testing.assert_allclose(seen["b"].positions[..., 2], still.positions[..., 2] + 0.05, atol=1e-6)
    with pytest.raises(lv.InputError, match="no engine"):
        film.save_film(p, case, {}, tmp_path / "x.gif")
    with pytest.raises(lv.InputError, match=r"\.gif"):
        CliRunner().invoke(film.command, ["lift", str(tmp_path / "x.txt")], catch_exceptions=False)


def test_a_reference_is_known_to_its_floor_and_steppers_come_nearer_with_substeps():
    # the block on the slope: x = g (sin - mu cos) t^2/2 is the reference's truth
    truth, floor = steppers.reference("ramp")
    assert floor < steppers.AGREE
    a = 9.81 * (math.sin(0.6) - 0.5 * math.cos(0.6))
    way = np.linalg.norm(truth[:, 1] - truth[0, 1], axis=1)
    np.testing.assert_allclose(way, 0.5 * a * (np.arange(len(way)) / 60) ** 2, atol=1e-3)
    points = steppers.measure(["ramp"], ["impulses", "soft_step", "xpbd"], [(1, 4), (16, 4)])
    for stepper in ("impulses", "soft_step", "xpbd"):
        far, near = (p.distance for p in points if p.stepper == stepper)
        assert near < 0.2 * far
    assert [p.sweeps for p in points if p.stepper == "soft_step"] == [5, 5]  # relaxing sweeps count
