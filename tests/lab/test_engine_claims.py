"""Claims of an engine against verdicts, on steps of known errors."""

import numpy as np
import pytest

import lavender as lv
from lavender.lab.claims import OUTCOMES, compare_claims
from lavender.lab.engine_scenes import step_scene

CONES = lv.Cones.contacts(0.5, tangents=1)


def step_of(errors, claimed, mass=1.0, nan=()):
    """Worlds of a body of `mass` [kg] that falls with 1 m/s; its normal velocity is wrong by `errors` [m/s]."""
    n = len(errors)
    v_free = np.tile([0.0, -1.0], (n, 1))
    v_free[list(nan)] = np.nan
    jac = np.broadcast_to(np.eye(2)[::-1], (n, 2, 2)).copy()
    batch = lv.Batch(jac, mass * np.broadcast_to(np.eye(2), (n, 2, 2)), v_free, cones=CONES)
    batch.names_of = lambda i: ["contact 7 (ground, foot)"]
    impulse = np.tile([mass, 0.0], (n, 1))
    impulse[:, 0] -= mass * np.array(errors)
    return lv.io.EngineStep(batch, impulse, lv.io.Claims(np.array(claimed, bool), np.full(n, 3), {}))


def test_every_outcome_is_counted(tmp_path):
    steps = [
        step_of([0.0, 0.2, 0.0, 0.3, 0.0, 0.0], [1, 1, 0, 0, 1, 0], nan=[4, 5]),
        step_of([0.0, 0.1, 1e-6, 0.0, 0.0, 0.0], [1, 1, 0, 1, 1, 0], nan=[4, 5]),
    ]
    result = compare_claims(steps, engine="theirs", threshold=1e-4, folder=tmp_path)
    assert list(result.counts.values()) == [3, 2, 2, 1, 2, 2]
    assert result.outcome.shape == (2, 6)
    assert result.largest == pytest.approx(0.3) and result.is_any_lost
    assert result.where == {"contact (ground, foot), normal": (3, pytest.approx(0.3))}
    assert [claimed for _, claimed in result.masses] == [True, False, True]
    assert "Of 5 that the engine calls converged, 2 are wrong" in result.head
    assert "calls 2 of them converged" in result.head
    stored = lv.io.read(tmp_path / "worst" / "step_000000_world_0003.npz")
    assert lv.residual(stored.problem, stored.impulse).velocity == pytest.approx(0.3)
    result.summary_page.write(tmp_path / "page")
    text = (tmp_path / "page" / "index.html").read_text()
    assert all(name in text for name in OUTCOMES)


def test_light_bodies_are_listed_by_effective_mass():
    result = compare_claims(
        [step_of([0.01], [1], mass=2e-3), step_of([0.01], [0], mass=30.0)], threshold=1e-4
    )
    assert [[str(cell) for cell in row] for row in result.table_of_masses.rows] == [
        ["0.001 to 0.01", "1", "1"],
        ["10 to 100", "1", "0"],
    ]


def test_rounding_is_not_an_error():
    step = step_of([1e-7], [1])
    step.batch.precision = "float32"
    assert compare_claims([step], threshold=1e-9).counts["claimed and right"] == 1


def test_ctrl_c_keeps_the_steps_so_far():
    def steps():
        yield step_of([0.0], [1])
        raise KeyboardInterrupt

    result = compare_claims(steps())
    assert result.stopped and result.outcome.shape == (1, 1)


def test_steps_of_other_sizes_and_none_are_rejected():
    with pytest.raises(lv.InputError, match="no steps"):
        compare_claims([])
    with pytest.raises(lv.InputError, match="2 worlds, the first one 1"):
        compare_claims([step_of([0.0], [1]), step_of([0.0, 0.0], [1, 1])])


def test_scenes_are_checked(tmp_path):
    with pytest.raises(lv.UnknownName, match="kamin"):
        step_scene("x", "kamin")
    with pytest.raises(lv.InputError, match="does not exist"):
        step_scene(tmp_path / "scene.py", "genesis")
    (tmp_path / "scene.py").write_text("x = 1\n")
    with pytest.raises(lv.InputError, match="no function build"):
        step_scene(tmp_path / "scene.py", "kamino")
    with pytest.raises(lv.InputError, match="a Python file"):
        step_scene("boxes", "genesis")
