"""Wrong arguments of the core, with their approved messages; unknown names and attributes."""

import copy
import json
import pickle
from dataclasses import fields, replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
from approved_texts import check_text
from gradient_problems import drawn
from random_problems import (
    as_matrix,
    dragged,
    random_bodies_and_contacts,
    random_generalized_problem,
)

import lavender as lv
from lavender.problem.ordering import compute_block_order

INF = np.inf
I2 = np.eye(2)
I3 = np.eye(3)
A = np.array([[2.0, 1.0], [1.0, 2.0]])
B = np.array([1.0, -1.0])
LCP = lv.Problem.lcp(A, B)
TINY = lv.Problem.lcp([[2.0]], [1.0])
CONTACT = lv.Problem.contact(I3, [10.0, 6.0, 0.0], mu=[0.5])
ROWS = random_bodies_and_contacts(np.random.default_rng(0))
ONE = sp.coo_array(np.ones(2))
GENERAL = random_generalized_problem(9, "cone")
PLANE = np.zeros((2, 3))
SPACE = np.zeros((2, 6))
TENSORS = np.tile(I3, (2, 1, 1))
contacts, bounded = lv.Cones.contacts, lv.Cones.bounded
QP = ("P", "q", "G", "h", "A", "b", "lb", "ub")


def two():
    """Build rows of two planar bodies."""
    return lv.RowBuilder([1.0, 1.0], [1.0, 1.0], PLANE, 0.01, [(0.0, 0.0), (1.0, 0.0)])


def two_rows(jac=(1.0, 1.0), mass=(1.0, 1.0), v_free=(1.0, 1.0), **more):
    """Build two rows on two velocities that nothing couples."""
    return lv.Problem.from_jacobian(
        np.diag(jac), np.diag(mass), v_free, cones=lv.Cones.free(2), **more
    )


def shortened():
    """Return a sparse A that has lost a number."""
    a = sp.csr_array(np.eye(2))
    a.data = a.data[:1]
    return a


def rows_with(**changes):
    return lv.Rows(
        **{f.name: getattr(ROWS, f.name) for f in fields(ROWS) if f.name != "copy"} | changes
    )


def late_batch(jac):
    """Build worlds of one row whose A_ii is the square of `jac`."""
    ones = np.ones((3, 1))
    return lv.Batch(
        np.full((3, 1, 1), jac), np.ones((3, 1, 1)), 0.0 * ones, target=ones, cones=lv.Cones.free(1)
    )


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

#: Calls with wrong arguments; tests/approved/messages.txt has their messages in this order.
ERRORS = {
    lv.InputError: [
        lambda: lv.Cones([0, 1], [9], [0], [1], [0], [0]),
        lambda: lv.Cones([0, 2, 1], [0, 0], [0], [1], [0, 0], [0, 0]),
        lambda: lv.Cones([0, 0], [0], [], [], [0], [0]),
        lambda: bounded(0.0, 1.0),
        lambda: bounded(np.array([1.0]), np.array([0.0])),
        lambda: bounded(np.array([INF]), np.array([INF])),
        lambda: contacts(np.array([-0.1])),
        lambda: contacts(np.array([0.5]), patch_radius=np.array([-1.0])),
        lambda: contacts(np.array([0.5]), tangents=6),
        lambda: contacts(0.5, patch_radius=0.1).shaped("box"),
        lambda: contacts(0.5, shape="box", patch_radius=0.1),
        lambda: contacts(0.5, tangents=3, patch_radius=0.1),
        lambda: contacts(0.5, tangents=1, rolling=0.1),
        lambda: contacts(np.ones((2, 3))),
        lambda: contacts([[0.5, 0.0]]),
        lambda: lv.Cones([0, 3], [lv.CONTACT_ELLIPSE], [0.0] * 3, [1.0] * 3, [0.5], [1e-20]),
        lambda: findex([0, -1, -1], [INF, 1, 1], [-1, 1, 0]),
        lambda: findex([0, -1, -1], [INF, 1, 1], [-1, 0, 1]),
        lambda: findex([0, -1, -1], [INF, 1, 1], [-1, 0, 3]),
        lambda: findex([0, -1, -1], [INF, INF, 1], [-1, 0, 0]),
        lambda: findex([0, -1, -1], [INF, np.nan, 1], [-1, 0, 0]),
        lambda: findex([0, 1, -1], [INF, -1, 1], [-1, 0, 0]),
        lambda: findex([0, 2, -1], [INF, 1, 1], [-1, -1, 0]),
        lambda: findex([0, -1, -1], [5, 1, 1], [-1, 0, 0]),
        lambda: findex([-1, -1, -1], [INF, 1, 1], [-1, 0, 0]),
        lambda: findex([0, -1], [INF, 1], [-1, 0, 0]),
        lambda: lv.Problem.from_findex(
            np.eye(4), np.ones(4), [0, -1, -1, -1], [INF, 1, 1, 1], [-1, 0, 0, 0]
        ),
        lambda: CONTACT.to_findex(),
        lambda: box(friction="cone").to_findex(),
        lambda: dragged(0, 3).to_findex(),
        lambda: lv.Generalized(np.ones((1, 2)), np.diag([1.0, 0.0]), np.zeros(2), ["hip", "knee"]),
        lambda: lv.Generalized(np.ones((1, 2)), [[1.0, 2.0], [2.0, 1.0]], np.zeros(2)),
        lambda: lv.Generalized(np.ones((1, 2)), np.triu(A), np.zeros(2), ["hip", "knee"]),
        lambda: lv.Generalized(np.ones((1, 2)), sp.csr_array(np.triu(A)), np.zeros(2)),
        lambda: lv.Generalized(np.ones((1, 3)), A, np.zeros(2)),
        lambda: lv.Generalized(np.ones((1, 2)), np.ones((2, 3)), np.zeros(2)),
        lambda: lv.Generalized(np.ones((1, 2)), A, np.zeros(2), ["hip"]),
        lambda: lv.Problem.from_jacobian(np.ones((1, 2)), A, np.zeros(2), cones=lv.Cones.free(2)),
        lambda: lv.Problem(
            np.zeros(1),
            lv.Cones.free(1),
            np.eye(1),
            generalized=lv.Generalized(np.ones((1, 2)), A, np.zeros(2)),
        ),
        lambda: GENERAL.updated(J=GENERAL.generalized.jac),
        lambda: GENERAL.updated(b=GENERAL.b, target=0.0),
        lambda: as_matrix(GENERAL).updated(v_free=GENERAL.generalized.v_free, target=0.0),
        lambda: GENERAL.updated(J=GENERAL.generalized.jac[:, 1:], target=0.0),
        *(
            partial(lv.Problem, np.ones(2), lv.Cones.free(2), **given)
            for given in (
                {"generalized": 3},
                {"rows": 3},
                {"generalized": GENERAL.generalized},
                {"rows": ROWS},
            )
        ),
        lambda: lv.Batch(
            np.ones((1, 4, 4)), np.eye(4)[None], np.ones((1, 4)), cones=contacts(0.5, 3)
        ),
        lambda: lv.Batch(
            np.ones((4, 2)),
            np.array([I2, I2]),
            np.ones((2, 2)),
            row_ptr=[0, 2, 4],
            cones=lv.Cones.free(1) + contacts(0.5),
        ),
        *(
            partial(lv.Batch, np.ones((2, 2, 2)), mass, np.ones((2, 2)), cones=contacts(0.5, 1))
            for mass in (
                (np.ones((2, 2)), [0, 1]),
                (np.ones((2, 2)), [1, 0], [0, 1, 2]),
                (np.ones((2, 3)), [0, 1], [0, 1, 2]),
            )
        ),
        lambda: lv.Problem.lcp(sp.csr_array([[1.0, 0.0], [2.0, INF]]), [1, 1]),
        lambda: lv.Problem.lcp(shortened(), [1, 1]),
        lambda: lv.Problem.lcp(np.ones((2, 3)), [1, 1]),
        lambda: lv.Problem.lcp(sp.csr_array(np.ones((2, 3))), [1, 1]),
        lambda: lv.Problem.lcp(I2, [1, 1], 2.0, 1.0),
        lambda: lv.Problem.contact(np.eye(5), np.ones(5), [1, 1]),
        lambda: lv.Problem.contact(np.eye(5), np.ones(5), [1]),
        *(
            partial(lv.Problem.contact, I3, np.ones(3), [1], friction=law)
            for law in ("couloumb", np.array([0.5, 0.5]))
        ),
        lambda: lv.Problem.lcp(I2, [1, 1], names=["a"]),
        lambda: lv.Problem.lcp(I2, [1, 1], key=[-1, 2]),
        lambda: lv.Problem.lcp(I2, [1, 1], compliance=[1, 1]),
        lambda: lv.Problem(np.ones(2), lv.Cones.free(2), I2, rows=ROWS),
        lambda: lv.Problem(np.ones(4), contacts(0.5, 3), np.eye(4)),
        lambda: lv.Problem(np.ones(2), lv.Cones.free(2)),
        lambda: lv.Problem(np.ones(2), None, I2),
        lambda: lv.Generalized(ONE, I2, [0, 0]),
        lambda: lv.Generalized(I2, ONE, [0, 0]),
        lambda: lv.Generalized(I2, sp.coo_array(np.ones((2, 2, 2))), [0, 0]),
        lambda: contacts(ONE),
        *(partial(lv.Problem.lcp, I2, [1, 1], names=names) for names in (7, np.array("x"))),
        lambda: lv.Generalized(I2, I2, [0, 0], names="ab"),
        lambda: lv.Problem.contact(I3, np.ones(3), 10.0).boxed(1e60),
        *(
            partial(rows_with, **changes)
            for changes in (
                {"contact_body": np.full((8, 2), [0, 9])},
                {"contact_body": np.full((8, 2), [0, -2])},
                {"contact_body": np.full((8, 2), [3, 3])},
                {"inv_mass": -np.ones(5)},
                {"normal": np.tile([0, 0, 2.0], (8, 1))},
                {
                    "normal": np.tile([1e60, 1e60, 0], (8, 1)),
                    "tangent": np.tile([1e60, -1e60, 0], (8, 1)),
                },
                {"tangent": np.tile([0, 0, 1.0], (8, 1)), "normal": np.tile([0, 0, 1.0], (8, 1))},
            )
        ),
        *(
            partial(lv.Problem.from_jacobian, np.eye(6), np.eye(6), np.ones(6), **bounds)
            for bounds in (
                {},
                {"mu": 0.7, "cones": contacts([0.7] * 2)},
                {"cones": contacts([0.7] * 2), "tangents": 2},
                {"mu": [0.7] * 3},
                {"mu": [0.7] * 4},
                {"mu": -0.7},
            )
        ),
        lambda: BUILDER.velocity_after(LCP, B),
        lambda: BUILDER.rows_of(3),
        *(partial(two().contact, a, b, (0.0, 0.0), (0.0, 1.0)) for a, b in ((0, 0), (-1, None))),
        lambda: two().contact(0, 1, (0.0, 0.0), (0.0, 1.0), name=3),
        lambda: [
            builder.contact(0, 1, (0.0, 0.0), (0.0, 1.0), feature=2) for builder in [two()] * 2
        ],
        lambda: two().contacts(
            [(0, 1)] * 2, PLANE[:, :2], np.tile([0.0, 1.0], (2, 1)), feature=[2, 2]
        ),
        lambda: BUILDER.problem("pyramid"),
        lambda: lv.solve(BUILDER),
        *(
            partial(lv.RowBuilder, [1.0, 1.0], inertia, velocity, 0.01, position)
            for inertia, velocity, position in (
                ([1.0, 1.0], PLANE, PLANE),
                ([1.0, 1.0], np.zeros((2, 2)), PLANE),
                (TENSORS, PLANE, SPACE),
            )
        ),
        *(partial(lv.solve, A, B, *bounds) for bounds in ((), (0.0, 1.0))),
        lambda: lv.solve(LCP, "pgs", B),
        *(
            partial(build, matrix, B[:1])
            for build in (
                lv.Problem.lcp,
                lv.Problem.linear,
                lambda a, b: lv.Problem.contact(a, b, 0.0),
            )
            for matrix in (A, A.tolist())
        ),
        lambda: lv.solve(LCP, B),
        lambda: lv.solve(LCP, FOUND),
        lambda: lv.solve(LCP, 1e-09),
        lambda: lv.solve(LCP, 10),
        lambda: lv.solve(LCP, impulse=np.ones(3)),
        lambda: LCP.carry(None),
        lambda: lv.solve(lv.Problem.lcp(I3, np.ones(3)), impulse=FOUND),
        *(
            partial(compute_block_order, lv.Problem.lcp(I3, np.ones(3)), **options)
            for options in (
                {"order": [0, 0, 2]},
                {"order": [0, 1]},
                {"order": "random", "seed": -1},
                {"order": "reverse", "seed": 3},
                {"order": "reverse", "ground": [0]},
                {"order": [2, 1, 0], "ground": [0]},
                {"order": "bottom_up", "ground": [3]},
            )
        ),
        lambda: lv.Problem.lcp(I2, [1.0, 1e61]),
        lambda: lv.Problem.lcp(I2, [1e-61, -1e-70]),
        lambda: lv.Problem.lcp(np.diag([1.0, 1e61]), [1.0, 1.0]),
        lambda: lv.Problem.lcp(I2, [1.0, 1.0], 0.0, [1.0, 1e300]),
        lambda: contacts([0.5, 1e-61]),
        lambda: contacts(0.5, patch_radius=[1e61]),
        lambda: contacts([1e-40], patch_radius=[1e-40]),
        lambda: contacts(0.5, rolling=[1e-200]),
        lambda: two_rows(compliance=[1.0, 1e-70]),
        lambda: two_rows(mass=(1.0, 1e-61)),
        lambda: two_rows(jac=(1.0, 1e61)),
        lambda: two_rows(v_free=(0.0, -1e61)),
        lambda: lv.solve(two_rows(jac=(1.0, 1e40), target=[1.0, 1.0])),
        lambda: late_batch(1e40)[1].d,
        lambda: LCP.updated(b=[1.0, 1e61]),
        lambda: compute_block_order(BUILT, "bottom_up", ground=[0]),
        lambda: lv.Problem.from_qp(SimpleNamespace(**dict.fromkeys(QP, None)), [1.0, 1.0]),
        lambda: lv.solve_qp(None),
        lambda: derivative().vjp(),
        lambda: derivative().jvp(),
        lambda: derivative().jvp(speed=B),
        lambda: derivative(P).jvp(M=np.triu(np.ones(P.generalized.mass.shape))),
        lambda: derivative().vjp(impulse=np.ones(3)).full("b"),
        lambda: lv.derivative(CONTACT, 0.99 * lv.solve(CONTACT, tol=1e-12).impulse),
        lambda: lv.derivative(CONTACT.updated(b=[9.0, 6.0, 0.0]), lv.solve(CONTACT, tol=1e-12)),
        lambda: lv.derivative(LCP, lv.solve(CONTACT)),
        *(
            partial(lv.register, replace(lv.get("pgs"), name=name))
            for name in ("my solver", "a\nb")
        ),
        lambda: lv.Scene(friction=1e-61),
        lambda: lv.Scene(gravity=1e61),
        lambda: lv.Scene().add_box(mass=1e-61),
        *(
            partial(build, I3, np.ones(3), cones=contacts(0.5))
            for build in (lv.Problem.linear, lv.Problem.lcp, partial(lv.Problem.contact, mu=[0.5]))
        ),
        lambda: CONTACT.boxed(-1.0),
        lambda: LCP.row_name(99),
        lambda: LCP.block_of(-1),
        lambda: lv.Problem.contact(I3, np.ones(3), mu=[0.5] * 3),
        lambda: lv.solve_qp(lv.Problem.from_qp(A, B), lb=B),
        lambda: lv.solve_qp(lv.Problem.from_qp(A, B, G=[[1.0, 2.0]], h=[-INF]), h=[1.0]),
        lambda: lv.derivatives([P] * 2, [ANSWER] * 2).vjp(
            velocity=np.full((2, P.generalized.nv), [[0.0], [np.nan]])
        ),
        lambda: lv.derivatives([P] * 2, lv.solve_many([LCP] * 2)),
        lambda: replace(two_rows(), angular=[0.5, 1.0]),
        lambda: FOUND.plot(rows=0),
        *(
            partial(lv.solve_many, late_batch(1.0), **more)
            for more in ({"like": [0.0]}, {"errors": "ignore"}, {"impulses": [np.ones(1)] * 3})
        ),
        lambda: lv.residual_many([LCP] * 2, [B, np.ones(3)]),
        lambda: lv.available(ordered=True),
        lambda: lv.explain(lv.Problem.lcp(np.zeros((0, 0)), [])),
        lambda: lv.motion_error(LCP, B, reference=[1.0]),
    ],
    lv.UnknownName: [
        *(partial(call, LCP, "pgs", maxiter=3) for call in (lv.solve, lv.prepare)),
        lambda: lv.solve(LCP, sovler="pgs"),
        *(partial(lv.solve, LCP, name) for name in ("PGS", "Newton", "newtn")),
        lambda: lv.solve(LCP, "jacobi", omgea=1.0),
        lambda: lv.solve(LCP, "pgs", order="colored", threads=2),
        lambda: lv.solve_many([LCP], "pgss"),
        lambda: contacts(0.5, shape="square"),
        lambda: compute_block_order(LCP, "bottomup"),
        lambda: lv.available(law="lpc"),
    ],
    lv.CapabilityError: [
        lambda: lv.solve(LCP, "direct", history=True),
        lambda: derivative().vjp(velocity=np.ones(3)),
        lambda: derivative().vjp(impulse=np.ones(3)).J,
    ],
    AttributeError: [
        lambda: delattr(GENERAL.generalized, "v_free"),
        lambda: setattr(GENERAL.generalized, "v_free", np.ones(2)),
        lambda: derivative().vjp(impulse=np.ones(3)).weight,
        lambda: lv.derivatives([P], [ANSWER]).vjp(impulse=[np.ones(P.m)]).M,
    ],
}


@pytest.mark.parametrize("error", ERRORS)
def test_wrong_arguments_together_raise_the_approved_messages(error):
    messages = []
    for number, call in enumerate(ERRORS[error]):
        try:
            call()
        except error as raised:
            messages.append(str(raised))
        else:
            raise AssertionError(f"call {number} raises no {error.__name__}")
    check_text("messages.txt", error.__name__, "\n".join(messages))


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
