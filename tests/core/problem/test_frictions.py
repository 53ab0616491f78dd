"""What a new user meets in Python: defaults with a meaning, refusals with a way out, objects that show themselves."""

import numpy as np
import pytest
from random_problems import touching

import lavender as lv

TWO = {"inv_mass": [1.0, 0.5]}


def test_mu_alone_means_two_tangents_and_a_mu_that_nothing_feels_is_refused():
    made = touching([[-1, 0], [0, 1]], **TWO)
    problem = lv.Problem.from_rows(made, mu=0.5)
    assert (problem.m, problem.law) == (6, "coulomb")
    mixed = lv.Problem.from_rows(made, mu=[0.0, 0.5])
    assert mixed.cones.n_tangents.tolist() == [0, 2]
    assert lv.Problem.from_rows(made).m == 2
    assert lv.Problem.from_rows(made, mu=0.5, tangents=0, patch_radius=0.1).m == 4  # a spin row feels it
    with pytest.raises(lv.InputError, match=r"contact 0 has mu 0\.5 and no tangent"):
        lv.Problem.from_rows(made, mu=0.5, tangents=0)


def test_one_mu_for_each_contact_and_a_scalar_for_all():
    with pytest.raises(lv.InputError, match=r"mu has 3 values for 3 rows.*one mu for each contact"):
        lv.Problem.contact(np.eye(3), np.ones(3), mu=[0.5, 0.5, 0.5])
    assert lv.Problem.contact(np.eye(3), np.ones(3), mu=[0.0, 0.0, 0.0]).law == "lcp"
    assert lv.Problem.contact(np.eye(9), np.ones(9), mu=0.5) == lv.Problem.contact(
        np.eye(9), np.ones(9), mu=[0.5] * 3
    )
    assert lv.Problem.contact(np.eye(8), np.ones(8), mu=0.5, patch_radius=0.1).n_blocks == 2
    assert lv.Problem.contact(np.eye(2), np.ones(2), mu=0.5).n_blocks == 1
