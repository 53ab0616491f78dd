"""Cones: what blocks may be, bounds, and the NumPy projection against its conditions."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_problems import random_contact_problem, seeds

import lavender as lv
from lavender.cones import project

REFUSED = {
    "a kind that does not exist": (lambda: lv.Cones([0, 1], [9], [0], [1], [0], [0]), "9"),
    "ptr that falls": (lambda: lv.Cones([0, 2, 1], [0, 0], [0], [1], [0, 0], [0, 0]), "increase"),
    "an empty block": (lambda: lv.Cones([0, 0], [0], [], [], [0], [0]), "increase"),
    "crossed bounds": (lambda: lv.Cones.bounded(np.array([1.0]), np.array([0.0])), "lower <= upper"),
    "nothing between": (lambda: lv.Cones.bounded(np.array([np.inf]), np.array([np.inf])), "between"),
    "bounds nan": (lambda: lv.Cones.bounded(np.array([np.nan]), np.array([1.0])), "lower"),
    "negative friction": (lambda: lv.Cones.contacts(np.array([-0.1])), "mu"),
    "friction nan": (lambda: lv.Cones.contacts(np.array([np.nan])), "mu"),
    "negative radius": (
        lambda: lv.Cones.contacts(np.array([0.5]), patch_radius=np.array([-1.0])),
        "patch_radius",
    ),
    "six tangents": (lambda: lv.Cones.contacts(np.array([0.5]), tangents=6), "tangents"),
    "spin without a row": (lambda: lv.Cones([0, 1], [2], [0], [0], [0.5], [0.1]), "contact"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_makes_no_cone_is_refused_with_its_reason(name):
    make, sign = REFUSED[name]
    with pytest.raises(lv.InputError, match=sign):
        make()


def test_sizes_and_kinds():
    free, boxed = lv.Cones.free(3), lv.Cones.bounded(np.zeros(2), np.full(2, np.inf))
    contacts = lv.Cones.contacts(np.array([0.5, 0.2]), patch_radius=np.array([0.1, 0.0]))
    assert (free.n_rows, free.n_blocks, free.is_free, free.is_bounded_rows) == (3, 3, True, True)
    assert (boxed.is_free, boxed.is_bounded_rows) == (False, True)
    assert (contacts.n_rows, contacts.n_blocks, contacts.is_bounded_rows) == (8, 2, False)
    assert contacts.n_tangents.tolist() == [2, 2]
    assert lv.Cones.contacts(np.array([0.0]), tangents=0).is_bounded_rows


def test_bounds_of_contact_rows_are_spelled_in_one_way():
    # They are never read: cones that differ there alone are equal.
    one = lv.Cones([0, 3], [1], [0.0, -1.0, -1.0], [9.0, 1.0, 1.0], [0.5], [0.0])
    two = lv.Cones([0, 3], [1], [5.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.5], [0.0])
    assert one == two
    assert one.lower[0] == 0.0


def test_arrays_stay_read_only_in_copies_and_pickles():
    cones = lv.Cones.contacts(np.array([0.5]))
    for other in (cones, copy.deepcopy(cones), pickle.loads(pickle.dumps(cones))):
        assert other == cones
        for name in ("ptr", "kind", "lower", "upper", "mu", "patch_radius"):
            assert not getattr(other, name).flags.writeable
    with pytest.raises(TypeError):
        hash(cones)


@given(seed=seeds, size=st.floats(1e-3, 1e3))
def test_projection_is_feasible_keeps_what_is_and_is_a_projection(seed, size):
    cones = random_contact_problem(seed, joints=2, contacts=4).cones
    x = size * np.random.default_rng(seed).standard_normal(cones.n_rows)
    y = project(cones, x)
    twice = project(cones, y)
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
            assert abs(y[end - 1]) <= limit * cones.patch_radius[i]
