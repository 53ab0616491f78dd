"""Names that do not exist, and arguments in the wrong place, raise an error that names what exists."""

import copy
import json
import pickle

import numpy as np
import pytest

import lavender as lv
from lavender.problem.row_assembly import check_arguments

A, B = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0])
LCP = lv.Problem.lcp(A, B)


@pytest.mark.parametrize("call", [lv.solve, lv.prepare])
def test_solve_with_an_unknown_option_suggests_the_nearest_name(call):
    with pytest.raises(lv.UnknownName, match=r"unknown option 'maxiter' .*did you mean 'max_iter'"):
        call(LCP, "pgs", maxiter=3)
    with pytest.raises(lv.UnknownName, match="did you mean 'solver'"):
        lv.solve(LCP, sovler="pgs")


def test_problem_with_an_unknown_argument_lists_the_arguments():
    with pytest.raises(
        lv.InputError, match=r"Problem\.lcp has no argument lo=; it takes lower=, upper=, .*guess="
    ):
        lv.Problem.lcp(A, B, lo=0.0)


@pytest.mark.parametrize("owner", [LCP.cones, lv.residual(LCP, np.zeros(2)), lv.solve(LCP), lv], ids=type)
def test_unknown_attributes_raise_attribute_error_with_the_name(owner):
    with pytest.raises(AttributeError, match="no attribute 'nonsense'") as raised:
        owner.nonsense  # noqa: B018
    assert raised.value.name == "nonsense"  # Python suggests the nearest name in the traceback.


def test_the_module_of_solvers_names_the_lists_of_solvers():
    import lavender.solvers

    with pytest.raises(TypeError, match=r"lavender\.available\(problem\) lists .* lavender\.known\(\)"):
        lavender.solvers()


@pytest.mark.parametrize(("name", "hint"), [("PGS", "'pgs'"), ("Newton", "'newton'"), ("newtn", "'newton'")])
def test_solver_names_ignore_case_before_similarity(name, hint):
    with pytest.raises(lv.UnknownName) as raised:
        lv.solve(LCP, name)
    assert str(raised.value) == f"unknown solver {name!r}; did you mean {hint}?"


@pytest.mark.parametrize("bounds", [(), (0.0, 1.0)])
def test_a_matrix_in_place_of_a_problem_suggests_to_make_one(bounds):
    with pytest.raises(lv.InputError, match=r"problem is a ndarray; .* Problem\.lcp\(A, b, lower, upper\)"):
        lv.solve(A, B, *bounds)


def test_a_solver_without_history_names_the_list_of_those_with_it():
    with pytest.raises(lv.CapabilityError, match=r"lavender\.available\(problem, history=True\)"):
        lv.solve(LCP, "direct", history=True)
    assert all(lv.solve(LCP, name, history=True).history for name in lv.available(LCP, history=True))


def test_arguments_after_the_solver_go_by_name():
    with pytest.raises(lv.InputError, match=r"solve has 3 positional arguments; .* all others by name"):
        lv.solve(LCP, "pgs", B)


@pytest.mark.parametrize(
    "build", [lv.Problem.lcp, lv.Problem.linear, lambda a, b: lv.Problem.contact(a, b, 0.0)]
)
@pytest.mark.parametrize("matrix", [A, A.tolist()])
def test_a_short_b_is_blamed_instead_of_a_square_matrix(build, matrix):
    with pytest.raises(
        lv.InputError, match=r"^b \[m/s\] has shape \(1,\); \(2,\) is needed, as A has 2 rows"
    ):
        build(matrix, B[:1])


def make_builder():
    return lv.RowBuilder([1.0, 1.0], [1.0, 1.0], np.zeros((2, 3)), 0.01, [(0.0, 0.0), (1.0, 0.0)])


def test_row_builder_with_an_unknown_argument_lists_the_arguments():
    with pytest.raises(lv.InputError, match=r"no argument nonsense=; it takes a=, b=, anchor=, axis="):
        make_builder().hinge(-1, 0, nonsense=1)
    with pytest.raises(lv.InputError, match=r"^RowBuilder has no argument mass=; it takes inv_mass=, "):
        lv.RowBuilder(mass=[1.0], velocity=np.zeros((1, 3)), dt=0.01, position=np.zeros((1, 2)))


def test_missing_and_surplus_arguments_of_row_builders_are_named():
    builder = make_builder()
    with pytest.raises(lv.InputError, match=r"^RowBuilder lacks dt=, position=$"):
        lv.RowBuilder([1.0], [1.0], np.zeros((1, 3)))
    with pytest.raises(lv.InputError, match=r"contact lacks normal=$"):
        builder.contact(-1, 0, (0.0, 0.0))
    with pytest.raises(
        lv.InputError,
        match=r"contact takes 4 positional .* a, b, point, normal; 6 were given; .* by name: gap=, mu=",
    ):
        builder.contact(-1, 0, (0.0, 0.0), (0.0, 1.0), 0.0, 0.5)
    with pytest.raises(lv.InputError, match=r"hinge has anchor twice, by position and by name"):
        builder.hinge(-1, 0, (0.0, 0.0), anchor=(0.0, 0.0))
    builder.contact(-1, 0, (0.0, 0.0), (0.0, 1.0))
    solution = lv.solve(builder.problem())
    with pytest.raises(
        lv.InputError,
        match=r"velocity_after lacks impulse=: builder\.velocity_after\(problem, solution\.impulse\)",
    ):
        builder.velocity_after(solution)


def test_a_type_error_within_a_call_of_a_row_builder_stays_as_it_is():
    @check_arguments
    def add(self, number):
        return number + ""

    with pytest.raises(TypeError, match="unsupported operand"):
        add(None, 1)
    with pytest.raises(lv.InputError, match=r"^RowBuilder\.add lacks number=$"):
        add(None)


PLANE, SPACE, TENSORS = np.zeros((2, 3)), np.zeros((2, 6)), np.tile(np.eye(3), (2, 1, 1))
SWAPPED = "so the two seem to be swapped: the order is inv_mass, inv_inertia, velocity, dt, position"


@pytest.mark.parametrize(
    ("inv_inertia", "velocity", "position", "words"),
    [
        (
            [1.0, 1.0],
            PLANE,
            PLANE,
            r"three dimensions, but velocity .* position \(2, 2\) is needed, without the angle",
        ),
        ([1.0, 1.0], np.zeros((2, 2)), PLANE, SWAPPED),
        (TENSORS, PLANE, SPACE, SWAPPED),
    ],
)
def test_positions_with_an_angle_or_in_place_of_velocities_are_named(inv_inertia, velocity, position, words):
    shape = str(np.shape(position)).replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(lv.InputError, match=rf"^position \[m\] has shape {shape}.*{words}"):
        lv.RowBuilder([1.0, 1.0], inv_inertia, velocity, 0.01, position)


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (B, r"solver is a ndarray; .*solve\(problem, impulse=\.\.\.\)"),
        (lv.solve(LCP), r"solver is a Solution; .*solve\(problem, impulse=problem\.carry\(solution\)\)"),
        (1e-9, r"solver is 1e-09; .*solve\(problem, tol=\.\.\.\)"),
        (10, r"solver is 10; .*solve\(problem, max_iter=\.\.\.\)"),
    ],
)
def test_other_arguments_in_place_of_the_solver_go_by_name(second, words):
    with pytest.raises(lv.InputError, match=words):
        lv.solve(LCP, second)


def test_starts_that_do_not_fit_name_the_way_to_get_one():
    with pytest.raises(
        lv.InputError, match=r"impulse \[N s\] has shape \(3,\); \(2,\) is needed.*problem\.carry"
    ):
        lv.solve(LCP, impulse=np.ones(3))
    with pytest.raises(lv.InputError, match=r"previous is None; .* the first step .* without impulse="):
        LCP.carry(None)


def test_mistakes_with_a_builder_name_the_call_to_use():
    builder = make_builder()
    builder.contact(-1, 0, (0.0, 0.0), normal=(0.0, 1.0), mu=0.5)
    problem = builder.problem()
    solution = lv.solve(problem)
    with pytest.raises(lv.InputError, match=r"is a RowBuilder; .* give the result of its \.problem\(\)"):
        lv.solve(builder)
    with pytest.raises(
        lv.InputError, match=r"impulse is a Solution; .* \.impulse, or problem\.carry\(solution\)"
    ):
        lv.solve(problem, impulse=solution)
    with pytest.raises(lv.InputError, match=r"give its \.impulse"):
        builder.velocity_after(problem, solution)
    with pytest.raises(lv.InputError, match="a separate bound for each tangent is a shape"):
        builder.problem("pyramid")


def test_a_status_is_equal_to_its_name_everywhere():
    problem = lv.Problem.lcp([[2.0]], [1.0])
    solution = lv.solve(problem)
    assert solution.status == "CONVERGED" and solution.status != "STALLED"
    assert (lv.solve_many([problem] * 2).status == "CONVERGED").all()
    for status in lv.Status:
        assert status == status.name == str(status) == f"{status}" and len(status.description) > 10
        assert lv.Status(status.name) is lv.Status[status.name] is status
        assert pickle.loads(pickle.dumps(status)) is copy.deepcopy(status) is status
        assert json.loads(json.dumps(status)) == status.name and {status.name: 1}[status] == 1
