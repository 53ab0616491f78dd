"""Pickles that earlier commits wrote load as today's objects: statuses, and solutions of three problems."""

import base64
import pickle
import zlib
from pathlib import Path

import numpy as np
import pytest

import lavender as lv
from lavender.judge.solution import RENAMED_STATUSES, Status

# One line for each commit: its hash, and the pickle (protocol 4, zlib, base85) of the list of all statuses, and of
# solutions by `auto` (two rows), `newton` (a contact of bodies) and `lemke` (no solution exists).
STORED = dict(
    line.split() for line in Path(__file__).with_name("stored_pickles.txt").read_text().splitlines()
)
BODY = lv.Rows(
    [0.5], [np.eye(3) / 0.008], [[0.3, 0.0, -0.16, 0.0, 0.0, 0.0]], contact_body=[(-1, 0)], normal=[(0.0, 0.0, 1.0)],
    tangent=[(1.0, 0.0, 0.0)], arm_a=[(0.0, 0.0, 0.0)], arm_b=[(0.0, 0.0, -0.09)],
)  # fmt: skip
PROBLEMS = (
    lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0]),
    lv.Problem.from_rows(BODY, target=0.6, mu=[0.5], key=[7]),
    lv.Problem.lcp([[0.0]], [1.0]),
)


@pytest.fixture(params=sorted(STORED))
def stored(request):
    """Load the statuses and solutions of one earlier commit."""
    return pickle.loads(zlib.decompress(base64.b85decode(STORED[request.param])))


def test_statuses_that_were_pickled_by_their_description_are_members(stored):
    assert stored[0] == list(Status)
    assert all(a is b for a, b in zip(stored[0], Status, strict=True))


def test_solutions_have_all_fields_and_the_residual_of_todays_judge(stored):
    lcp, contact, infeasible = stored[1]
    assert [s.status for s in stored[1]] == ["CONVERGED", "CONVERGED", "INFEASIBLE"]
    assert [s.claim_check for s in stored[1]] == ["confirmed"] * 3
    assert lcp.impulse.tolist() == [0.5, 0.0]
    assert lcp.stages[0].solver == "direct"
    assert contact.state(0).name == "sticks"
    assert infeasible.certificate.tolist() == [1.0]
    for solution, problem in zip(stored[1], PROBLEMS, strict=True):
        again = lv.residual(problem, solution.impulse)
        assert np.array_equal(solution.residual.error, again.error)
        assert solution.residual.relative == again.relative
        assert solution.velocity_tol is None
        assert str(pickle.loads(pickle.dumps(solution))) == str(solution)


@pytest.mark.parametrize(("name", "now"), RENAMED_STATUSES.items())
def test_a_renamed_status_is_found_by_its_earlier_name(name, now):
    assert Status(name) is Status[now]
    # Python 3.11.0 to 3.11.3 pickle a member by its name.
    by_name = f"cbuiltins\ngetattr\n(clavender.judge.solution\nStatus\nV{name}\ntR."
    assert pickle.loads(by_name.encode()) is Status[now]


def test_another_text_is_no_status():
    with pytest.raises(ValueError, match="is not a valid Status"):
        Status("CONVERGED with luck")
