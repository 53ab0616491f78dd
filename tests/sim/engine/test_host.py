"""What a host without Python asks of the engine's kernels: where arrays lie, and room, checked natively."""

import numpy as np
import pytest
from worked import after

import lavender as lv
from lavender.sim.engine.layout import SETTING


@pytest.mark.parametrize("name", ["stack", "chain", "bridge", "pile"])
@pytest.mark.parametrize("order", ["given", "random", "top_down"])
def test_sweeps_with_a_residual_after_each_have_the_same_bits(name, order):
    simulation = after(30, name, order=order, solver_iterations=12)
    watched, plain = simulation.state.copy(), simulation.state.copy()
    for state in (watched, plain):
        assert state.kernel.prepare_substep() == 0
    curve = np.full((13, 2), np.nan)
    watched.kernel.sweep_and_record_errors(curve)
    plain.kernel.solve()
    assert watched.real.tobytes() == plain.real.tobytes()
    assert watched.index.tobytes() == plain.index.tobytes()
    values = watched.setting[SETTING["out"] :]
    assert curve[0, 0] == values[4] and curve[-1, 0] == values[5]
    # E along the sweeps is the judge's, of the problem solved with as many sweeps; both sum the same terms in
    # the same order on velocities formed in another one, so they agree to rounding of w, 1e-9 of E at most.
    problem = simulation.constraint_problem()
    seed = {"seed": simulation.sweep_seed()} if order == "random" else {}
    for sweeps in (1, 5, 12):
        guess = problem.start() if problem.guess is None else problem.guess
        options = {"tol": 0, "max_iter": sweeps, "impulse": guess, "order": order, **seed}
        found = lv.solve(problem, "sequential_impulses", **options)
        assert curve[sweeps, 1] == pytest.approx(found.residual.energy, rel=1e-9, abs=1e-15)
