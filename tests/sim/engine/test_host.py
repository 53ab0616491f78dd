"""What a host without Python asks of the engine's kernels: where arrays lie, and room, checked natively."""

import numpy as np
import pytest
from worked import after

import lavender as lv
from lavender.sim.engine.layout import SETTING
from lavender.sim.engine.state import State
from lavender_ext.engine.arrays import SHAPES, compute_array_offsets


@pytest.mark.parametrize("name", ["stack", "chain", "spinner", "pile", "four_bar"])
def test_arrays_lie_where_the_engine_has_them(name):
    state = State.from_scene(lv.Scene(name))
    first = compute_array_offsets(state.size)
    total = {"real": state.real, "index": state.index, "keys": state.keys}
    for buffer, names in SHAPES.items():
        starts = [first[n] for n in names]
        assert starts[0] == 0 and starts == sorted(starts)
        ends = [*starts[1:], len(total[buffer])]
        for n, start, end in zip(names, starts, ends, strict=True):
            if n in state.a:
                view = state.a[n]
                assert view.size == end - start, n
                if view.size:
                    assert np.shares_memory(view, total[buffer][start:end]), n
                    assert view.ctypes.data == total[buffer][start:].ctypes.data, n
    named = {n for names in SHAPES.values() for n in names}
    assert set(state.a) <= named


@pytest.mark.parametrize("name", ["stack", "chain", "bridge", "pile"])
@pytest.mark.parametrize("order", ["given", "random", "top_down"])
def test_watched_sweeps_are_the_sweeps(name, order):
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
