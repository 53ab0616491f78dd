"""The bound of the motion error beside the truth: small random problems solved in long double or rational numbers."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from kkt_truth import Wide, matrix_in, shift_in, solution_in
from random_problems import as_matrix, random_contact_problem, random_lcp

import lavender as lv
from lavender.lab.motion.bound import compute_witness, subtract_impulses
from lavender.lab.motion.operator import make_operator

SHAPES = ("disk", "disk", "box", "rolling")


class Draw(NamedTuple):
    """A random problem, an impulse, and what the bound says of it by a witness."""

    problem: lv.Problem
    impulse: np.ndarray  # (m,) N s
    y: np.ndarray  # (m,) N s, the witness
    good: bool  # the witness is the reference, not an impulse at random
    bound: float  # sqrt J
    moved: float  # m/s


class Truth(NamedTuple):
    """What holds of a draw."""

    energy: float  # sqrt J
    broken: (
        bool  # the energy is above the bound, or the targets moved further than said; decided before rounding
    )


def random_problem(rng):
    """A small problem of a convex law: rows or a matrix, joints, contacts, compliance, redundancy, mass ratios."""
    seed = int(rng.integers(2**31))
    kind = rng.integers(4)
    if kind == 0:
        return random_lcp(seed, m=int(rng.integers(1, 9)), rank=int(rng.integers(1, 9)))
    sizes = {
        "bodies": int(rng.integers(1, 4)) + 1,
        "joints": int(rng.integers(0, 3)),
        "contacts": int(rng.integers(0, 4)),
    }
    tangents, turns = 0 if kind == 1 else int(rng.integers(1, 3)), int(rng.integers(2)) * (kind != 1)
    shape = SHAPES[int(rng.integers(len(SHAPES)))] if tangents == 2 else "disk"
    problem = random_contact_problem(
        seed,
        friction="cone",
        tangents=tangents,
        spin=bool(turns) and shape != "box",
        rolling=shape == "rolling",
        **sizes,
    )
    if shape == "box":
        problem = replace(problem, cones=problem.cones.shaped("box"))
    return as_matrix(problem) if rng.random() < 0.25 else problem


def random_impulse(rng, problem, solution):
    """An impulse at any distance from the solution: perturbed, half solved, doing nothing, outside the bounds."""
    kind = rng.integers(4)
    size = float(np.abs(solution).max(initial=0.0)) or 1.0
    if kind == 0:
        return solution + size * 10.0 ** rng.uniform(-16, 1) * rng.normal(size=problem.m)
    if kind == 1:
        return solution * (1.0 + 10.0 ** rng.uniform(-16, 0) * rng.normal(size=problem.m))
    if kind == 2:
        return np.array(lv.solve(problem, "anderson", tol=0.0, max_iter=int(rng.integers(0, 40))).impulse)
    return problem.start()


def draw(rng):
    """A random draw; None without a witness. The witness is the reference four times out of five, or at random."""
    problem = random_problem(rng)
    reference = lv.motion.get_reference(problem)
    good = bool(rng.random() < 0.8)
    if good and not reference.is_accepted:
        return None
    y = reference.impulse if good else random_impulse(rng, problem, reference.impulse)
    operator = make_operator(problem)
    assert operator.explain_refusal() is None
    proof = compute_witness(problem, operator, y)
    x = random_impulse(rng, problem, reference.impulse)
    bound = subtract_impulses(operator, x, y)[1].upper_bound + proof.radius
    return Draw(problem, x, y, good, float(bound), float(proof.moved))


def truth(found, numbers=Wide):
    """Distance to the solution of the problem whose targets are moved by what the witness needs, None if unsettled."""
    problem = found.problem
    a, _ = matrix_in(problem, numbers)
    shift = shift_in(problem, a, found.y, numbers)
    solved = solution_in(problem, a, numbers.array(problem.b) + shift, numbers)
    if solved is None:
        return None
    delta = numbers.array(found.impulse) - solved[0]
    square = (delta @ a @ delta if problem.m else numbers.number(0.0)) / 2
    broken = square > numbers.number(found.bound) ** 2
    # What compliance stores is part of the energy: its kinetic part is no more.
    broken |= any(abs(e) > numbers.number(found.moved) for e in shift)
    return Truth(float(max(square, 0)) ** 0.5, bool(broken))
