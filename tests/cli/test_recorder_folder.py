"""The commands that read folders take those of `lavender.io.Recorder`."""

import numpy as np

import lavender as lv


def test_commands_read_the_folder(tmp_path, lavender):
    problem = lv.Problem.lcp(np.array([[2.0, 1.0], [1.0, 2.0]]), np.ones(2))
    with lv.io.Recorder(tmp_path / "a", every=1, solver="their solver") as recorder:
        for error in (0.1, 0.2):
            recorder.add(problem, np.full(2, 1.0 / 3.0 + error))
    assert "step_000000_world_0000" in lavender("check", tmp_path / "a")[1]
    assert lavender("explain", tmp_path / "a" / recorder.files[0])[0] == 0
    arguments = ["--solvers", "pgs,newton", "--time-limit", "1", "--out", tmp_path / "page"]
    code, _, error = lavender("report", tmp_path / "a", *arguments)
    assert code == 0, error
    assert "their solver" in (tmp_path / "page" / "index.html").read_text()
