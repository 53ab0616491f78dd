"""Derivatives of solutions: against differences, against their own adjoint, where they do not exist, and refusals."""

import numpy as np
import pytest
from gradient_problems import KINDS, OPERATORS, directions, drawn, moved, named

import lavender as lv

LAWS = ("coulomb", "cone")
H = 1e-5  # of differences: 1e-10 of curvature, 1e-9 of solutions to 1e-14
CLOSE = 1e-6


def solved(problem):
    solution = lv.solve(problem, tol=1e-14)
    assert solution.residual.relative < 1e-11 or solution.residual.at_floor, str(solution)
    return solution


def _problems():
    for kind in KINDS:
        for law in LAWS:
            for operator in OPERATORS:
                if kind == "round" and (law != "cone" or operator != "generalized"):
                    continue
                if operator == "bodies" and kind in ("free", "bounded", "equal", "round"):
                    continue
                if operator == "asymmetric" and law == "cone":
                    continue
                yield pytest.param(kind, law, operator, id=f"{kind}-{law}-{operator}")


PROBLEMS = list(_problems())


@pytest.mark.parametrize("kind, law, operator", PROBLEMS)
def test_directions_agree_with_differences_of_solutions(kind, law, operator):
    checked = 0
    for seed in range(3):
        p = drawn(seed, kind, law, operator)
        solution = solved(p)
        d = lv.derivative(p, solution)
        if d.distance.min() < 1e-3:
            continue
        assert d.exists
        for name, change in directions(p, np.random.default_rng(seed)).items():
            found = d.jvp(**named(name, change))
            ends = [solved(moved(p, name, change, h)) for h in (-H, H)]
            wanted = (ends[1].impulse - ends[0].impulse) / (2.0 * H)
            size = 1.0 + np.abs(wanted).max()
            assert np.abs(found.impulse - wanted).max() <= CLOSE * size, (seed, name)
            wanted = (ends[1].slack - ends[0].slack) / (2.0 * H)
            assert np.abs(found.slack - wanted).max() <= CLOSE * size, (seed, name)
            if p.matrix is None:
                ends = [
                    moved(p, name, change, h).velocity(x.impulse) for h, x in zip((-H, H), ends, strict=True)
                ]
                wanted = (ends[1] - ends[0]) / (2.0 * H)
                assert np.abs(found.velocity - wanted).max() <= CLOSE * size, (seed, name)
            checked += 1
    assert checked > 0


@pytest.mark.parametrize("kind, law, operator", PROBLEMS)
def test_gradients_are_the_adjoint_of_directions(kind, law, operator):
    # to rounding: both are the same linear map, read from its two ends
    p = drawn(0, kind, law, operator)
    d, rng = lv.derivative(p, solved(p)), np.random.default_rng(1)
    weights = {"impulse": rng.standard_normal(p.m), "slack": rng.standard_normal(p.m)}
    if p.matrix is None:
        weights["velocity"] = rng.standard_normal(p.velocity(np.zeros(p.m)).shape)
    g = d.vjp(**weights)
    for name, change in directions(p, rng).items():
        found = d.jvp(**named(name, change))
        wanted = sum(float(np.sum(w * getattr(found, key))) for key, w in weights.items())
        if name == "mu of each tangent":
            two = np.isin(p.cones.kind, (lv.CONTACT_BOX, lv.CONTACT_ELLIPSE))
            pairs = [(g.coefficients, np.where(two[:, None], change, [[1.0, 0.0]] * change))]
        elif name in "AJM":
            pairs = [(g.full(name), change)]
        else:
            pairs = [(getattr(g, key), x) for key, x in named(name, change).items()]
        told = sum(float(np.sum(a * b)) for a, b in pairs)
        assert told == pytest.approx(wanted, rel=1e-9, abs=1e-9), name
