"""The key of a contact names its geoms and its number among theirs: other contacts do not change it."""

import itertools

import numpy as np
import pytest

import lavender as lv

#: Spheres, boxes and capsules touch the ground in 1, 4 and 2 points.
SHAPES = ('type="sphere" size=".1"', 'type="box" size=".1 .1 .1"', 'type="capsule" size=".1 .2"')
MODEL = """<mujoco><option cone="{cone}"/><worldbody><geom type="plane" size="9 9 .1"/>{bodies}</worldbody></mujoco>"""
BODY = """<body pos="{x} 0 {z}" {turn}><freejoint/><geom name="g{i}" {shape}/></body>"""


def make_model(cone, n=5):
    mujoco = pytest.importorskip(
        "mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'"
    )
    bodies = "".join(
        BODY.format(i=i, x=i, z=3, shape=SHAPES[i % 3], turn='euler="0 90 0"' if i % 3 == 2 else "")
        for i in range(n)
    )
    return mujoco, mujoco.MjModel.from_xml_string(MODEL.format(cone=cone, bodies=bodies))


def read_keys(mujoco, model, low):
    """Return the keys of the blocks with the bodies `low` on the ground, in their order."""
    data = mujoco.MjData(model)
    data.qpos[2::7] = [0.0995 if i in low else 3.0 for i in range(model.nbody - 1)]
    mujoco.mj_forward(model, data)
    keys = lv.io.from_mujoco(model, data).key.tolist()
    assert len(set(keys)) == len(keys) >= data.ncon > 0
    return keys


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_keys_of_mujoco_contacts_do_not_depend_on_other_contacts(cone):
    mujoco, model = make_model(cone)
    alone = {i: read_keys(mujoco, model, {i}) for i in range(5)}
    assert [len(keys) for keys in alone.values()] == [n * len(alone[0]) for n in (1, 4, 2, 1, 4)]
    for n in (2, 3, 5):
        for low in itertools.combinations(range(5), n):
            assert sorted(read_keys(mujoco, model, low)) == sorted(
                key for i in low for key in alone[i]
            )


def test_carried_impulses_stay_with_their_contacts_when_others_come_and_go():
    mujoco, model = make_model("elliptic")
    problems = {}
    for low in ({1, 3}, {0, 1, 2, 3}, {3}):
        data = mujoco.MjData(model)
        data.qpos[2::7] = [0.0995 if i in low else 3.0 for i in range(5)]
        mujoco.mj_forward(model, data)
        problems[tuple(sorted(low))] = lv.io.from_mujoco(model, data)
    before, more, fewer = problems.values()
    impulse = 1.0 + np.arange(before.m, dtype=float)
    by_key = dict(zip(before.key.tolist(), np.split(impulse, before.cones.ptr[1:-1]), strict=True))
    for after in (more, fewer):
        start = after.make_start((before, impulse))
        kept = 0
        for key, part in zip(
            after.key.tolist(), np.split(start, after.cones.ptr[1:-1]), strict=True
        ):
            assert part.tolist() == by_key.get(key, np.zeros(len(part))).tolist()
            kept += key in by_key
        assert kept == (5 if after is more else 1)


@pytest.mark.parametrize("shape", ["box", "sphere"])
def test_keys_of_scene_contacts_do_not_depend_on_other_contacts(shape):
    def read(low, more=0):
        scene = lv.Scene()
        scene.add_plane()
        for i in range(4 + more):
            z = 0.5 if i in low else 7.0
            if shape == "box":
                scene.add_box((1.0, 1.0, 1.0), position=(3.0 * i, 0.0, z))
            else:
                scene.add_sphere(0.5, position=(3.0 * i, 0.0, z))
        problem = lv.Simulation(scene).constraint_problem()
        body = problem.rows.contact_body.max(axis=1)
        return {int(i): problem.key[body == i].tolist() for i in sorted(set(body.tolist()))}

    alone = {}
    for i in range(4):
        alone |= read({i})
    assert len(alone) == 4 and len({key for keys in alone.values() for key in keys}) == sum(
        map(len, alone.values())
    )
    for low in ({0, 1}, {1, 3}, {0, 2, 3}, {0, 1, 2, 3}):
        found = read(low, more=2)
        assert len(found) == len(low) and all(alone[i] == keys for i, keys in found.items())
