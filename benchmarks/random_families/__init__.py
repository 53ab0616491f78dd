"""Random problems, on which `auto` was tuned and judged, and which tests and benchmarks read.

    wild     structure, masses, law and form of nine structures
    drawn    seventeen more structures, half of them for judging alone

A seed gives the same bits in every version: published figures name their seeds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.core_problems import forms
from benchmarks.random_families.drawn import drawn
from benchmarks.random_families.wild import wild
from lavender import suite
from lavender.problem import Problem

__all__ = ["draw_problems", "draw_suite_case", "drawn", "wild"]

LAW_NAMES = ("coulomb", "cone")


def draw_suite_case(seed: int) -> Problem:
    """Draw a family of the suite, its size and its masses."""
    rng = np.random.default_rng([seed, 79])
    k = int(rng.integers(2, 14))
    ratio = 10.0 ** float(rng.choice([0, 0, 1, 2, 3]))
    law = str(rng.choice(LAW_NAMES))
    number = int(rng.integers(1, 1000))
    name = str(
        rng.choice(
            [
                f"box_stackF(n={k}, mass_ratio={ratio:g})",
                f"box_stack(n={k}, mass_ratio={ratio:g})",
                f"pyramidF(k={min(k, 9)}, mass_ratio={ratio:g})",
                f"pyramid(k={min(k, 9)}, mass_ratio={ratio:g})",
                f"granular(n={min(k, 9)})",
                f"granularF(n={min(k, 9)})",
                f"chain(n={8 * k})",
                f"stack(n={16 * k})",
                f"random_spd(n={20 * k}, seed={number})",
            ]
        )
    )
    problem = suite.case(name).problem
    if problem.law in LAW_NAMES:
        problem = replace(problem, friction=law)
    if problem.rows is not None and rng.random() < 0.6:
        given = forms(problem)
        problem = given[str(rng.choice(list(given)))]
    return problem


def draw_problems(seed: int, count: int, max_rows: int) -> Iterator[tuple[str, int, Problem]]:
    """Yield (source, seed, problem) of 10 to `max_rows` rows: for each seed one of `wild`, `drawn` and the suite."""
    for number in range(seed, seed + count):
        for source, problem in (
            ("wild", wild(number).problem),
            ("drawn", drawn(number).problem),
            ("suite", draw_suite_case(number)),
        ):
            if 10 <= problem.m <= max_rows:
                yield source, number, problem
