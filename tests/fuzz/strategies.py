"""Strategies that the inputs of this folder are made of, each made once: Hypothesis looks through every new one."""

import json
from functools import cache

import hypothesis.strategies as st
import numpy as np

LARGEST = 1e60  # that the door takes
SPECIAL = (
    0.0, -0.0, 5e-324, 1e-300, 1e-61, 1e-60, 1e-59, 1e-30,
    1e-20, 1.0, 1.0 + 2.0**-52, 1e20,
    1e30, 1e59, LARGEST,
)  # fmt: skip
STYLES = ("tame", "tame", "tame", "scales", "whole", "wild", "special")
MODERATE = st.floats(-4.0, 4.0, allow_subnormal=False)


@cache
def chance(p):
    """True with probability p about; towards False when made smaller."""
    return st.integers(0, 99).map(lambda x: x >= 100 - round(100 * p))


@cache
def generators():
    """Generators of NumPy: many numbers for the price of one choice, which cannot be made smaller one by one."""
    return st.integers(0, 2**32 - 1).map(np.random.default_rng)


@cache
@st.composite
def numbers(draw, n, style=None):
    """n numbers (n,): of moderate size, over many scales, whole, of any size inside the door, or its ends and dust."""
    style = style or draw(st.sampled_from(STYLES))
    rng = draw(generators())
    many = n > 40 or draw(st.booleans())
    x = rng.normal(size=n) if many else np.array(draw(st.lists(MODERATE, min_size=n, max_size=n)), float)
    if style == "scales":
        x = x * 10.0 ** rng.integers(-6, 7, n)
    elif style == "whole":
        x = np.rint(x)
    elif style == "wild":
        x = x * 10.0 ** rng.integers(-60, 60, n)
    elif style == "special":
        x = np.where(x < 0.0, -1.0, 1.0) * rng.choice(SPECIAL, n)
    return np.clip(x, -LARGEST, LARGEST)


@cache
def positive(n, style=None):
    """n numbers > 0 (n,)."""
    return numbers(n, style).map(lambda x: np.where(x != 0.0, np.abs(x), 1.0))


@cache
def some(n, p):
    """Which of n (n,), each with probability p about."""
    return generators().map(lambda rng: rng.random(n) < p)


@st.composite
def optional(draw, p=0.2, /, **fields):
    """Each of the fields, with probability p about."""
    return {name: draw(value) for name, value in fields.items() if draw(chance(p))}


def plain(spec):
    """As it comes back from a file: arrays are lists."""
    return json.loads(json.dumps(spec, default=lambda x: x.tolist()))
