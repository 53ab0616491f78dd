"""Names that users of similar packages try are answered by an error that suggests the name of this package."""

import copy
import json
import pickle

import numpy as np
import pytest

import lavender as lv
from lavender.base.renamed import INSTEAD
from lavender.problem.row_assembly import check_arguments

A, B = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0])
LCP = lv.Problem.lcp(A, B)


@pytest.mark.parametrize(
    ("name", "successor"),
    [("lo", "lower"), ("lb", "lower"), ("hi", "upper"), ("ub", "upper"), ("x0", "guess")],
)
def test_bounds_of_other_packages_suggest_ours(name, successor):
    with pytest.raises(lv.InputError, match=rf"Problem\.lcp has no argument {name}=; use {successor}="):
        lv.Problem.lcp(A, B, **{name: 0.0})


def test_programs_keep_their_own_names_of_bounds():
    with pytest.raises(lv.InputError, match="has no argument lower=; use lb="):
        lv.Problem.from_qp(A, B, lower=np.zeros(2))


@pytest.mark.parametrize(
    ("name", "successor"),
    [
        ("warm_start", "impulse"),
        ("x0", "impulse"),
        ("iterations", "max_iter"),
        ("maxiter", "max_iter"),
        ("sweeps", "max_iter"),
    ],
)
@pytest.mark.parametrize("solver", ["auto", "pgs"])
def test_options_of_other_packages_suggest_ours(solver, name, successor):
    for call in (lv.solve, lv.prepare):
        with pytest.raises(lv.UnknownName, match=f"unknown option '{name}' .*did you mean '{successor}'"):
            call(LCP, solver, **{name: 3})
    with pytest.raises(lv.UnknownName, match=f"unknown argument '{name}' .*did you mean '{successor}'"):
        lv.prepare(LCP, solver).solve(**{name: 3})


@pytest.mark.parametrize("name", ["x", "lam", "impulses"])
def test_results_of_other_packages_suggest_ours(name):
    with pytest.raises(AttributeError, match=f"no attribute '{name}'; use impulse"):
        getattr(lv.solve(LCP), name)


def test_the_module_of_solvers_names_the_lists_of_solvers():
    import lavender.solvers

    with pytest.raises(TypeError, match=r"lavender\.available\(problem\) lists .* lavender\.known\(\)"):
        lavender.solvers()


@pytest.mark.parametrize(
    ("name", "hint"), [("PGS", "'pgs'"), ("Newton", "'newton'"), ("lcp", "'lemke'"), ("LCP", "'lemke'")]
)
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


@pytest.mark.parametrize(
    ("owner", "name", "successor"),
    [
        (LCP.cones, "reach", "friction_coefficient"),
        (LCP.cones, "parts", "friction_components"),
        (LCP.cones, "take", "select"),
        (lv.residual(LCP, np.zeros(2)), "energy_start", "energy_at_zero"),
        (lv.residual(LCP, np.zeros(2)), "floor", "roundoff_floor"),
    ],
)
def test_former_names_of_fields_suggest_the_present_one(owner, name, successor):
    with pytest.raises(AttributeError, match=f"no attribute '{name}'; use {successor}"):
        getattr(owner, name)
    assert hasattr(owner, successor)


def test_no_former_name_is_its_own_successor():
    assert not [name for names in INSTEAD.values() for name, successor in names.items() if name == successor]


def make_builder():
    return lv.RowBuilder([1.0, 1.0], [1.0, 1.0], np.zeros((2, 3)), 0.01, [(0.0, 0.0), (1.0, 0.0)])


@pytest.mark.parametrize(
    ("method", "keywords", "words"),
    [
        (
            "contact",
            {"point": (0.0, 0.0), "normal": (0.0, 1.0), "friction": 0.5},
            "no argument friction=; use mu=",
        ),
        ("motor", {"speed": 1.0, "torque": 2.0}, "no argument torque=; use max_torque="),
        ("hinge", {"pivot": (0.0, 0.0)}, "no argument pivot=; use anchor="),
        ("spring", {"k": 2.0}, "no argument k=; use stiffness="),
        ("hinge", {"point": (0.0, 0.0)}, "no argument point=; use anchor="),
        (
            "contact",
            {"point": (0.0, 0.0), "normal": (0.0, 1.0), "depth": 0.01},
            "no argument depth=; use gap=, which is negative for penetration",
        ),
        ("hinge", {"nonsense": 1}, "no argument nonsense=; it takes a=, b=, anchor=, axis="),
    ],
)
def test_arguments_of_row_builders_suggest_ours(method, keywords, words):
    with pytest.raises(lv.InputError, match=words):
        getattr(make_builder(), method)(-1, 0, **keywords)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"mass": [1.0, 1.0]}, r"no argument mass=; use inv_mass=, which is 1 / mass \[1/kg\]"),
        ({"beta": 0.1}, "no argument beta=; use baumgarte="),
        ({"inertia": 1.0}, "no argument inertia=; use inv_inertia=, which is the inverse"),
    ],
)
def test_arguments_of_the_class_suggest_ours(changed, words):
    valid = {"velocity": np.zeros((2, 3)), "dt": 0.01, "position": np.zeros((2, 2))}
    with pytest.raises(lv.InputError, match=f"^RowBuilder has {words}"):
        lv.RowBuilder(**valid, **changed)


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
    with pytest.raises(AttributeError, match="no attribute 'contacts'; use contact"):
        builder.contacts  # noqa: B018
    with pytest.raises(lv.InputError, match="a separate bound for each tangent is a shape"):
        builder.problem("pyramid")


@pytest.mark.parametrize("name", ["method", "sovler", "algorithm"])
def test_other_names_of_the_solver_argument_suggest_it(name):
    with pytest.raises(lv.UnknownName, match="did you mean 'solver'"):
        lv.solve(LCP, **{name: "pgs"})


def test_no_solver_suggests_auto():
    with pytest.raises(lv.UnknownName, match="did you mean 'auto'"):
        lv.solve(LCP, None)


@pytest.mark.parametrize(
    ("name", "instead"),
    [
        ("converged", "success"),
        ("velocity", "residual.velocity"),
        ("error", "residual"),
        ("force", "impulse divided by dt"),
        ("carry", r"carry of the next problem: next_problem\.carry\(solution\)"),
    ],
)
def test_other_names_of_results_suggest_ours(name, instead):
    with pytest.raises(AttributeError, match=f"use {instead}"):
        getattr(lv.solve(LCP), name)


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
