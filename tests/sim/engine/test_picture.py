"""The film of a run: a point of the picture is the projection of a point of the world."""

import numpy as np
from PIL import Image

import lavender as lv
from lavender.sim.engine.picture import Film


def test_film_of_a_moving_ball_shows_its_projected_path(tmp_path):
    """The ball's diameter of 1 m gives the scale in pixels; its centre moves by (4, -1, 2) m."""
    scene = lv.Scene()
    scene.add_sphere(0.5)
    film = Film(lv.Simulation(scene))
    path = np.array([4.0, -1.0, 2.0])
    for time in (0.02, 0.04, 0.06, 0.08):  # The first and the third are before the next frame.
        film.add(time, path[None] * (time / 0.08), np.array([[1.0, 0.0, 0.0, 0.0]]))
    film.add(0.12, np.full((1, 3), np.nan), np.array([[1.0, 0.0, 0.0, 0.0]]))
    film.save(tmp_path / "ball.gif")
    centres = []
    with Image.open(tmp_path / "ball.gif") as pictures:
        assert pictures.n_frames == 3
        for k in range(3):
            pictures.seek(k)
            colors = np.asarray(pictures.convert("RGB"), float)
            rows, columns = np.nonzero(
                colors.max(axis=2) - colors.min(axis=2) > 40.0
            )  # The title is grey.
            centres.append([columns.mean(), -rows.mean()])
            diameter = np.ptp(columns) + 1.0
    turn, tilt = 0.45, 0.22
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    top = np.array([-np.sin(turn) * np.sin(tilt), np.cos(turn) * np.sin(tilt), np.cos(tilt)])
    for moved, part in ((centres[1], 0.5), (centres[2], 1.0)):
        expected = part * np.array([right @ path, top @ path])
        # The outline of the ball is half a line wider than the ball: 3 % of the diameter, and a pixel of rounding.
        np.testing.assert_allclose((np.array(moved) - centres[0]) / diameter, expected, rtol=0.05)
