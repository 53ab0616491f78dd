"""Every reference problem loads and its stored solution passes the judge; solvers end on those without friction."""

import os
from pathlib import Path

import numpy as np
import pytest
from random_problems import good

import lavender as lv
import lavender.io

pytest.importorskip("h5py", reason="most reference problems are HDF5")

FOLDER = Path(os.environ.get("LAVENDER_PROBLEMS", "") or "nowhere")
FILES = sorted(p.name for s in ("*.npz", "*.hdf5") for p in FOLDER.glob(s))
#: Solutions rounded to float64 that cannot score 1e-11: the entries of A and of lambda are too far apart.
AT_FLOOR = {"fc3d_2cubes_t0.hdf5", "gfc3d_TwoRods1.hdf5", "gmp_GMP6.npz"}


def test_reference_folder_has_the_expected_files(problem_dir):
    assert problem_dir == FOLDER
    assert len(FILES) == 69
    assert sum(name.startswith("rfc3d_") for name in FILES) == 4


@pytest.mark.parametrize("name", FILES or [pytest.param("", id="no folder")])
def test_a_reference_problem_loads_and_its_solution_is_one(problem_dir, name, tmp_path):
    stored = lavender.io.read(problem_dir / name)
    problem = stored.problem
    assert problem.m > 0
    if stored.compare == "no solution":
        assert stored.impulse is None
        assert name == "lcpgen_psd-300.npz"
        return
    judged = lv.residual(problem, stored.impulse)
    # Of a global form b = -(w + J M^-1 f) has roundings of its own, in another order than the file's solver added them.
    floors = 4.0 if stored.format == "fclib_global" else 2.0
    assert judged.relative <= max(1e-11, floors * judged.roundoff_floor), str(judged)
    assert (judged.relative > 1e-11) == (name in AT_FLOOR)
    # Their u is that of the same r, formed by another code: rounding of the largest sums, and where M had to
    # be inverted its condition number on top.
    rounding = 2.0**-53 * (np.abs(problem.csr) @ np.abs(stored.impulse) + np.abs(problem.b)).max()
    factor = 1e4 if stored.format == "fclib_global" else 64.0
    gap = np.abs(stored.slack - judged.slack)
    assert np.all(gap <= 1e-6 * np.abs(stored.slack) + factor * rounding)
    lavender.io.save(problem, tmp_path / "same.npz", impulse=stored.impulse)
    assert lavender.io.load(tmp_path / "same.npz") == problem
    if name.startswith(("fc3d_", "fc2d_", "rfc3d_")):
        lavender.io.save(problem, tmp_path / "same.hdf5", impulse=stored.impulse)
        again = lavender.io.read(tmp_path / "same.hdf5")
        assert again.problem == problem
        assert again.impulse.tobytes() == stored.impulse.tobytes()


@pytest.mark.parametrize("solver", ["newton", "auto", "admm", "anderson", "nncg"])
@pytest.mark.parametrize(
    "name", [n for n in FILES if n.startswith("rfc3d_")] or [pytest.param("", id="no folder")]
)
def test_rolling_reference_problems_are_solved_as_their_reference(problem_dir, name, solver):
    stored = lavender.io.read(problem_dir / name)
    problem = stored.problem
    assert problem.cones.has_rolling
    found = lv.solve(problem, solver, tol=1e-10, max_iter=20_000)
    assert found.success, str(found)
    if stored.compare == "error":  # several velocities, each a solution
        return
    assert stored.compare == "r,u"
    size = np.abs(stored.impulse).max()
    # A relative residual of 1e-10, and a W of these files within 1e3 of its diagonal.
    np.testing.assert_allclose(found.impulse, stored.impulse, atol=1e-7 * size)
    np.testing.assert_allclose(found.slack, stored.slack, atol=1e-7 * np.abs(problem.b).max())


@pytest.mark.parametrize("solver", lv.available(external=False, law="lcp", exact=True))
def test_reference_problems_without_friction_are_solved_by_exact_solvers(problem_dir, solver):
    problems = {
        name: lavender.io.load(problem_dir / name) for name in FILES if name.endswith(".npz")
    }
    problems = {name: problem for name, problem in problems.items() if not any(problem.cones.kind)}
    assert len(problems) > 25
    for name, problem in problems.items():
        found = lv.solve(problem, solver, tol=1e-9)
        assert found.claim_check == "confirmed", (name, found)
        if name == "lcpgen_psd-300.npz":
            assert found.status is lv.Status.INFEASIBLE, found
        elif solver == "direct" and found.status is lv.Status.STALLED:
            assert not problem.is_symmetric, (
                name
            )  # where A is not monotone either, exchanges may have no end
        else:
            assert found.success or found.status is lv.Status.ROUNDOFF_LIMIT, (name, found)


@pytest.mark.parametrize(
    "name", [n for n in FILES if n.endswith(".hdf5")] or [pytest.param("", id="no folder")]
)
def test_auto_solves_every_reference_problem_with_friction(problem_dir, name):
    """In one of them, A has stored zeros between the rows of islands on an immovable body."""
    found = lv.solve(lavender.io.load(problem_dir / name), "auto", tol=1e-6)
    assert good(found, 1e-6), found


#: Real friction problems on which 20,000 sweeps fail or take thousands.
HARD = ["fc3d_2cubes_t0", "fc3d_OneObject-i100000-499", "fc3d_LMGC_100_PR_PerioBox-i00361-60-03000"]


@pytest.mark.parametrize("name", HARD)
def test_admm_solves_fclib_problems(problem_dir, name):
    pytest.importorskip("h5py")
    solution = lv.solve(lv.load(problem_dir / f"{name}.hdf5"), "admm", tol=1e-8, max_iter=5000)
    assert solution.success, solution


@pytest.mark.slow
@pytest.mark.parametrize("step", [150, 180])
def test_piles_that_creep_are_solved_along_a_path_through_its_folds(step, problem_dir):
    """126 balls in a box, between stick and slip: interior points end at 7e-3."""
    problem = lv.io.load(problem_dir / "engine" / f"balls_step_0{step}.npz")
    solution = lv.solve(problem, "newton", tol=1e-6)
    assert good(solution, 1e-6) and "path steps" in solution.message, solution
