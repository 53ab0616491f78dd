"""The number of contacts of a problem, compared with MuJoCo's own."""

import numpy as np
import pytest

import lavender as lv
from lavender.io.contact_count import count_contacts
from lavender.io.efc import from_mujoco_many

mujoco = pytest.importorskip(
    "mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'"
)

# Boxes with each number of friction components on a plane, and a hinge with a limit and friction loss.
SCENE = """<mujoco><option cone="{cone}"/><worldbody><geom type="plane" size="5 5 1"/>
  {boxes}<body pos="0 0 5"><joint axis="0 1 0" range="0.1 1" limited="true" frictionloss="1"/>
  <geom size=".1" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
BOX = """<body pos="{x} 0 .099"><freejoint/><geom type="box" size=".1 .1 .1" condim="{condim}" priority="1"/></body>"""


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("condims", [(1,), (3,), (4,), (6,), (1, 3, 4, 6), ()])
def test_count_contacts_equals_the_contacts_of_mujoco_that_have_rows(tmp_path, cone, condims):
    boxes = "".join(BOX.format(x=x, condim=condim) for x, condim in enumerate(condims))
    model = mujoco.MjModel.from_xml_string(SCENE.format(cone=cone, boxes=boxes))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    expected = int(np.count_nonzero(data.contact.efc_address >= 0)) if data.ncon else 0
    assert expected == 4 * len(condims)
    problem = lv.io.from_mujoco(model, data)
    lv.io.save(problem, tmp_path / "step.npz")
    for same in (problem, lv.load(tmp_path / "step.npz")):
        assert count_contacts(same) == expected
    batch, _ = from_mujoco_many(model, np.concatenate([data.qpos, data.qvel])[None])
    assert batch.contact_counts.tolist() == [count_contacts(batch[0])] == [expected]


def test_count_contacts_without_names_counts_blocks_with_friction():
    problem = lv.Problem.contact(np.eye(6), -np.ones(6), mu=0.5)
    assert count_contacts(problem) == 2
