"""Lists and integers are accepted like arrays, at run time and by mypy, which checks this file as a user's."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import lavender as lv

EMPTY: list[float] = []


def test_cones_and_problems_from_lists_equal_those_from_arrays() -> None:
    cones = lv.Cones(ptr=[0, 1], kind=[0], lower=[0.0], upper=[1], mu=[0.0], patch_radius=[0.0])
    assert cones == lv.Cones.bounded([0], [1.0]) == lv.Cones.bounded(np.zeros(1), 1.0)
    problem = lv.Problem([1], cones, [[2.0]], guess=[0.5], key=[3], names=["a"])
    assert problem == lv.Problem(
        np.ones(1), cones, np.full((1, 1), 2.0), guess=np.array([0.5]), key=np.array([3]), names=("a",)
    )
    assert lv.Problem.lcp([[2.0]], [1], [0], [1]).cones == cones
    general = lv.Problem.from_jacobian([[1.0]], [[0.5]], [-1], cones=cones, target=[0], compliance=[0.1])
    assert general.b.tolist() == [1.0]


class Halves:
    """A solver of two methods."""

    def prepare(self, problem: lv.Problem) -> lv.Problem:
        return problem

    def run(
        self, state: lv.Problem, impulse: npt.NDArray[np.float64], n: int, tol: float, time_limit: float | None
    ) -> lv.Claim:
        impulse *= 0.5**n
        return lv.Claim(lv.Status.MAX_ITERATIONS, n)


def test_register_of_a_class_without_base_is_accepted(register: Any) -> None:
    register(lv.SolverSpec(name="halves", factory=Halves, laws=frozenset({"lcp"}), summary=""))
    solution = lv.solve(lv.Problem.lcp([[1.0]], [1.0]), "halves", impulse=[8.0], tol=0.0, max_iter=3)
    assert solution.impulse.tolist() == [1.0]


@pytest.mark.parametrize("bodies", [0, 2])
def test_rows_of_empty_lists_have_no_contacts_joints_or_bodies(bodies: int) -> None:
    """A loop over the contacts of a step gives empty lists if there are none."""
    mass, inertia, free = [1.0] * bodies, [np.eye(3)] * bodies, [np.ones(6)] * bodies
    rows = lv.Rows(
        mass, inertia, free, jac=EMPTY, joint_body=EMPTY, contact_body=EMPTY, normal=EMPTY, tangent=EMPTY, arm_a=EMPTY,
        arm_b=EMPTY,
    )  # fmt: skip
    assert rows == lv.Rows(np.ones(bodies), np.tile(np.eye(3), (bodies, 1, 1)), np.ones((bodies, 6)))
    problem = lv.Problem.from_rows(rows, target=EMPTY, mu=EMPTY)
    assert problem.m == 0 and lv.solve(problem).success
    with pytest.raises(lv.InputError, match=r"contact_body has shape \(1, 2\); \(0, 2\) is needed"):
        lv.Rows(mass, inertia, free, contact_body=[(-1, 0)], normal=EMPTY, tangent=EMPTY, arm_a=EMPTY, arm_b=EMPTY)
