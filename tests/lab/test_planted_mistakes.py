"""Mistakes planted in good problems: what `diagnose` tells of them, and of nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from planted_mistakes import planted, scenes, shares
from worked import ROOT

import lavender as lv


def kinds(problem):
    return {s.kind for s in lv.diagnose(problem)}


@pytest.fixture(scope="module")
def found():
    return shares()


def test_the_page_has_the_shares_of_planted_mistakes_that_are_found(found):
    page = (ROOT / "docs" / "diagnose.md").read_text(encoding="utf-8")
    for mistake in found["bodies"]:
        cells = " | ".join("{} of {}".format(*of[mistake]) for of in found.values())
        assert f"| {mistake} | {cells} |" in page


@pytest.mark.parametrize("spin_of", ["a ball", "a box"])
def test_a_kinematic_tree_is_not_taken_for_rigid_bodies(spin_of):
    """A base that hangs below the feet it stands on is no mistake, if there are joints in between."""
    given = next(x for name, x in scenes() if name.startswith("stack"))
    mass = given.mass.copy()
    if spin_of == "a ball":
        mass[3, 3] = mass[4, 4] = mass[5, 5]
    turned = replace(given, rows=None, mass=mass).turned((0, 1, 2), -1.0)
    assert "normals" in kinds(turned.problem)
    joint = np.zeros((len(mass) + 1, len(mass) + 1))
    joint[:-1, :-1], joint[-1, -1], joint[-1, 3] = mass, 0.1, 0.01
    joint[3, -1] = joint[-1, 3]
    wider = np.hstack([turned.jac, np.zeros((len(turned.jac), 1))])
    wider[:3, -1] = 0.3
    more = {"before": np.append(turned.before, 0.0), "change": np.append(turned.change, 0.0)}
    assert kinds(replace(turned, jac=wider, mass=joint, v_free=None, **more).problem) == set()


def test_speeds_of_another_unit_are_silent_and_a_conveyor_is():
    given = replace(next(x for name, x in scenes() if name.startswith("ramp")), rows=None)
    moved = given.target.copy()
    moved[given.contacts[:, 0]], moved[given.contacts[:, 1]] = 0.0, 0.8
    assert kinds(replace(given, target=moved).problem) == set()
    moved[given.contacts[0, 1]] = 0.7
    assert "tangents first" in kinds(replace(given, target=moved).problem)
    for length, told in ((1.0, {"v_free"}), (1e6, set())):  # m, micrometres
        wrong = dict(planted(given))["v* = v + a, without dt"]
        at_rest = replace(wrong, target=0.0 * wrong.target, v_free=length * wrong.v_free)
        assert kinds(at_rest.problem) == told


STATE = {
    "gap or depth of the wrong sign": "targets",
    "targets times dt once more": "targets",
    "targets divided by dt twice": "targets",
    "v* = v + a, without dt": "v_free",
    "v* = v, without a": "v_free",
}


def test_the_state_before_the_step_tells_what_the_problem_alone_does_not():
    for name, sound in list(scenes())[::15]:
        for x in (sound, replace(sound, rows=None)):
            assert lv.diagnose(x.problem, **x.state) == (), name
            for mistake, wrong in planted(x):
                kinds = {s.kind for s in lv.diagnose(wrong.problem, **wrong.state)}
                assert STATE.get(mistake) is None or STATE[mistake] in kinds, (name, mistake)
