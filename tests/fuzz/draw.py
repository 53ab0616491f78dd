"""Where a generator gets its choices: a seed, or hypothesis (which can then make a failing input smaller).

whole(low, high)    a whole number, both ends included
pick(options)       one of them
chance(p)           true with probability p
normals(n)          n numbers of moderate size
"""

import numpy as np


class Seeded:
    """Choices of a seed; the same in every process."""

    def __init__(self, *seed):
        self.rng = np.random.default_rng(list(seed))

    def whole(self, low, high):
        return int(self.rng.integers(low, high + 1))

    def pick(self, options):
        return options[int(self.rng.integers(len(options)))]

    def chance(self, p):
        return bool(self.rng.random() < p)

    def normals(self, n):
        return self.rng.normal(size=n)


class Drawn:
    """Choices of hypothesis, by the `draw` of a composite strategy."""

    def __init__(self, draw):
        self.draw = draw

    def whole(self, low, high):
        import hypothesis.strategies as st

        return self.draw(st.integers(low, high))

    def pick(self, options):
        import hypothesis.strategies as st

        return self.draw(st.sampled_from(list(options)))

    def chance(self, p):
        import hypothesis.strategies as st

        # towards False when made smaller
        return self.draw(st.integers(0, 99)) >= 100 - round(100 * p)

    def normals(self, n):
        import hypothesis.strategies as st

        number = st.floats(-4.0, 4.0, allow_subnormal=False)
        return np.array(self.draw(st.lists(number, min_size=n, max_size=n)), float)


def strategy(make):
    """A generator of this folder as a strategy of hypothesis."""
    import hypothesis.strategies as st

    return st.composite(lambda draw: make(Drawn(draw)))()


SPECIAL = (
    0.0, -0.0, 5e-324, 1e-310, 2.2250738585072014e-308, 1e-300, 1e-160, 1e-154, 1e-150,
    1e-20, 1.0, 1.0 + 2.0**-52, 1e20,
    1e150, 1e154, 1e160, 1e299, 1e300, 1.7976931348623157e308,
)  # fmt: skip
STYLES = ("tame", "tame", "tame", "scales", "whole", "wild", "special")


def numbers(draw, n, style=None):
    """n finite numbers (n,): of moderate size, over many scales, whole, of any size, or the edges of float64."""
    style = style or draw.pick(STYLES)
    x = np.asarray(draw.normals(n), float)
    with np.errstate(over="ignore"):
        if style == "scales":
            x = x * 10.0 ** np.array([draw.whole(-6, 6) for _ in range(n)], float)
        elif style == "whole":
            x = np.rint(x)
        elif style == "wild":
            x = x * 10.0 ** np.array([draw.whole(-320, 307) for _ in range(n)], float)
        elif style == "special":
            x = np.where(x < 0.0, -1.0, 1.0) * np.array([draw.pick(SPECIAL) for _ in range(n)], float)
    return np.clip(x, -1.7976931348623157e308, 1.7976931348623157e308) if n else np.zeros(0)


def positive(draw, n, style=None):
    """n numbers > 0 (n,)."""
    x = np.abs(numbers(draw, n, style))
    return np.where(x > 0.0, x, 1.0)
