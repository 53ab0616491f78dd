"""Scenes start from the same bits on every machine, and their arithmetic is right."""

import json
import os
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worked import python

from lavender.sim.scene import arithmetic
from lavender.sim.scene.parts import convert_to_rotation_matrix, make_quaternion

STARTS = """
import hashlib, json, lavender as lv
from lavender.sim.scene.scene import SCENES
def hashed(name):
    x = lv.Simulation(name).snapshot()
    return hashlib.sha256(b"".join(a.tobytes() for a in (x.size, x.real, x.index, x.keys))).hexdigest()
print(json.dumps({name: hashed(name) for name in SCENES}))
"""


def starts(**environment):
    return json.loads(
        python("-W", "ignore", "-c", STARTS, env={**os.environ, **environment}).stdout
    )


def test_every_scene_starts_from_the_same_bits_without_the_instructions_of_new_processors():
    # NumPy chooses sine, cosine and products by the processor, OpenBLAS its kernels; both can be told to choose as on
    # the oldest. With OpenBLAS's products and eigenvectors chain, ramp and four_bar started from other bits.
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    old = {"NPY_DISABLE_CPU_FEATURES": " ".join(found), "OPENBLAS_CORETYPE": "Prescott"}
    here = starts()
    assert len(here) > 10
    assert starts(**(old if found else {"OPENBLAS_CORETYPE": "Prescott"})) == here


def exact_sine(x, bits=400):
    # Taylor's series of a fraction, without a reduction: enough terms for |x| < 40
    term = total = Fraction(x)
    for k in range(1, 200):
        term = -term * Fraction(x) ** 2 / (2 * k * (2 * k + 1))
        term = Fraction(round(term * 2**bits), 2**bits)
        total += term
    return total


@given(st.floats(-30.0, 30.0))
def test_sine_and_cosine_are_the_nearest_numbers(angle):
    sine, cosine = arithmetic.compute_sine_and_cosine(angle)
    assert sine == float(exact_sine(angle))
    assert abs(sine * sine + cosine * cosine - 1.0) <= 3 * 2.0**-53  # three roundings
    # cos x = 1 - 2 sin(x/2)^2; halving is exact but for the least numbers, whose cosine is 1
    assert cosine == float(1 - 2 * exact_sine(Fraction(angle) / 2) ** 2)


@given(st.floats(-1e18, 1e18), st.sampled_from([1.0, 1e-9, 1e-100, 1e-300]))
def test_sine_and_cosine_of_any_size_are_those_of_the_library_to_its_own_error(x, scale):
    angle = x * scale
    sine, cosine = arithmetic.compute_sine_and_cosine(angle)
    # 2 ulp: what vectorised libraries promise
    assert sine == pytest.approx(np.sin(angle), rel=2**-51, abs=0.0)
    assert cosine == pytest.approx(np.cos(angle), rel=2**-51, abs=0.0)


def test_inverse_and_rotations_are_those_of_linear_algebra():
    rng = np.random.default_rng(5)
    for _ in range(300):
        g = rng.normal(size=(3, 3))
        x = g @ g.T + 10.0 ** rng.uniform(-6, 0) * np.eye(3)
        found = arithmetic.invert_definite_3x3(x)
        assert np.array_equal(found, found.T)
        # an elimination without pivots is backward stable on definite matrices: some ulp times the condition
        assert np.abs(found @ x - np.eye(3)).max() <= 1e-14 * np.linalg.cond(x)
        r = np.linalg.qr(g)[0]
        r *= np.sign(np.linalg.det(r))
        q = arithmetic.convert_frame_to_quaternion(r)
        assert q[0] >= 0.0
        np.testing.assert_allclose(convert_to_rotation_matrix(q), r, rtol=0.0, atol=1e-14)
        p = rng.normal(size=3)
        np.testing.assert_allclose(arithmetic.rotate_vector(r, p), r @ p, rtol=0.0, atol=1e-14)
        assert arithmetic.compute_norm(p) == pytest.approx(np.linalg.norm(p), rel=1e-15)
    np.testing.assert_allclose(
        convert_to_rotation_matrix(make_quaternion((0, 0, 2), np.pi / 2)),
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        rtol=0.0,
        atol=1e-15,
    )


def test_quaternion_of_a_half_turn_is_that_of_its_matrix():
    for axis in np.eye(3):
        r = 2.0 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_array_equal(arithmetic.convert_frame_to_quaternion(r), [0.0, *axis])
