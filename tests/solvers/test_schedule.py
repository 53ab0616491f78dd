"""The schedule of `auto` on made-up methods: its bound, whatever they promise."""

from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavender.solvers.schedule import BELIEVED, race, remainder

costs = st.floats(1e-3, 1e6)


class Fake:
    """A method that ends after `needs`, promises what it likes, and may be counted closely only when it is asked."""

    def __init__(self, expected, needs, promises, guess=None):
        self.needs, self.promises = needs, list(promises)
        self.expected, self.spent, self.over = expected, 0.0, False
        self.counted = guess is None
        self.rest = expected if guess is None else guess

    def count(self):
        self.counted, self.rest = True, self.expected

    def run(self, work, others):
        assert self.counted and not self.over
        self.over = self.spent + work >= self.needs
        self.spent = min(self.spent + work, self.needs)
        self.rest = remainder(self.spent, self.promises.pop() if self.promises else 0.0)
        return True


class Long(Fake):
    """The same for a method with longer turns."""

    def run(self, work, others):
        return super().run(BELIEVED * work, others)


class Anew(Fake):
    """The same for one that also begins anew in each turn."""

    def run(self, work, others):
        assert self.counted and not self.over
        self.over = BELIEVED * work >= self.needs
        last = min(BELIEVED * work, self.needs)
        self.spent += last
        self.rest = 2.0 * last
        return True


methods = st.lists(
    st.tuples(costs, st.one_of(costs, st.just(inf)), st.lists(st.one_of(costs, st.just(inf)), max_size=6)),
    min_size=1,
    max_size=5,
)


@given(made=methods, guesses=st.lists(st.floats(0.0, 1.0), min_size=5, max_size=5))
@settings(max_examples=300)
def test_all_turns_together_are_bounded_by_any_method_that_ends(made, guesses):
    if all(needs == inf for _, needs, _ in made):
        made = [*made[:-1], (made[-1][0], 1.0, made[-1][2])]
    fakes = [Fake(e, c, p, e * g) for (e, c, p), g in zip(made, guesses, strict=False)]
    race(list(fakes), lambda: any(f.over for f in fakes))
    total = sum(f.spent for f in fakes)
    k = len(fakes)
    bound = min((2 * k - 1) * max(f.expected, BELIEVED * f.needs) for f in fakes if f.needs < inf)
    assert total <= bound * (1.0 + 1e-9)


@given(made=methods, kinds=st.lists(st.sampled_from([Fake, Long, Anew]), min_size=5, max_size=5))
@settings(max_examples=300)
def test_methods_with_longer_turns_count_for_them(made, kinds):
    """Without promises; what a method itself takes counts with the runs that were cut short."""
    if all(needs == inf for _, needs, _ in made):
        made = [*made[:-1], (made[-1][0], 1.0, made[-1][2])]
    fakes = [kind(e, c, []) for (e, c, _), kind in zip(made, kinds, strict=False)]
    race(list(fakes), lambda: any(f.over for f in fakes))
    (winner,) = (f for f in fakes if f.over)
    others = sum(2.0 if type(f) is Fake else 1.0 + BELIEVED for f in fakes if f is not winner)
    for j in fakes:
        if j.needs < inf:
            # r_j never exceeds what was expected, or twice its last run, which is shorter than it needs.
            most = max(j.expected, 2.0 * j.needs)
            own = 2.0 * most if type(winner) is Fake else (1.0 + BELIEVED) * most
            assert sum(f.spent for f in fakes) <= (others * most + own) * (1.0 + 1e-9)


def test_one_that_ends_soon_is_not_kept_waiting_by_one_that_promises_for_ever():
    liar = Fake(1.0, inf, [1e-9] * 60)
    honest = Fake(10.0, 5.0, [])
    race([liar, honest], lambda: honest.over)
    assert liar.spent <= 2.0 * 10.0 and honest.spent == 5.0


def test_a_bound_from_below_is_counted_before_it_has_a_turn():
    cheap, dear = Fake(5.0, 4.0, []), Fake(100.0, 1.0, [], guess=0.1)
    race([dear, cheap], lambda: cheap.over or dear.over)
    assert dear.counted and dear.spent == 0.0 and cheap.over


def test_a_turn_is_told_the_least_that_is_left_of_the_others():
    told = []

    class Told(Fake):
        def run(self, work, others):
            told.append((self.expected, others))
            return super().run(work, others) and len(told) > 1

    race([Told(cost, inf, [inf] * 9) for cost in (4.0, 9.0, 1.0)], lambda: len(told) == 2)
    assert told == [(1.0, 4.0), (4.0, 9.0)]
    race([Told(2.0, 1.0, [])], lambda: len(told) == 3)
    assert told[2] == (2.0, inf)


def test_nobody_left_is_an_end():
    class Stuck(Fake):
        def run(self, work, others):
            self.spent += work
            return False

    stuck = [Stuck(e, inf, []) for e in (1.0, 2.0, 3.0)]
    race(list(stuck), lambda: False)
    assert [s.spent for s in stuck] == [1.0, 2.0, 3.0]


def test_equal_remainders_go_in_the_order_of_the_list():
    order = []

    class Named(Fake):
        def run(self, work, others):
            order.append(self)
            return super().run(work, others)

    fakes = [Named(1.0, inf, []) for _ in range(3)]
    race(list(fakes), lambda: len(order) >= 1)
    assert order == fakes[:1]


@pytest.mark.parametrize("promise", [0.0, 1.0, 3.0, inf, np.nan])
def test_a_remainder_is_never_less_than_what_was_spent(promise):
    assert 2.0 <= remainder(2.0, promise) <= BELIEVED * 2.0
