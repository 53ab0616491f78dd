"""A user's file for mypy and pyright, which find mistyped names in it and accept lists and integers like arrays.

Both report an unused `type: ignore` here, so each of these comments proves that they find the mistake.
"""

# pyright: reportUnnecessaryTypeIgnoreComment=true
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import lavender as lv
from lavender.problem.builders import ProblemOptions
from lavender.solvers.registry import SolverOptions, specs

PROBLEM = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])
LINEAR = lv.Problem.linear([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])
SOLUTION = lv.solve(PROBLEM, "pgs")
GRADIENT = lv.derivative(PROBLEM, SOLUTION).vjp(impulse=[1.0, 0.0])
EMPTY: list[float] = []
#: Names that do not exist and options of a wrong type, with the error at run time.
MISTAKES: list[tuple[type[Exception], Callable[[], object]]] = [
    (AttributeError, lambda: lv.sove(PROBLEM)),  # type: ignore[attr-defined]
    (AttributeError, lambda: SOLUTION.impulses),  # type: ignore[attr-defined]
    (AttributeError, lambda: SOLUTION.residual.relativ),  # type: ignore[attr-defined]
    (AttributeError, lambda: PROBLEM.cones.lo),  # type: ignore[attr-defined]
    (AttributeError, lambda: lv.solve_many([PROBLEM], "pgs").impuls),  # type: ignore[attr-defined]
    (AttributeError, lambda: GRADIENT.targets),  # type: ignore[attr-defined]
    (lv.UnknownName, lambda: lv.solve(PROBLEM, "pgs", tolerance=1)),  # type: ignore[call-arg]
    (lv.UnknownName, lambda: lv.prepare(PROBLEM, "pgs", omeg=1.0)),  # type: ignore[call-arg]
    (lv.UnknownName, lambda: lv.solve_many([PROBLEM], "pgs", iterations=3)),  # type: ignore[call-arg]
    (TypeError, lambda: lv.Problem.lcp([[1.0]], [1.0], lo=0)),  # type: ignore[call-arg]
    (lv.InputError, lambda: lv.solve(LINEAR, "sor", omega="fast")),  # type: ignore[arg-type]
    (lv.InputError, lambda: lv.solve(PROBLEM, "pgs", tol="1e-6")),  # type: ignore[arg-type]
]


@pytest.mark.parametrize("error, call", MISTAKES)
def test_mistyped_name_or_value_raises(error: type[Exception], call: Callable[[], object]) -> None:
    with pytest.raises(error):
        call()


def test_options_that_exist_and_those_of_plug_ins_are_accepted() -> None:
    assert lv.solve(LINEAR, "sor", omega=1.2, order="reverse").success and GRADIENT.b.shape == (2,)
    options: dict[str, Any] = {"tolerance": 1}
    with pytest.raises(lv.UnknownName):
        lv.solve(PROBLEM, "pgs", **options)


def test_the_typed_options_are_those_of_the_built_in_solvers() -> None:
    known = {name for spec in specs().values() if spec.builtin for name in spec.accepts}
    assert known <= set(SolverOptions.__annotations__)
    external = {name for spec in specs().values() if spec.external for name in spec.accepts}
    assert known | external == set(SolverOptions.__annotations__)


def test_the_typed_keywords_of_problems_are_those_that_their_methods_accept() -> None:
    assert set(ProblemOptions.__annotations__) <= set(inspect.signature(lv.Problem).parameters)


def test_cones_and_problems_from_lists_equal_those_from_arrays() -> None:
    cones = lv.Cones(ptr=[0, 1], kind=[0], lower=[0.0], upper=[1], mu=[0.0], patch_radius=[0.0])
    assert cones == lv.Cones.bounded([0], [1.0]) == lv.Cones.bounded(np.zeros(1), 1.0)
    problem = lv.Problem([1], cones, [[2.0]], guess=[0.5], key=[3], names=["a"])
    guess = np.full(1, 0.5)
    key = np.array([3])
    assert problem == lv.Problem(
        np.ones(1), cones, np.full((1, 1), 2.0), guess=guess, key=key, names=("a",)
    )
    assert lv.Problem.lcp([[2.0]], [1], [0], [1]).cones == cones
    general = lv.Problem.from_jacobian(
        [[1.0]], [[0.5]], [-1], cones=cones, target=[0], compliance=[0.1]
    )
    assert general.b.tolist() == [1.0]


class Halves:
    """A solver of two methods."""

    def prepare(self, problem: lv.Problem) -> lv.Problem:
        return problem

    def run(
        self,
        state: lv.Problem,
        impulse: npt.NDArray[np.float64],
        n: int,
        tol: float,
        time_limit: float | None,
    ) -> lv.Claim:
        impulse *= 0.5**n
        return lv.Claim(lv.Status.MAX_ITERATIONS, n)


def test_register_of_a_class_without_base_is_accepted(register: Any) -> None:
    register(lv.SolverSpec(name="halves", factory=Halves, laws=frozenset({"lcp"}), summary=""))
    solution = lv.solve(
        lv.Problem.lcp([[1.0]], [1.0]), "halves", impulse=[8.0], tol=0.0, max_iter=3
    )
    assert solution.impulse.tolist() == [1.0]


@pytest.mark.parametrize("bodies", [0, 2])
def test_rows_of_empty_lists_have_no_contacts_joints_or_bodies(bodies: int) -> None:
    """A loop over the contacts of a step gives empty lists if there are none."""
    mass = [1.0] * bodies
    inertia = [np.eye(3)] * bodies
    free = [np.ones(6)] * bodies
    rows = lv.Rows(
        mass,
        inertia,
        free,
        jac=EMPTY,
        joint_body=EMPTY,
        contact_body=EMPTY,
        normal=EMPTY,
        tangent=EMPTY,
        arm_a=EMPTY,
        arm_b=EMPTY,
    )
    assert rows == lv.Rows(
        np.ones(bodies), np.tile(np.eye(3), (bodies, 1, 1)), np.ones((bodies, 6))
    )
    problem = lv.Problem.from_rows(rows, target=EMPTY, mu=EMPTY)
    assert problem.m == 0 and lv.solve(problem).success
    with pytest.raises(lv.InputError, match=r"contact_body has shape \(1, 2\); \(0, 2\) is needed"):
        lv.Rows(
            mass,
            inertia,
            free,
            contact_body=[(-1, 0)],
            normal=EMPTY,
            tangent=EMPTY,
            arm_a=EMPTY,
            arm_b=EMPTY,
        )
