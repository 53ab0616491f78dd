"""`history=True` of `auto`: the records of all stages, which do not change the result."""

import numpy as np
import pytest

import lavender as lv

# Stages of the compiled call, of sweeps, of sweeps and Newton's method, of the cone law, and of the alternation.
CASES = {
    "box_stack(n=10)": {"start", "direct"},
    "ramp(angle=30)": {"start", "anderson"},
    "pyramid(k=6, mass_ratio=100)": {"start", "anderson"},
    "box_stackF(n=10)": {"start", "anderson", "newton"},
    "granularF(n=3, sliding=0.5)": {"start", "anderson", "newton"},
    "anisotropic(ratio=100, speed=3)": {"start", "anderson"},
    "hang(n=33)": {"start", "direct"},
    "wedge(angle=1e-8)": {"start", "anderson", "newton", "admm", "linear program"},
}


@pytest.mark.parametrize("name", CASES)
def test_auto_history_has_all_stages_and_changes_no_bit(name):
    problem = lv.suite.case(name).problem
    recorded = lv.solve(problem, history=True)
    plain = lv.solve(problem)
    history = recorded.history
    assert recorded.impulse.tobytes() == plain.impulse.tobytes()
    assert (recorded.status, recorded.iterations, recorded.message) == (
        plain.status,
        plain.iterations,
        plain.message,
    )
    assert set(history.solvers) == CASES[name]
    assert len(history.solvers) == len(history.iterations) == len(history.time)
    assert history.iterations[0] == 0 and history.iterations[-1] == recorded.iterations
    assert np.all(np.diff(history.iterations) > 0) and np.all(np.diff(history.time) >= 0.0)
    assert history.relative[0] == pytest.approx(1.0)
    assert history.relative[-1] == recorded.residual.relative


def test_history_of_compiled_call_has_its_start_and_its_end():
    solution = lv.solve(lv.suite.case("ramp(angle=30)").problem, history=True)
    assert solution.history.iterations.tolist() == [0, solution.iterations]


def test_history_of_a_start_that_is_a_solution_has_one_record():
    problem = lv.suite.case("granularF(n=3, sliding=0.5)").problem
    history = lv.solve(problem, impulse=lv.solve(problem).impulse, history=True).history
    assert (history.iterations.tolist(), history.solvers) == ([0], ("start",))


def test_plot_of_auto_history_names_the_solver_of_each_stage():
    history = lv.solve(lv.suite.case("box_stackF(n=10)").problem, history=True).history
    labels = [text.get_text() for text in history.plot().axes[0].get_legend().get_texts()]
    assert labels == ["start", "anderson", "newton"]
