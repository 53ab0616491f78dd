"""Rows at the door: the quick checks refuse and accept what the long way does."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_problems import random_bodies_and_contacts, seeds

import lavender as lv
from lavender_ext.core import checks


def fields(seed):
    """Arrays of legal rows: joints of 1 to 3 rows, contacts between random bodies or a body and the ground."""
    rows = random_bodies_and_contacts(np.random.default_rng(seed), bodies=3, joints=2, contacts=4)
    return {
        f.name: np.array(getattr(rows, f.name))
        for f in dataclasses.fields(rows)
        if f.name != "copy"
    }


SPOILT = {
    "nothing": None,
    "a body that is not there": ("contact_body", (0, 1), 3),
    "below static": ("joint_body", (1, 0), -2),
    "a joint of one body": ("joint_body", (0, slice(None)), 1),
    "a contact of one body": ("contact_body", (2, slice(None)), 0),
    "a joint of nobody": ("joint_body", (0, slice(None)), -1),
    "a contact of nobody": ("contact_body", (1, slice(None)), -1),
    "a normal too long by 2e-5": ("normal", (0,), 1.0 + 2e-5),
    "a normal too long by 1e-7": ("normal", (0,), 1.0 + 1e-7),
    "a normal too long by 1e-11": ("normal", (0,), 1.0 + 1e-11),
    "a tangent along the normal": ("tangent", (0,), None),
    "an inertia with a twist": ("inv_inertia", (0, 0, 1), 5.0),
    "an inertia below zero": ("inv_inertia", (0,), -1.0),
    "an inertia about one axis": ("inv_inertia", (0,), np.diag([1.0, 0.0, 0.0])),
    "an inertia of a point": ("inv_inertia", (0,), np.zeros((3, 3))),
    "an inertia near the edge": ("inv_inertia", (0,), np.diag([1.0, 1.0, -0.9e-9])),
    "an inertia at the edge of the door": ("inv_inertia", (0,), 1e-60 * np.eye(3)),
    "pointers that stand still": ("joint_ptr", (1,), 0),
    "pointers from one on": ("joint_ptr", (0,), 1),
}


def spoilt(seed, how):
    given = fields(seed)
    if how is not None:
        name, at, value = how
        if name in ("normal", "tangent"):
            given[name][0] = given["normal"][0] * (1.0 if value is None else value)
        elif np.ndim(value) == 0 and name == "inv_inertia" and len(at) == 1:
            given[name][at] *= value
        else:
            given[name][at] = value
    return given


def outcome(given):
    try:
        lv.Rows(**given)
    except lv.InputError as error:
        return str(error)
    return "taken"


@pytest.mark.parametrize("what", SPOILT)
@given(seed=st.integers(0, 2**32 - 1))
def test_sweeps_quick_check_equals_the_full_residual(what, seed):
    given = spoilt(seed, SPOILT[what])
    quick = outcome(given)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checks, "find_body_fault", _fault_or_frame)
        slow = outcome(given)
    assert quick == slow
    legal = (
        "nothing",
        "a joint of nobody",
        "a normal too long by 1e-11",
        "a normal too long by 1e-7",
    )
    also = (
        "an inertia about one axis",
        "an inertia of a point",
        "an inertia near the edge",
        "an inertia at the edge of the door",
    )
    assert (quick == "taken") == (what in legal + also)


def _fault_or_frame(*arrays, find=checks.find_body_fault):
    """The first fault, or one of a frame, so that inertias and frames are looked at in detail."""
    fault, index = find(*arrays)
    return (fault, index) if fault else ("frame", 0)


def test_rows_in_float32_are_widened_exactly():
    rng = np.random.default_rng(3)
    n, turn = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    t = np.cross(n, turn)
    t /= np.linalg.norm(t, axis=1)[:, None]
    flat = np.linalg.qr(rng.normal(size=(10, 3, 3)))[0] * [
        1.0,
        2.0,
        0.0,
    ]  # a plane body: one direction does not turn
    tensor = flat @ flat.transpose(0, 2, 1)
    single = {"normal": n, "tangent": t, "inv_inertia": tensor, "inv_mass": np.ones(10)}
    more = {
        "v_free": rng.normal(size=(10, 6)),
        "arm_a": rng.normal(size=(20, 3)),
        "arm_b": rng.normal(size=(20, 3)),
        "contact_body": np.stack([np.arange(20) % 10, (np.arange(20) + 3) % 10], axis=1),
    }
    rows = lv.Rows(**{k: v.astype(np.float32) for k, v in single.items()}, **more)
    assert rows.normal.dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(rows.normal, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(rows.tangent, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(np.einsum("ij,ij->i", rows.normal, rows.tangent), 0.0, atol=1e-15)
    np.testing.assert_allclose(rows.normal, n, atol=1e-6)
    np.testing.assert_allclose(rows.inv_inertia, tensor, atol=1e-5)
    assert np.array_equal(rows.inv_inertia, rows.inv_inertia.transpose(0, 2, 1))
    assert (
        np.linalg.eigvalsh(rows.inv_inertia).min() > -1e-9 * 4.0
    )  # which is allowed of the largest entry
    assert lv.solve(lv.Problem.from_rows(rows, mu=0.5), tol=1e-6).success
    whole = lv.Rows(**single, **more)  # what float64 normalised keeps its bits
    assert np.array_equal(whole.normal, n)
    with pytest.raises(lv.InputError, match=r"contact 4: .*off by 0\.0001.*float32"):
        lv.Rows(
            **single | {"normal": n * np.where(np.arange(20) == 4, 1.0001, 1.0)[:, None]}, **more
        )


def test_problem_carry_keeps_impulses_by_key_and_starts_new_blocks_at_zero():
    def step(keys, size):
        return lv.Problem(np.ones(sum(size)), sum_of(size), np.eye(sum(size)), key=np.array(keys))

    def sum_of(size):
        made = lv.Cones.contacts(0.5, tangents=size[0] - 1)
        for rows in size[1:]:
            made = made + lv.Cones.contacts(0.5, tangents=rows - 1)
        return made

    before = step([5, 2, 9], [3, 3, 1])
    now = step([9, 5, 7, 2], [1, 3, 3, 1])
    impulse = np.arange(1.0, 8.0)
    wanted = [7.0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0]  # 2 has lost its tangents: it starts anew
    assert now.carry((before, impulse)).tolist() == wanted
    assert (
        dataclasses.replace(now, key=None).carry((before, impulse), keys=[9, 5, 7, 2]).tolist()
        == wanted
    )
    solution = lv.solve(before, tol=1e-9)
    assert np.array_equal(before.carry(solution), solution.impulse)
    three, four = (
        lv.Problem.lcp(np.eye(n), np.ones(n)) for n in (3, 4)
    )  # without keys, by the same blocks
    assert three.carry((three, np.ones(3))).all()
    keyed = dataclasses.replace(four, key=np.arange(4))
    twice = dataclasses.replace(three, key=[7, 8, 7])
    for problem, previous, words in (
        (four, three, r"this problem and the previous one, .* \(4 now, 3 before\).*key="),
        (keyed, three, "no keys in the previous one, "),
        (keyed, twice, "key 7 of the previous one names 2 blocks"),
        (twice, dataclasses.replace(three, key=[7, 8, 9]), "key 7 of this problem names 2 blocks"),
    ):
        with pytest.raises(lv.InputError, match=words):
            problem.carry((previous, np.ones(3)))
    assert not lv.report.carry_impulses(
        three, np.ones(3), four
    ).any()  # a report starts such a step from zero
    assert np.array_equal(dataclasses.replace(before, key=None).carry(solution), solution.impulse)
    for bad, keys, words in (
        (np.zeros(7), None, "a Solution"),
        (solution, [1, 2], "2"),
        ((dataclasses.replace(before, key=None), impulse), [9, 5, 7, 2], "has no keys"),
    ):
        with pytest.raises(lv.InputError, match=words):
            now.carry(bad, keys)


@given(seeds)
def test_problem_carry_of_random_keys_equals_a_dict(seed):
    rng = np.random.default_rng(seed)
    # The highest bits of a key are the type of a block, so that many keys differ in a few high bits only.
    pool = rng.permutation(
        np.uint64(2) ** rng.integers(0, 64, 60, dtype=np.uint64) + np.arange(60, dtype=np.uint64)
    )

    def step():
        cones = [
            (lv.Cones.free(1), lv.Cones.contacts(0.5))[i]
            for i in rng.integers(0, 2, rng.integers(1, 30))
        ]
        blocks = sum(cones[1:], cones[0])
        key = rng.choice(np.unique(pool), blocks.n_blocks, replace=False)
        return lv.Problem(np.ones(blocks.n_rows), blocks, np.eye(blocks.n_rows), key=key)

    before, now = step(), step()
    impulse = rng.normal(size=before.m)
    wanted = now.start()
    old = before.cones
    new = now.cones
    block_of_key = {key: i for i, key in enumerate(before.key.tolist())}
    for j, key in enumerate(now.key.tolist()):
        i = block_of_key.get(key)
        if i is not None and old.kind[i] == new.kind[j]:
            wanted[new.ptr[j] : new.ptr[j + 1]] = impulse[old.ptr[i] : old.ptr[i + 1]]
    assert np.array_equal(now.carry((before, impulse)), wanted)


@pytest.mark.parametrize("size", [1.5e-9, 1e-7, 4e-6])
@pytest.mark.parametrize("kind", ["skew", "long normal", "long tangent"])
def test_rows_of_slightly_wrong_frames_have_the_nearest_orthonormal_frames(kind, size):
    given = fields(4)
    exact = {name: given[name].copy() for name in ("normal", "tangent")}
    if kind == "skew":
        given["tangent"] += size * given["normal"]
    else:
        given[kind.removeprefix("long ")] *= 1.0 + size
    rows = lv.Rows(**given)
    assert np.abs((rows.normal * rows.tangent).sum(axis=1)).max() <= 4.0 * 2.0**-53
    for name, expected in exact.items():
        found = getattr(rows, name)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=2e-15)
        np.testing.assert_allclose(found, expected, atol=2.0 * size)


def test_rows_of_an_inverse_inertia_that_rounding_made_indefinite_have_a_semidefinite_one():
    given = fields(4)
    q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    given["inv_inertia"][0] = q @ np.diag([3.0, 1.0, -1e-6]) @ q.T
    rows = lv.Rows(**given)
    assert np.linalg.eigvalsh(rows.inv_inertia[0])[0] >= -1e-15
    np.testing.assert_allclose(rows.inv_inertia[0], q @ np.diag([3.0, 1.0, 0.0]) @ q.T, atol=1e-14)
