"""Each option that a solver lists changes its iterates, and no solver or backend exceeds its budget."""

import inspect
import itertools

import numpy as np
import pytest
from random_problems import (
    add_compliance,
    as_matrix,
    make_well_posed_problems,
    random_contact_problem,
)

import lavender as lv
from lavender import registry
from lavender.problem.ordering import SWEEP_ORDERS

#: Values of options; every two of them mean different iterations. A number without a line gets its default and half.
VALUES = {
    "order": tuple(SWEEP_ORDERS),
    "seed": (1, 2),
    "ground": ([0, 1], [5]),
    "memory": (2, 5),
    "relaxation": (1.0, 1.7),
    "omega": (0.1, 0.2),
    "sweep": ("pgs", "blocks"),
    "convex": (0, 3),
    "restart": ("growth", "against"),
    "form": ("velocity", "impulse"),
}
NEEDED = {"seed": {"order": "random"}, "ground": {"order": "bottom_up"}}
SPECS = {name: registry.get(name) for name in lv.available(external=False)}
#: Bodies show which of them are the ground, so that solvers of bodies only refuse `ground`.
LISTED = [
    (name, option)
    for name, s in SPECS.items()
    for option in sorted(s.accepts)
    if (option, s.operators) != ("ground", {"rows"})
]


def get_values(name, option):
    """Return the values of an option of a solver in `VALUES`, or its default and half of the default."""
    if option in VALUES:
        return VALUES[option]
    default = inspect.signature(SPECS[name].load()).parameters[option].default
    return default, type(default)(default / 2)


@pytest.mark.parametrize(("name", "option"), LISTED)
def test_every_two_values_of_an_option_give_other_iterates(name, option):
    soft = add_compliance(
        random_contact_problem(5, tangents=2, spin=False, joints=6, contacts=30, bodies=12), 0.01
    )
    problems = [soft, as_matrix(soft), *make_well_posed_problems(SPECS[name])]
    problems = [p for p in problems if SPECS[name].refuses(p) is None]
    values = get_values(name, option)
    equal = set(itertools.combinations(range(len(values)), 2))
    for problem in problems:
        found = []
        for value in values:
            try:
                more = {option: value} | NEEDED.get(option, {})
                found.append(lv.solve(problem, name, tol=0.0, max_iter=30, **more).impulse)
            except (lv.CapabilityError, lv.InputError):  # `ground` belongs to matrices only.
                found.append(np.zeros(0))
        equal -= {pair for pair in equal if not np.array_equal(*(found[i] for i in pair))}
    assert [[values[i] for i in pair] for pair in equal] == []


@pytest.mark.parametrize("name", lv.available())
def test_iterations_of_every_solver_are_within_max_iter(name):
    spec = registry.get(name)
    program = lv.Problem.from_qp(
        np.diag([1.0, 2.0, 3.0]), -np.arange(3.0), G=np.eye(2, 3) + 1.0, h=[0.1, 0.2]
    )
    problems = [*make_well_posed_problems(spec), *[program] * (spec.refuses(program) is None)]
    for problem, budget in itertools.product(problems, (1, 2, 7)):
        solution = lv.solve(problem, name, tol=1e-9, max_iter=budget)
        # Some backends cannot be limited; then the message says so.
        said = spec.external and f"iterations, more than the limit of {budget}" in solution.message
        assert solution.iterations <= budget or said, solution
