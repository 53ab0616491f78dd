"""Invalid calls of the C library: an error number with a text, and nothing is written outside of its memory."""

import ctypes as ct
import re
from pathlib import Path

import numpy as np
import pytest
from clib import COUNTS, STRUCTS, SWEEPS, Options, Problem, Result, Verdict, functions
from header import parse_enum_constants, parse_struct_fields
from hypothesis import given
from hypothesis import strategies as st
from random_problems import as_matrix, random_contact_problem, random_lcp
from tower import self_test_problem
from vectors import ARRAYS, METHODS

import lavender as lv
from lavender.export import HEADER

ERRORS = {
    value: name
    for name, value in parse_enum_constants(HEADER.read_text()).items()
    if name.startswith("LAV_ERROR")
}
CANARY = 0xA5


class Guarded:
    """A solver in memory of exactly so many bytes, with marked bytes before and behind."""

    def __init__(self, library, problem, options, bytes_):
        self.c = library.c
        self.bytes = bytes_
        self.memory = (ct.c_ubyte * (bytes_ + 256))(*([CANARY] * (bytes_ + 256)))
        self.at = ct.c_void_p()
        begin = ct.addressof(self.memory) + 128
        self.code = self.c.lav_open(
            ct.c_void_p(begin),
            ct.c_uint64(bytes_),
            ct.byref(problem),
            ct.byref(options),
            ct.byref(self.at),
        )

    def is_intact(self):
        """Whether nothing was written before and behind the memory."""
        return set(self.memory[:128]) == set(self.memory[128 + self.bytes :]) == {CANARY}


def open_solver(library, method="sequential_impulses"):
    problem = library.problem(self_test_problem())
    options = library.options(method)
    solver = Guarded(library, problem, options, library.workspace(problem, options).value)
    assert solver.code == 0
    return solver, problem


def change(key, at, value):
    def apply(problem):
        array = problem.keep[key].copy()
        array.reshape(-1)[at] = value
        problem.keep[key] = array
        setattr(problem, key, array.ctypes.data)

    apply.array, apply.index = key, at
    return apply


def set_field(key, value):
    return lambda problem: setattr(problem, key, value)


def set_array(key, values):
    def apply(problem):
        problem.keep[key] = np.array(values)
        setattr(problem, key, problem.keep[key].ctypes.data)

    return apply


MISTAKES = {
    "struct of another version": (set_field("size", 8), "VERSION"),
    "form": (set_field("form", 9), "OPTION"),
    "law": (set_field("law", 5), "OPTION"),
    "rows below 0": (set_field("n_rows", -3), "COUNT"),
    "fewer rows than blocks": (set_field("n_rows", 3), "COUNT"),
    "entries below 0": (set_field("n_entries", -1), "COUNT"),
    "more joints than blocks": (set_field("n_joints", 99), "COUNT"),
    "joints that are contacts": (set_field("n_joints", 2), "BLOCKS"),
    "blocks that do not end": (change("block_ptr", -1, 35), "BLOCKS"),
    "blocks that go back": (change("block_ptr", 3, 1), "BLOCKS"),
    "a block far away": (change("block_ptr", 4, 2**30), "BLOCKS"),
    "no such kind": (change("kind", 2, 7), "BLOCKS"),
    "friction below 0": (change("mu", 1, -0.1), "FRICTION"),
    "friction not a number": (change("mu", 1, np.nan), "FRICTION"),
    "a body that is not there": (change("contact_body", 5, 3), "INDEX"),
    "a body below the world": (change("contact_body", 5, -2), "INDEX"),
    "NaN in b": (change("b", 0, np.nan), "NUMBER"),
    "an infinite normal": (change("normal", 4, np.inf), "NUMBER"),
    "NaN in an inertia": (change("inv_inertia", 9, np.nan), "NUMBER"),
    "a mass below 0": (change("inv_mass", 1, -1.0), "MASS"),
    "a compliance below 0": (change("compliance", 3, -1.0), "MASS"),
    "an inertia below 0": (change("inv_inertia", 13, -1.0), "MASS"),
    "an inertia that is not symmetric": (change("inv_inertia", 11, 0.5), "MASS"),
    "a normal of length 0": (change("normal", 14, 0.0), "FRAME"),
    "a normal of length 2": (change("normal", 14, 2.0), "FRAME"),
    "a tangent along the normal": (change("tangent", 14, 0.6), "FRAME"),
    "a body that touches itself": (change("contact_body", 10, 1), "PAIR"),
    "two static bodies": (change("contact_body", 1, -1), "PAIR"),
    "no masses": (set_field("inv_mass", None), "NULL"),
    "no normals": (set_field("normal", None), "NULL"),
    "no bodies of contacts": (set_field("contact_body", None), "NULL"),
    "rolling below 0": (set_array("rolling", [-0.1] * 12), "FRICTION"),
    "rolling not a number": (set_array("rolling", [np.nan] * 12), "FRICTION"),
    "rows that do not roll": (change("kind", 2, 5), "BLOCKS"),
    "a box of one tangent": (
        lambda q: (change("kind", 2, 4)(q), change("block_ptr", 3, 8)(q)),
        "BLOCKS",
    ),
    "an order with a block twice": (change("order", 1, 0), "INDEX"),
}


#: Mistakes of several numbers, with their count: any of these is named.
INEXACT_PLACES = {
    **dict.fromkeys(
        ("a normal of length 0", "a normal of length 2", "a tangent along the normal"), 3
    ),
    **dict.fromkeys(("an inertia below 0", "an inertia that is not symmetric"), 9),
    "two static bodies": 2,
}
ROWS = ("inv_mass", "inv_inertia", "contact_body", "normal", "tangent", "arm_a", "arm_b")


@pytest.mark.parametrize("mistake", MISTAKES)
def test_c_library_of_an_invalid_problem_returns_the_array_and_index_of_its_fault(library, mistake):
    solver, problem = open_solver(library)
    assert library.c.lav_set(solver.at, ct.byref(problem)) == 0
    problem.keep["order"] = np.arange(12, dtype=np.int32)
    apply, error = MISTAKES[mistake]
    apply(problem)
    code = library.c.lav_set(solver.at, ct.byref(problem))
    assert ERRORS[code] == f"LAV_ERROR_{error}"
    assert len(library.c.lav_text(code)) > 20
    if hasattr(apply, "array") and error != "BLOCKS":  # named, with the place of what it is part of
        at = ct.c_int32()
        assert library.c.lav_refused(solver.at, ct.byref(at)).decode() == apply.array
        size = INEXACT_PLACES.get(mistake, 1)
        assert at.value // size == apply.index % problem.keep[apply.array].size // size
        if apply.array in ROWS:  # as the package refuses it
            arrays = {name: problem.keep[name] for name in ROWS} | {
                "v_free": problem.keep["velocity"]
            }
            with pytest.raises(lv.InputError, match=apply.array):
                lv.Rows(**arrays)
    assert solver.is_intact()
    result = Result()
    result.size = ct.sizeof(Result)
    budget = library.budget(5, 0.0)
    assert (
        library.c.lav_run(solver.at, ct.byref(budget), ct.byref(result)) == -14
    )  # not the problem before
    assert (
        library.c.lav_set(solver.at, ct.byref(library.problem(self_test_problem()))) == 0
    )  # and goes on


def test_c_library_of_null_and_of_memory_without_a_solver_returns_different_errors(library):
    c = library.c
    q = Problem()
    o = Options()
    r = Result()
    assert (
        c.lav_set(None, ct.byref(q))
        == c.lav_run(None, None, None)
        == c.lav_impulse(None, None, 0)
        == -1
    )
    assert (
        c.lav_workspace_size(None, None, None)
        == c.lav_open(None, ct.c_uint64(8), None, None, None)
        == -1
    )
    nobody = (ct.c_double * 400)()
    assert c.lav_set(nobody, ct.byref(q)) == -15
    assert c.lav_default_options(99, ct.byref(o)) == c.lav_default_problem(0, ct.byref(q)) == -12
    solver, problem = open_solver(library)
    budget = library.budget(5, 0.0)
    assert c.lav_run(solver.at, ct.byref(budget), ct.byref(r)) == -14  # no problem yet
    assert c.lav_set(solver.at, ct.byref(problem)) == 0
    assert c.lav_run(solver.at, ct.byref(budget), ct.byref(r)) == -2  # its size is not filled in
    r.size = ct.sizeof(Result)
    budget.tol = np.nan
    assert c.lav_run(solver.at, ct.byref(budget), ct.byref(r)) == -12
    for value in (np.nan, np.inf, -1e-5):
        budget.tol = 0.0
        budget.velocity_tol = value
        assert c.lav_run(solver.at, ct.byref(budget), ct.byref(r)) == -12
    budget.velocity_tol, budget.seconds = 0.0, 1.0
    assert c.lav_run(solver.at, ct.byref(budget), ct.byref(r)) == -1  # a limit without a clock
    out = np.full(35, 7.0)
    assert c.lav_impulse(solver.at, ct.c_void_p(out.ctypes.data), 35) == -3 and set(out) == {7.0}
    assert solver.is_intact()


@pytest.mark.parametrize(
    "method", ["sequential_impulses", "block_gauss_seidel", "anderson", "nncg", "newton", "admm"]
)
def test_c_library_with_too_little_memory_returns_an_error_and_writes_inside_it(library, method):
    problem = library.problem(self_test_problem())
    options = library.options(method)
    seen = set()
    workspace = library.workspace(problem, options).value
    for bytes_ in [*range(0, workspace, workspace // 40), workspace]:
        solver = Guarded(library, problem, options, bytes_)
        if solver.code == 0:
            code = library.c.lav_set(solver.at, ct.byref(problem))
            seen.add(code)
            if code == -10:
                assert library.c.lav_needed(solver.at) > bytes_
        else:
            assert solver.code == -10
        assert solver.is_intact()
    assert seen == {0, -10}


@pytest.mark.parametrize("method", METHODS)
def test_c_solver_moved_to_more_memory_takes_a_larger_problem(library, method):
    """It keeps the impulses that it had; sweeps are moved at most once, factors at most three times."""
    small = random_lcp(1, m=3)
    c = library.c
    bodies = random_contact_problem(3, bodies=4, contacts=6)
    rng = np.random.default_rng(5)
    more = lv.Problem.linear(np.eye(60) + 0.01, rng.normal(size=60))
    free = lv.Problem.linear(np.eye(3) + 0.01, rng.normal(size=3))
    towers = [stack_of(n) for n in (1, 6)]
    grown = 0
    for few, many in (
        (free, more),
        (small, random_lcp(2, m=60)),
        (as_matrix(bodies), as_matrix(towers[1])),
        towers,
    ):
        problems = [
            library.problem(p, key=np.arange(p.n_blocks, dtype=np.uint64)) for p in (few, many)
        ]
        options = library.options(method)
        if any(c.lav_takes(ct.byref(q), ct.byref(options)) for q in problems):
            continue
        solver = library.open(problems[0], options)
        solver.run(50, 1e-6)
        before = solver.impulse()
        code = solver.set(problems[1])
        asked = 0
        while code == -10:
            needed = c.lav_needed(solver.at)
            memory = (ct.c_double * (needed // 8 + 2))()
            at = ct.c_void_p()
            assert c.lav_move(solver.at, memory, ct.c_uint64(needed), ct.byref(at)) == 0
            solver.at = at
            solver.memory = memory
            asked = asked + 1
            code = solver.set(problems[1])
        assert code == 0 and asked <= (
            1 if method in (*SWEEPS, "sor", "gauss_seidel", "jacobi") else 3
        )
        grown += asked
        same = (
            int(np.searchsorted(many.cones.ptr, few.m, side="right")) - 1
        )  # blocks of the same keys
        if np.array_equal(many.cones.kind[:same], few.cones.kind[:same]) and same == few.n_blocks:
            assert solver.impulse()[: few.m].tobytes() == before.tobytes()
    assert grown


def test_c_solver_that_is_running_rejects_other_calls(library):
    # From within the clock, which stands for another thread: the solver is busy until the run returns.
    solver, problem = open_solver(library)
    assert library.c.lav_set(solver.at, ct.byref(problem)) == 0
    said = []
    out, inner = Result(), Result()
    out.size = inner.size = ct.sizeof(Result)
    budget = library.budget(50, 0.0)

    def clock(_):
        said.append(library.c.lav_run(solver.at, ct.byref(library.budget(1, 0.0)), ct.byref(inner)))
        said.append(library.c.lav_set(solver.at, ct.byref(problem)))
        return float(len(said))

    kind = ct.CFUNCTYPE(ct.c_double, ct.c_void_p)
    kept = kind(clock)
    budget.seconds = 1e9
    budget.clock = ct.cast(kept, ct.c_void_p).value
    assert library.c.lav_run(solver.at, ct.byref(budget), ct.byref(out)) == 0
    assert set(said) == {-13} and out.iterations == 50
    budget.seconds = 3.0  # the clock goes on by two each time
    assert library.c.lav_run(solver.at, ct.byref(budget), ct.byref(out)) == 0
    assert out.outcome == 5 and 0 < out.iterations < 50


@pytest.mark.parametrize("form, method", [(1, "direct"), (2, "anderson"), (3, "newton")])
def test_c_library_counting_memory_reads_only_the_ends_of_joints(library, form, method):
    # Addresses that nothing may be read from: whoever does ends this process.
    problem = Problem()
    options = library.options(method)
    ptr = np.arange(0, 39, 3, dtype=np.int32)
    library.c.lav_default_problem(form, ct.byref(problem))
    for key, kind in Problem._fields_:
        if kind is ct.c_void_p:
            setattr(problem, key, ptr.ctypes.data if (form, key) == (2, "block_ptr") else 8)
    problem.n_rows, problem.n_blocks, problem.n_bodies, problem.n_joints = 30, 12, 5, 2
    problem.n_velocities, problem.n_entries, problem.n_mass_entries = 30, 60, 40
    assert Guarded(library, problem, options, library.workspace(problem, options).value).code == 0


def stack_of(n):
    """n unit boxes on one another, by a contact each."""
    z = np.tile([0.0, 0.0, 1.0], (n, 1))
    rows = lv.Rows(
        np.ones(n),
        np.tile(6.0 * np.eye(3), (n, 1, 1)),
        np.hstack([-z, 0.0 * z]),
        normal=z,
        tangent=np.roll(z, 1, axis=1),
        arm_a=0.5 * z,
        arm_b=-0.5 * z,
        contact_body=np.arange(n)[:, None] + [-1, 0],
    )
    return lv.Problem.from_rows(rows, mu=0.5, tangents=2)


SMALL = st.integers(-2, 9)
WHOLE = st.lists(st.integers(-3, 12), min_size=0, max_size=12)
REAL = st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=0, max_size=12)


@pytest.mark.slow
@pytest.mark.fuzz
@given(st.data())
def test_c_library_on_drawn_problems_writes_inside_its_memory(library, data):
    problem = Problem()
    keep = []
    form, method = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 12))
    library.c.lav_default_problem(form, ct.byref(problem))
    for key in COUNTS[1:]:
        setattr(problem, key, data.draw(SMALL))
    for key, _ in Problem._fields_[10:]:
        if data.draw(st.booleans()):
            x = np.zeros(900, ARRAYS[key])
            whole = x.dtype.kind != "f"
            if data.draw(st.booleans()) and key in ("block_ptr", "index_ptr", "mass_ptr"):
                x[:] = np.arange(900)  # what may well be rows of one entry
            values = data.draw(WHOLE if whole else REAL)
            with np.errstate(all="ignore"):
                x[: len(values)] = np.abs(values) if key == "key" else values
            keep.append(x)
            setattr(problem, key, x.ctypes.data)
    options = Options()
    workspace = ct.c_uint64()
    library.c.lav_default_options(method, ct.byref(options))
    code = library.c.lav_workspace_size(ct.byref(problem), ct.byref(options), ct.byref(workspace))
    assert code == 0 or code in ERRORS
    if code:
        return
    assert workspace.value < 10_000_000
    solver = Guarded(library, problem, options, workspace.value)
    assert solver.code == 0
    code = library.c.lav_set(solver.at, ct.byref(problem))
    assert code == 0 or code in ERRORS
    if code == 0:
        out, verdict = Result(), Verdict()
        out.size, verdict.size = ct.sizeof(Result), ct.sizeof(Verdict)
        budget = library.budget(5, 1e-9)
        assert library.c.lav_run(solver.at, ct.byref(budget), ct.byref(out)) == 0
        impulse = (ct.c_double * (problem.n_rows + 2))(*([7.0] * (problem.n_rows + 2)))
        assert library.c.lav_impulse(solver.at, impulse, problem.n_rows) == 0
        assert impulse[problem.n_rows] == 7.0
    assert solver.is_intact()


@pytest.mark.parametrize(
    "method, tol", [("sequential_impulses", 0.1), ("anderson", 0.01), ("nncg", 0.01)]
)
def test_c_library_budget_that_ends_within_tol_has_converged(library, method, tol):
    problem = self_test_problem()
    for n in range(1, 40):
        solver = library.open(library.problem(problem), library.options(method))
        solution = lv.solve(problem, method, tol=tol, max_iter=n)
        converged = solution.status is lv.Status.CONVERGED
        assert (solver.run(n, tol).outcome == 1) == solution.success == converged
    assert solution.success


def test_structs_have_the_released_layout_and_grow_only_at_the_end(library, folder):
    header = HEADER.read_text()
    made = [f"{kind} {name}({', '.join(arguments)})" for kind, name, arguments in functions(header)]
    made += [f"{name} = {value}" for name, value in parse_enum_constants(header).items()]
    for name in STRUCTS:
        made += [
            f"{name}[{i}] {kind} {field}"
            for i, (kind, field) in enumerate(parse_struct_fields(header, name))
        ]
    kept = (Path(__file__).parent / "abi.txt").read_text().splitlines()
    lost = [line for line in kept if line not in made]
    assert not lost, "what a release had is gone or is another"
    problem, options = Problem(), Options()
    library.c.lav_default_problem(1, ct.byref(problem))
    library.c.lav_default_options(1, ct.byref(options))
    assert (problem.size, options.size) == (ct.sizeof(Problem), ct.sizeof(Options))
    assert library.budget(1, 0.0).size == ct.sizeof(type(library.budget(1, 0.0)))
    names = {
        re.split(r"[ *]", line.split("(")[0])[-1]
        for line in kept
        if "(" in line and "[" not in line
    }
    assert all(hasattr(library.c, name) for name in names)


def test_box_without_a_ratio_has_the_friction_of_a_square(library):
    """patch_radius null: the ratio of a box is 1, as in Python, and its second tangent has friction."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(6, 8))
    cones = lv.Cones.contacts(np.full((2, 2), 0.5), shape="box")
    square = lv.Problem(np.array([2.0, 1.0, 3.0, 3.0, -2.0, 1.0]), cones, half @ half.T)
    assert square.cones.has_box
    method = "pgs"
    options = library.options(method)
    found = []
    for more in ({}, {"patch_radius": None}):
        solver = library.open(library.problem(square, **more), options)
        solver.run(50, 0.0)
        found.append(solver.impulse())
    np.testing.assert_array_equal(*found)
    second = square.cones.ptr[:-1][square.cones.is_box] + 2
    assert np.abs(found[1][second]).max() > 0.0
