"""Cones: what blocks may be, bounds, and the NumPy projection against its conditions."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_problems import random_contact_problem, seeds

import lavender as lv
from lavender.problem.cones import project_impulse

INVALID_PROBLEM = {
    "a kind that does not exist": (lambda: lv.Cones([0, 1], [9], [0], [1], [0], [0]), "9"),
    "ptr that falls": (lambda: lv.Cones([0, 2, 1], [0, 0], [0], [1], [0, 0], [0, 0]), "increase"),
    "an empty block": (lambda: lv.Cones([0, 0], [0], [], [], [0], [0]), "increase"),
    "one bound": (lambda: lv.Cones.bounded(0.0, 1.0), r"lower \[N s\] has shape \(\); \(any,\) is needed"),
    "crossed bounds": (lambda: lv.Cones.bounded(np.array([1.0]), np.array([0.0])), "lower <= upper"),
    "nothing between": (lambda: lv.Cones.bounded(np.array([np.inf]), np.array([np.inf])), "between"),
    "negative friction": (
        lambda: lv.Cones.contacts(np.array([-0.1])),
        r"mu must not be negative; entry \[0\]",
    ),
    "negative radius": (
        lambda: lv.Cones.contacts(np.array([0.5]), patch_radius=np.array([-1.0])),
        "patch_radius must not be negative",
    ),
    "six tangents": (lambda: lv.Cones.contacts(np.array([0.5]), tangents=6), "tangents"),
    "spin without a row": (lambda: lv.Cones([0, 1], [2], [0], [0], [0.5], [0.1]), "contact"),
    "mu of another number": (lambda: lv.Cones.contacts([0.5, 0.6], count=3), r"mu has shape \(2,\)"),
    "less than none": (lambda: lv.Cones.contacts(0.5, count=-1), "count is -1"),
    "a round cone of seven rows": (
        lambda: lv.Cones([0, 7], [lv.ROUND], np.zeros(7), np.zeros(7), [1.0], [0.0]),
        "a round cone of 7 rows",
    ),
    "spin beside a round cone": (lambda: lv.Cones.contacts(0.5, 3, 0.1), "leave patch_radius out"),
    "no such shape": (lambda: lv.Cones.contacts(0.5, shape="square"), "unknown shape 'square'"),
    "a side below zero": (lambda: lv.Cones.contacts([(0.5, -0.2)], shape="box"), "mu"),
    "three sides": (lambda: lv.Cones.contacts([(0.5, 0.1, 0.2)], shape="box"), "one for each tangent"),
    "a box that spins": (lambda: lv.Cones.contacts(0.5, 2, 0.1, shape="box"), "neither spin"),
    "a box of three tangents": (lambda: lv.Cones.contacts(0.5, 3, shape="box"), "up to two tangents"),
    "a box of four rows": (
        lambda: lv.Cones([0, 4], [4], np.zeros(4), np.ones(4), [0.5], [1.0]),
        "box of 4 rows",
    ),
    "an arm below zero": (lambda: lv.Cones.contacts(0.5, rolling=-0.1), "rolling.*-0.1"),
    "rolling on one tangent": (lambda: lv.Cones.contacts(0.5, 1, rolling=0.1), "tangents=2"),
    "rolling in a round cone": (lambda: lv.Cones.contacts(0.5, 5, rolling=0.1), "round cone"),
    "one arm for two": (lambda: lv.Cones.contacts([0.5, 0.5], rolling=[0.1]), "rolling"),
    "rolling in four rows": (
        lambda: lv.Cones([0, 4], [lv.CONTACT_ROLLING], np.zeros(4), np.ones(4), [0.5], [0.0], [0.1]),
        "5 or 6",
    ),
    "an ellipse without a side": (
        lambda: lv.Cones.contacts([(0.5, 0.0)]),
        r"contact 0 is \[0.5, 0.0\].*two numbers above 0",
    ),
    "an ellipse that is a line to rounding": (
        lambda: lv.Cones.contacts([(0.5, 0.5), (1e-30, 0.5)]),
        "contact 1 is",
    ),
    "an ellipse of one tangent": (lambda: lv.Cones.contacts([(0.5, 0.1)], 1), "neither spin nor rolling"),
    "an ellipse that spins": (
        lambda: lv.Cones.contacts([(0.5, 0.1)], patch_radius=0.1),
        "neither spin nor rolling",
    ),
    "an ellipse that spins, of a problem": (
        lambda: lv.Problem.contact(np.eye(3), np.ones(3), [(0.5, 0.1)], 0.1),
        "neither spin nor rolling",
    ),
    "an ellipse that rolls": (
        lambda: lv.Cones.contacts([(0.5, 0.1)], rolling=0.1),
        "neither spin nor rolling",
    ),
    "an ellipse of two rows": (
        lambda: lv.Cones([0, 2], [lv.CONTACT_ELLIPSE], np.zeros(2), np.ones(2), [0.5], [1.0]),
        "ellipse of 2 rows",
    ),
    "an ellipse whose sides have no ratio": (
        lambda: lv.Cones([0, 3], [lv.CONTACT_ELLIPSE], np.zeros(3), np.ones(3), [0.5], [0.0]),
        "mu_2 / mu_1 = 0",
    ),
    "an ellipse whose other side is beyond the door": (
        lambda: lv.Cones([0, 3], [lv.CONTACT_ELLIPSE], np.zeros(3), np.ones(3), [1e50], [1e12]),
        "mu_2.* must be at most 1e.60",
    ),
    "fewer rows than none": (lambda: lv.Cones.free(-1), "-1"),
    "more rows than 32 bits count": (lambda: lv.Cones.free(2**40), str(2**40)),
    "as many rows as 32 bits count": (lambda: lv.Cones.free(2**31 - 1), str(2**31 - 1)),
    "more contacts than 32 bits count": (lambda: lv.Cones.contacts(0.5, count=2**40), str(2**40)),
    "as many contacts as 32 bits count": (lambda: lv.Cones.contacts(0.5, count=2**31 - 1), str(2**31 - 1)),
    "rolling below zero": (
        lambda: lv.Cones([0, 5], [lv.CONTACT_ROLLING], np.zeros(5), np.ones(5), [0.5], [0.0], [-1.0]),
        "rolling.*-1",
    ),
}


@pytest.mark.parametrize("name", INVALID_PROBLEM)
def test_what_makes_no_cone_is_refused_with_its_reason(name):
    make, sign = INVALID_PROBLEM[name]
    with pytest.raises((lv.InputError, lv.UnknownName), match=sign):
        make()


def test_bounds_of_contact_rows_are_spelled_in_one_way():
    # They are never read: cones that differ there alone are equal.
    one = lv.Cones([0, 3], [1], [0.0, -1.0, -1.0], [9.0, 1.0, 1.0], [0.5], [0.0])
    two = lv.Cones([0, 3], [1], [5.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.5], [0.0])
    assert one == two
    assert one.lower[0] == 0.0
    with pytest.raises(TypeError):
        hash(one)


@given(seed=seeds, size=st.floats(1e-3, 1e3))
def test_projection_is_feasible_keeps_what_is_and_is_a_projection(seed, size):
    cones = random_contact_problem(seed, joints=2, contacts=4).cones
    x = size * np.random.default_rng(seed).standard_normal(cones.n_rows)
    y = project_impulse(cones, x)
    twice = project_impulse(cones, y)
    # Scaling a tangent back to its disk rounds once each time.
    np.testing.assert_allclose(twice, y, rtol=1e-15, atol=0.0)
    for i in range(cones.n_blocks):
        j, end, nt = cones.ptr[i], cones.ptr[i + 1], cones.n_tangents[i]
        if cones.kind[i] == lv.ROW:
            assert np.all(y[j:end] == np.clip(x[j:end], cones.lower[j:end], cones.upper[j:end]))
            continue
        assert y[j] == max(0.0, x[j])
        limit = cones.mu[i] * y[j]
        t, given_t = y[j + 1 : j + 1 + nt], x[j + 1 : j + 1 + nt]
        assert np.linalg.norm(t) <= limit * (1.0 + 1e-15)
        if np.linalg.norm(given_t) <= limit:
            assert np.all(t == given_t)
        elif nt:
            assert t @ given_t >= 0.0
        if cones.kind[i] == lv.CONTACT_SPIN:
            assert abs(y[end - 1]) <= cones.mu[i] * cones.patch_radius[i] * y[j]  # the reach first


@pytest.mark.parametrize(
    ("name", "at", "value", "words"),
    [
        ("lower", 0, 3.0, "row 0: lower = 3.0, upper = 2.0"),
        ("upper", 0, -np.inf, "row 0: lower = -inf, upper = -inf"),
        ("lower", 0, -1e61, "lower must be at most 1e[+]60"),
        ("mu", 1, -0.5, "mu must not be negative"),
        ("mu", 1, 1e-70, "mu must be 0 or at least 1e-60"),
        ("patch_radius", 1, -1.0, "patch_radius"),
        ("rolling", 0, -1.0, "rolling"),
        ("kind", 1, 4, "block 1 is a box"),
        ("ptr", 1, 0, "must start with 0 and increase"),
    ],
)
def test_faults_of_blocks_have_one_message_for_arrays_and_lists(name, at, value, words):
    cones = lv.Cones.bounded([-np.inf], [2.0]) + lv.Cones.contacts(0.5, 2, 0.1)
    fields = {
        n: np.array(getattr(cones, n))
        for n in ("ptr", "kind", "lower", "upper", "mu", "patch_radius", "rolling")
    }
    fields[name][at] = value
    messages = []
    for convert in (lambda x: x, lambda x: x.tolist()):
        with pytest.raises(lv.InputError) as raised:
            lv.Cones(**{n: convert(x) for n, x in fields.items()})
        messages.append(str(raised.value))
    assert messages[0] == messages[1]
    assert re.search(words, messages[0]), messages[0]
