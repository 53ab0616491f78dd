"""Cones: what blocks may be, bounds, and the NumPy projection against its conditions."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_problems import random_contact_problem, seeds

import lavender as lv
from lavender.problem.cones import project_impulse


def test_cones_with_any_spelling_of_contact_bounds_are_equal():
    # They are never read: cones that differ there alone are equal.
    one = lv.Cones([0, 3], [1], [0.0, -1.0, -1.0], [9.0, 1.0, 1.0], [0.5], [0.0])
    two = lv.Cones([0, 3], [1], [5.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.5], [0.0])
    assert one == two
    assert one.lower[0] == 0.0
    with pytest.raises(TypeError):
        hash(one)


@given(seed=seeds, size=st.floats(1e-3, 1e3))
def test_projection_is_feasible_idempotent_and_nearest(seed, size):
    cones = random_contact_problem(seed, joints=2, contacts=4).cones
    x = size * np.random.default_rng(seed).standard_normal(cones.n_rows)
    y = project_impulse(cones, x)
    twice = project_impulse(cones, y)
    # Scaling a tangent back to its disk rounds once each time.
    np.testing.assert_allclose(twice, y, rtol=1e-15, atol=0.0)
    for i in range(cones.n_blocks):
        j = cones.ptr[i]
        end = cones.ptr[i + 1]
        nt = cones.n_tangents[i]
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
        ("mu", 1, 1e-60, "mu patch_radius .* must be 0 or at least 1e-60"),
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
