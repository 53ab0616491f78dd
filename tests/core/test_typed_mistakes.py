"""mypy and pyright, which check this file as a user's, find mistyped names; at run time each of them raises an error.

Both report an unused `type: ignore` here, so each of these comments proves that they find the mistake.
"""

# pyright: reportUnnecessaryTypeIgnoreComment=true
import inspect
from typing import Any

import pytest

import lavender as lv
from lavender.problem.builders import ProblemOptions
from lavender.solvers.registry import SolverOptions, specs

PROBLEM = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])
LINEAR = lv.Problem.linear([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])


def test_names_that_the_package_does_not_have() -> None:
    with pytest.raises(AttributeError):
        lv.sove(PROBLEM)  # type: ignore[attr-defined]


def test_attributes_that_results_do_not_have() -> None:
    solution = lv.solve(PROBLEM, "pgs")
    with pytest.raises(AttributeError):
        solution.impulses  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(AttributeError):
        solution.residual.relativ  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(AttributeError):
        PROBLEM.cones.lo  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(AttributeError):
        lv.solve_many([PROBLEM], "pgs").impuls  # type: ignore[attr-defined]  # noqa: B018
    gradient = lv.derivative(PROBLEM, solution).vjp(impulse=[1.0, 0.0])
    with pytest.raises(AttributeError):
        gradient.targets  # type: ignore[attr-defined]  # noqa: B018
    assert gradient.b.shape == (2,)


def test_keywords_that_functions_do_not_have() -> None:
    with pytest.raises(lv.UnknownName):
        lv.solve(PROBLEM, "pgs", tolerance=1)  # type: ignore[call-arg]
    with pytest.raises(lv.UnknownName):
        lv.prepare(PROBLEM, "pgs", omeg=1.0)  # type: ignore[call-arg]
    with pytest.raises(lv.UnknownName):
        lv.solve_many([PROBLEM], "pgs", iterations=3)  # type: ignore[call-arg]
    with pytest.raises(TypeError):
        lv.Problem.lcp([[1.0]], [1.0], lo=0)  # type: ignore[call-arg]


def test_options_of_the_wrong_type() -> None:
    with pytest.raises(lv.InputError):
        lv.solve(LINEAR, "sor", omega="fast")  # type: ignore[arg-type]
    with pytest.raises(lv.InputError):
        lv.solve(PROBLEM, "pgs", tol="1e-6")  # type: ignore[arg-type]


def test_options_that_exist_and_those_of_plug_ins_are_accepted() -> None:
    assert lv.solve(LINEAR, "sor", omega=1.2, order="reverse").success
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
