"""Records that the tests of reports share."""

import numpy as np
import pytest
from stacks import chain

import lavender as lv
from lavender import bench

LEVELS = (1e-3, 1e-6)


@pytest.fixture(scope="session")
def real():
    """Records of three real problems, one named as an attacker would."""
    a = chain(8).matrix
    evil = '</script><script>alert("x")</script>&|'
    problems = [
        lv.Problem.lcp(a, np.ones(8), name=evil, names=[f"<b>row {i}" for i in range(8)], guess=np.ones(8)),
        lv.Problem.linear(a, np.ones(8), name="chain"),
        lv.Problem.lcp(a, np.linspace(1.0, 0.1, 8), name="another stack"),
    ]
    plan = bench.Plan(levels=LEVELS, budgets=(2, 4, 8), repeats=1)
    return bench.run(problems, ["pgs", "direct", "jacobi", "gauss_seidel"], plan), evil
