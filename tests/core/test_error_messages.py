"""Wrong arguments of the core, each with the words of its error; unknown names and attributes."""

import copy
import json
import pickle
from dataclasses import fields
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
from gradient_problems import drawn
from random_problems import as_matrix, dragged, random_bodies_and_contacts, random_generalized_problem

import lavender as lv
from lavender.problem.ordering import compute_block_order

INF, I2, I3 = np.inf, np.eye(2), np.eye(3)
A, B = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0])
LCP = lv.Problem.lcp(A, B)
TINY = lv.Problem.lcp([[2.0]], [1.0])
CONTACT = lv.Problem.contact(I3, [10.0, 6.0, 0.0], mu=[0.5])
ROWS, ONE = random_bodies_and_contacts(np.random.default_rng(0)), sp.coo_array(np.ones(2))
GENERAL = random_generalized_problem(9, "cone")
PLANE, SPACE, TENSORS = np.zeros((2, 3)), np.zeros((2, 6)), np.tile(I3, (2, 1, 1))
contacts, bounded = lv.Cones.contacts, lv.Cones.bounded
QP = ("P", "q", "G", "h", "A", "b", "lb", "ub")
SWAPPED = "so the two seem to be swapped: the order is inv_mass, inv_inertia, velocity, dt, position"


def two():
    """Build rows of two planar bodies."""
    return lv.RowBuilder([1.0, 1.0], [1.0, 1.0], PLANE, 0.01, [(0.0, 0.0), (1.0, 0.0)])


def two_rows(jac=(1.0, 1.0), mass=(1.0, 1.0), v_free=(1.0, 1.0), **more):
    """Build two rows on two velocities that nothing couples."""
    return lv.Problem.from_jacobian(np.diag(jac), np.diag(mass), v_free, cones=lv.Cones.free(2), **more)


def shortened():
    """Return a sparse A that has lost a number."""
    a = sp.csr_array(np.eye(2))
    a.data = a.data[:1]
    return a


def rows_with(**changes):
    return lv.Rows(**{f.name: getattr(ROWS, f.name) for f in fields(ROWS) if f.name != "copy"} | changes)


def late_batch(jac):
    """Build worlds of one row whose A_ii is the square of `jac`."""
    ones = np.ones((3, 1))
    return lv.Batch(np.full((3, 1, 1), jac), np.ones((3, 1, 1)), 0.0 * ones, target=ones, cones=lv.Cones.free(1))


def solved_builder():
    builder = two()
    builder.contact(-1, 0, (0.0, 0.0), (0.0, 1.0), mu=0.5)
    return builder, builder.problem(), lv.solve(builder.problem())


def derivative(problem=CONTACT):
    return lv.derivative(problem, lv.solve(problem, tol=1e-12))


def box(mu=None, **more):
    return dragged(1, 4, mu, "box", **more)


def findex(low, high, index):
    return lv.Problem.from_findex(I3, np.ones(3), low, high, index)


P = drawn(0, "disk", "cone", "generalized")
ANSWER = lv.solve(P, tol=1e-14)
BUILDER, BUILT, FOUND = solved_builder()

ERRORS = {
    lv.InputError: [
        # Cones
        (lambda: lv.Cones([0, 1], [9], [0], [1], [0], [0]), "9"),
        (lambda: lv.Cones([0, 2, 1], [0, 0], [0], [1], [0, 0], [0, 0]), "increase"),
        (lambda: lv.Cones([0, 0], [0], [], [], [0], [0]), "increase"),
        (lambda: bounded(0.0, 1.0), r"lower \[N s\] has shape \(\); \(any,\) is needed"),
        (lambda: bounded(np.array([1.0]), np.array([0.0])), "lower <= upper"),
        (lambda: bounded(np.array([INF]), np.array([INF])), "between"),
        (lambda: contacts(np.array([-0.1])), r"mu must not be negative; entry \[0\]"),
        (lambda: contacts(np.array([0.5]), patch_radius=np.array([-1.0])), "patch_radius must not be negative"),
        (lambda: contacts(np.array([0.5]), tangents=6), "tangents"),
        (lambda: contacts(0.5, patch_radius=0.1).shaped("box"), "a box cannot bound spin or rolling"),
        (lambda: contacts(0.5, shape="box", patch_radius=0.1), "a box has up to two tangents"),
        (lambda: contacts(0.5, tangents=3, patch_radius=0.1), "which includes spin: leave patch_radius out"),
        (lambda: contacts(0.5, tangents=1, rolling=0.1), "rolling needs tangents=2"),
        (lambda: contacts(np.ones((2, 3))), r"\(k, 2\), one for each tangent"),
        (lambda: contacts([[0.5, 0.0]]), "give shape='box' for a tangent without friction"),
        (lambda: lv.Cones([0, 3], [lv.CONTACT_ELLIPSE], [0.0] * 3, [1.0] * 3, [0.5], [1e-20]), "1e-18 to 1e18"),
        # findex
        (lambda: findex([0, -1, -1], [INF, 1, 1], [-1, 1, 0]), "its own row"),
        (lambda: findex([0, -1, -1], [INF, 1, 1], [-1, 0, 1]), "its own findex is 0"),
        (lambda: findex([0, -1, -1], [INF, 1, 1], [-1, 0, 3]), "a row below 3"),
        (lambda: findex([0, -1, -1], [INF, INF, 1], [-1, 0, 0]), "upper is mu"),
        (lambda: findex([0, -1, -1], [INF, np.nan, 1], [-1, 0, 0]), "upper is mu"),
        (lambda: findex([0, 1, -1], [INF, -1, 1], [-1, 0, 0]), "upper is mu"),
        (lambda: findex([0, 2, -1], [INF, 1, 1], [-1, -1, 0]), "lower <= upper"),
        (lambda: findex([0, -1, -1], [5, 1, 1], [-1, 0, 0]), r"a normal needs \[0, inf\]"),
        (lambda: findex([-1, -1, -1], [INF, 1, 1], [-1, 0, 0]), r"a normal needs \[0, inf\]"),
        (lambda: findex([0, -1], [INF, 1], [-1, 0, 0]), "shape"),
        (lambda: lv.Problem.from_findex(np.eye(4), np.ones(4), [0, -1, -1, -1], [INF, 1, 1, 1], [-1, 0, 0, 0]),
         "3 rows have findex 0"),
        (lambda: CONTACT.to_findex(), r"shaped\('box'\)"),
        (lambda: box(friction="cone").to_findex(), r"relaxed\('coulomb'\)"),
        (lambda: dragged(0, 3).to_findex(), "which bounds the norm of its tangents"),
        # J and M
        (lambda: lv.Generalized(np.ones((1, 2)), np.diag([1.0, 0.0]), np.zeros(2), ["hip", "knee"]),
         r"not positive definite: the pivot of knee"),
        (lambda: lv.Generalized(np.ones((1, 2)), [[1.0, 2.0], [2.0, 1.0]], np.zeros(2)), "not positive definite"),
        (lambda: lv.Generalized(np.ones((1, 2)), np.triu(A), np.zeros(2), ["hip", "knee"]),
         r"not symmetric: it is 0\.0 at \(knee, hip\) and 1\.0 at \(hip, knee\)"),
        (lambda: lv.Generalized(np.ones((1, 2)), sp.csr_array(np.triu(A)), np.zeros(2)), "not symmetric"),
        (lambda: lv.Generalized(np.ones((1, 3)), A, np.zeros(2)),
         r"J has shape \(1, 3\); \(any, 2\) is needed, as M has 2"),
        (lambda: lv.Generalized(np.ones((1, 2)), np.ones((2, 3)), np.zeros(2)), "a square matrix"),
        (lambda: lv.Generalized(np.ones((1, 2)), A, np.zeros(2), ["hip"]), "1 entries for 2"),
        (lambda: lv.Problem.from_jacobian(np.ones((1, 2)), A, np.zeros(2), cones=lv.Cones.free(2)),
         "J has 1 rows; 2 are needed"),
        (lambda: lv.Problem(np.zeros(1), lv.Cones.free(1), np.eye(1),
                            generalized=lv.Generalized(np.ones((1, 2)), A, np.zeros(2))), "exactly one is needed"),
        (lambda: GENERAL.updated(J=GENERAL.generalized.jac), "give target or b"),
        (lambda: GENERAL.updated(b=GENERAL.b, target=0.0), "give one of the two"),
        (lambda: as_matrix(GENERAL).updated(v_free=GENERAL.generalized.v_free, target=0.0), "generalised coordinates"),
        (lambda: GENERAL.updated(J=GENERAL.generalized.jac[:, 1:], target=0.0), "J has shape"),
        *((partial(lv.Problem, np.ones(2), lv.Cones.free(2), **given), words) for given, words in (
            ({"generalized": 3}, "a Generalized is needed"), ({"rows": 3}, "a Rows is needed"),
            ({"generalized": GENERAL.generalized}, "J has .* rows; 2 are needed, as the cones have"),
            ({"rows": ROWS}, "a block of bounded rows for each joint is needed"))),
        # Batches
        (lambda: lv.Batch(np.ones((1, 4, 4)), np.eye(4)[None], np.ones((1, 4)), cones=contacts(0.5, 3)), "round cone"),
        (lambda: lv.Batch(np.ones((4, 2)), np.array([I2, I2]), np.ones((2, 2)), row_ptr=[0, 2, 4],
                          cones=lv.Cones.free(1) + contacts(0.5)), "do not begin and end with the 2 rows of world 0"),
        *((partial(lv.Batch, np.ones((2, 2, 2)), mass, np.ones((2, 2)), cones=contacts(0.5, 1)), words)
          for mass, words in (((np.ones((2, 2)), [0, 1]), "three are needed"),
                              ((np.ones((2, 2)), [1, 0], [0, 1, 2]), "do not describe a lower triangle"),
                              ((np.ones((2, 3)), [0, 1], [0, 1, 2]), r"values of M have shape \(2, 3\)"))),
        # Problems and rows
        (lambda: lv.Problem.lcp(sp.csr_array([[1.0, 0.0], [2.0, INF]]), [1, 1]), r"entry \[1, 1\] is inf"),
        (lambda: lv.Problem.lcp(shortened(), [1, 1]), "A is not a valid compressed matrix"),
        (lambda: lv.Problem.lcp(np.ones((2, 3)), [1, 1]), r"shape \(2, 3\); \(2, 2\) is needed"),
        (lambda: lv.Problem.lcp(sp.csr_array(np.ones((2, 3))), [1, 1]), r"\(2, 2\) is needed"),
        (lambda: lv.Problem.lcp(I2, [1, 1], 2.0, 1.0), "row 0: lower = 2.0, upper = 1.0"),
        (lambda: lv.Problem.contact(np.eye(5), np.ones(5), [1, 1]), "5 rows, which is not a multiple"),
        (lambda: lv.Problem.contact(np.eye(5), np.ones(5), [1]), "up to two tangent rows"),
        *((partial(lv.Problem.contact, I3, np.ones(3), [1], friction=law), "'coulomb' or 'cone'")
          for law in ("couloumb", np.array([0.5, 0.5]))),
        (lambda: lv.Problem.lcp(I2, [1, 1], names=["a"]), "1 entries for 2 blocks"),
        (lambda: lv.Problem.lcp(I2, [1, 1], key=[-1, 2]), r"key has -1 at \[0\]"),
        (lambda: lv.Problem.lcp(I2, [1, 1], compliance=[1, 1]), "already contains compliance on its diagonal"),
        (lambda: lv.Problem(np.ones(2), lv.Cones.free(2), I2, rows=ROWS), "exactly one is needed"),
        (lambda: lv.Problem(np.ones(4), contacts(0.5, 3), np.eye(4)), "law is not supported for a round cone"),
        (lambda: lv.Problem(np.ones(2), lv.Cones.free(2)), "exactly one is needed"),
        (lambda: lv.Problem(np.ones(2), None, I2), "a Cones is needed"),
        (lambda: lv.Generalized(ONE, I2, [0, 0]), r"J has shape \(2,\)"),
        (lambda: lv.Generalized(I2, ONE, [0, 0]), r"M has shape \(2,\)"),
        (lambda: lv.Generalized(I2, sp.coo_array(np.ones((2, 2, 2))), [0, 0]), "a square"),
        (lambda: contacts(ONE), "mu has dtype object"),
        *((partial(lv.Problem.lcp, I2, [1, 1], names=names), "a sequence of 2 words") for names in (7, np.array("x"))),
        (lambda: lv.Generalized(I2, I2, [0, 0], names="ab"), "a sequence of 2 words"),
        (lambda: lv.Problem.contact(I3, np.ones(3), 10.0).boxed(1e60), r"mu N \[N s\] must be at most 1e\+60"),
        *((partial(rows_with, **changes), words) for changes, words in (
            ({"contact_body": np.full((8, 2), [0, 9])}, "body 9; there are 5 bodies"),
            ({"contact_body": np.full((8, 2), [0, -2])}, "body -2"),
            ({"contact_body": np.full((8, 2), [3, 3])}, r"is \[3, 3\]; two different"),
            ({"inv_mass": -np.ones(5)}, "inv_mass must not be negative"),
            ({"normal": np.tile([0, 0, 2.0], (8, 1))}, "orthogonal unit vectors"),
            ({"normal": np.tile([1e60, 1e60, 0], (8, 1)), "tangent": np.tile([1e60, -1e60, 0], (8, 1))},
             r"off by 1.4e\+60"),
            ({"tangent": np.tile([0, 0, 1.0], (8, 1)), "normal": np.tile([0, 0, 1.0], (8, 1))}, "orthogonal"))),
        *((partial(lv.Problem.from_jacobian, np.eye(6), np.eye(6), np.ones(6), **bounds), words) for bounds, words in (
            ({}, "cones and mu are missing"),
            ({"mu": 0.7, "cones": contacts([0.7] * 2)}, "cones and mu are both given"),
            ({"cones": contacts([0.7] * 2), "tangents": 2}, "tangents has no effect without mu"),
            ({"mu": [0.7] * 3}, "J has 6 rows and mu 3 values.*tangents=1"),
            ({"mu": [0.7] * 4}, "J has 6 rows, which is not a multiple of the 4 values of mu"), ({"mu": -0.7}, "mu"))),
        (lambda: BUILDER.velocity_after(LCP, B), r"the result of RowBuilder\.problem\(\) is needed"),
        (lambda: BUILDER.rows_of(3), "a key that a method of this builder returned"),
        *((partial(two().contact, a, b, (0.0, 0.0), (0.0, 1.0)), words) for a, b, words in (
            (0, 0, "a and b are both body 0"), (-1, None, "a and b are both the static world"))),
        (lambda: two().contact(0, 1, (0.0, 0.0), (0.0, 1.0), name=3), "name is 3; a text is needed"),
        (lambda: [builder.contact(0, 1, (0.0, 0.0), (0.0, 1.0), feature=2) for builder in [two()] * 2],
         "feature is 2, which another contact of body 0 and body 1 already has"),
        (lambda: two().contacts([(0, 1)] * 2, PLANE[:, :2], np.tile([0.0, 1.0], (2, 1)), feature=[2, 2]),
         "contact 1: an earlier one of the same bodies has its feature|which another contact"),
        (lambda: BUILDER.problem("pyramid"), "a separate bound for each tangent is a shape"),
        (lambda: lv.solve(BUILDER), r"is a RowBuilder; .* give the result of its \.problem\(\)"),
        *((partial(lv.RowBuilder, [1.0, 1.0], inertia, velocity, 0.01, position), rf"^position \[m\] has shape {words}")
          for inertia, velocity, position, words in (
              ([1.0, 1.0], PLANE, PLANE, r"\(2, 3\).*three dimensions, but velocity .* position \(2, 2\) is needed"),
              ([1.0, 1.0], np.zeros((2, 2)), PLANE, rf"\(2, 3\).*{SWAPPED}"),
              (TENSORS, PLANE, SPACE, rf"\(2, 6\).*{SWAPPED}"))),
        # Names, and arguments in the place of others
        *((partial(lv.solve, A, B, *bounds), r"problem is a ndarray; .* Problem\.lcp\(A, b, lower, upper\)")
          for bounds in ((), (0.0, 1.0))),
        (lambda: lv.solve(LCP, "pgs", B), r"solve has 3 positional arguments; .* all others by name"),
        *((partial(build, matrix, B[:1]), r"^b \[m/s\] has shape \(1,\); \(2,\) is needed, as A has 2 rows")
          for build in (lv.Problem.lcp, lv.Problem.linear, lambda a, b: lv.Problem.contact(a, b, 0.0))
          for matrix in (A, A.tolist())),
        (lambda: lv.solve(LCP, B), r"solver is a ndarray; .*solve\(problem, impulse=\.\.\.\)"),
        (lambda: lv.solve(LCP, FOUND), r"solver is a Solution; .*solve\(problem, impulse=solution\)"),
        (lambda: lv.solve(LCP, 1e-9), r"solver is 1e-09; .*solve\(problem, tol=\.\.\.\)"),
        (lambda: lv.solve(LCP, 10), r"solver is 10; .*solve\(problem, max_iter=\.\.\.\)"),
        (lambda: lv.solve(LCP, impulse=np.ones(3)),
         r"impulse \[N s\] has shape \(3,\); \(2,\) is needed.*give the solution of that step"),
        (lambda: LCP.carry(None), r"previous is None; .* the first step .* without impulse="),
        (lambda: lv.solve(lv.Problem.lcp(I3, np.ones(3)), impulse=FOUND),
         r"no keys in .* blocks differ \(3 now, 1 before"),
        # Orders
        *((partial(compute_block_order, lv.Problem.lcp(I3, np.ones(3)), **options), words) for options, words in (
            ({"order": [0, 0, 2]}, "once"), ({"order": [0, 1]}, "shape"), ({"order": "random", "seed": -1}, "seed"),
            ({"order": "reverse", "seed": 3}, "random"), ({"order": "reverse", "ground": [0]}, "ground"),
            ({"order": [2, 1, 0], "ground": [0]}, "ground"), ({"order": "bottom_up", "ground": [3]}, "3 blocks"))),
        # Numbers out of range
        *((call, rf"(?s)\b{name}.*e[+-]60") for call, name in (
            (lambda: lv.Problem.lcp(I2, [1.0, 1e61]), "b"), (lambda: lv.Problem.lcp(I2, [1e-61, -1e-70]), "b"),
            (lambda: lv.Problem.lcp(np.diag([1.0, 1e61]), [1.0, 1.0]), "A"),
            (lambda: lv.Problem.lcp(I2, [1.0, 1.0], 0.0, [1.0, 1e300]), "upper"),
            (lambda: contacts([0.5, 1e-61]), "mu"), (lambda: contacts(0.5, patch_radius=[1e61]), "patch_radius"),
            (lambda: contacts([1e-40], patch_radius=[1e-40]), "mu patch_radius"),
            (lambda: contacts(0.5, rolling=[1e-200]), "rolling"),
            (lambda: two_rows(compliance=[1.0, 1e-70]), "compliance"), (lambda: two_rows(mass=(1.0, 1e-61)), "M"),
            (lambda: two_rows(jac=(1.0, 1e61)), "J"), (lambda: two_rows(v_free=(0.0, -1e61)), "v_free"),
            (lambda: lv.solve(two_rows(jac=(1.0, 1e40), target=[1.0, 1.0])), "A_ii"),
            (lambda: late_batch(1e40)[1].d, "A_ii"), (lambda: LCP.updated(b=[1.0, 1e61]), "b"))),
        (lambda: compute_block_order(BUILT, "bottom_up", ground=[0]), "ground= is given for a problem with rows"),
        (lambda: lv.Problem.from_qp(SimpleNamespace(**dict.fromkeys(QP, None)), [1.0, 1.0]), "give it alone"),
        (lambda: lv.Problem.from_qp(I2, [1, 1], G=I2, h=[1.0, -INF]), r"h is -inf at \[1\], which no x satisfies"),
        (lambda: lv.solve_qp(None), "P and q are missing; q is needed"),
        # Derivatives
        (lambda: derivative().vjp(), "no cotangent of the solution is given"),
        (lambda: derivative().jvp(), "no change of the data is given"),
        (lambda: derivative().jvp(speed=B), "'speed' is not among the data of this problem"),
        (lambda: derivative(P).jvp(M=np.triu(np.ones(P.generalized.mass.shape))), "the change of M must be symmetric"),
        (lambda: derivative().vjp(impulse=np.ones(3)).full("b"), "'b' is not a matrix with a pattern"),
        (lambda: lv.derivative(CONTACT, 0.99 * lv.solve(CONTACT, tol=1e-12).impulse),
         r"relative residual is 1\.\d\de-02.*needs at most 1e-08, or the round-off floor.*solve with tol"),
        (lambda: lv.derivative(CONTACT.updated(b=[9.0, 6.0, 0.0]), lv.solve(CONTACT, tol=1e-12)),
         "the impulse is not a solution"),
        (lambda: lv.derivative(LCP, lv.solve(CONTACT)), r"impulse \[N s\] has shape \(3,\); \(2,\)"),
    ],
    lv.UnknownName: [
        *((partial(call, LCP, "pgs", maxiter=3), r"unknown option 'maxiter' .*did you mean 'max_iter'")
          for call in (lv.solve, lv.prepare)),
        (lambda: lv.solve(LCP, sovler="pgs"), "did you mean 'solver'"),
        *((partial(lv.solve, LCP, name), f"^unknown solver '{name}'; did you mean '{near}'[?]$")
          for name, near in (("PGS", "pgs"), ("Newton", "newton"), ("newtn", "newton"))),
        (lambda: lv.solve(LCP, "jacobi", omgea=1.0), "omega"),
        (lambda: lv.solve(LCP, "pgs", order="colored", threads=2), "threads"),
        (lambda: lv.solve_many([LCP], "pgss"), "pgs"),
        (lambda: contacts(0.5, shape="square"), "unknown shape 'square'"),
        (lambda: compute_block_order(LCP, "bottomup"), "bottom_up"),
    ],
    lv.CapabilityError: [
        (lambda: lv.solve(LCP, "direct", history=True), r"lavender\.available\(problem, history=True\)"),
        (lambda: derivative().vjp(velocity=np.ones(3)), "given as a matrix"),
        (lambda: derivative().vjp(impulse=np.ones(3)).J, "J exists only for problems given as rows or generalized"),
    ],
    AttributeError: [
        (lambda: delattr(GENERAL.generalized, "v_free"), "immutable"),
        (lambda: setattr(GENERAL.generalized, "v_free", np.ones(2)), "immutable"),
        (lambda: derivative().vjp(impulse=np.ones(3)).weight, "a gradient has no 'weight'"),
        (lambda: lv.derivatives([P], [ANSWER]).vjp(impulse=[np.ones(P.m)]).M,
         r"gradients of all problems have no attribute 'M'; gradients\[i\]"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("call", "words", "error"),
    [pytest.param(call, words, error, id=words) for error, cases in ERRORS.items() for call, words in cases],
)
def test_wrong_arguments_together_raise_an_error_with_these_words(call, words, error):
    with pytest.raises(error, match=words) as raised:
        call()
    assert type(raised.value) is not lv.InputError or isinstance(raised.value, ValueError)


@pytest.mark.parametrize("owner", [LCP.cones, lv.residual(LCP, np.zeros(2)), FOUND, lv], ids=type)
def test_unknown_attributes_raise_attribute_error_with_the_name(owner):
    with pytest.raises(AttributeError, match="no attribute 'nonsense'") as raised:
        owner.nonsense  # noqa: B018
    assert raised.value.name == "nonsense"  # Python suggests the nearest name in the traceback.


def test_status_equals_its_name_when_compared_copied_or_written():
    solution = lv.solve(TINY)
    assert solution.status == "CONVERGED" and solution.status != "STALLED"
    assert (lv.solve_many([TINY] * 2).status == "CONVERGED").all()
    for status in lv.Status:
        assert status == status.name == str(status) == f"{status}" and len(status.description) > 10
        assert lv.Status(status.name) is lv.Status[status.name] is status
        assert pickle.loads(pickle.dumps(status)) is copy.deepcopy(status) is status
        assert json.loads(json.dumps(status)) == status.name and {status.name: 1}[status] == 1
