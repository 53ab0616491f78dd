"""Every number that decides in `auto` has an effect, and the table is shown where users read it."""

import pytest

from benchmarks.decisions import FACTORS, compare_work, run_changed
from lavender.solvers import auto
from lavender.solvers.decisions import DECISIONS, NUMBERS

# No change of one number by a factor of two may cost more than this.
MAX_WORK_RATIO = 1.6


@pytest.fixture(scope="module")
def base():
    return run_changed(NUMBERS[0].name, 1.0)


@pytest.mark.parametrize("number", NUMBERS, ids=lambda number: number.name)
def test_a_number_changes_counted_work(number, base, record_property):
    results = [compare_work(base, run_changed(number.name, factor)) for factor in FACTORS]
    record_property("work_ratios", [ratio for ratio, _ in results])
    assert any(changed for _, changed in results), "a number without effect is to be removed"
    assert all(ratio < MAX_WORK_RATIO for ratio, _ in results), results


def test_the_table_is_short_and_in_the_docstring():
    assert len(NUMBERS) <= 12 and len({number.name for number in NUMBERS}) == len(NUMBERS)
    for number in NUMBERS:
        assert getattr(DECISIONS, number.name) == number.value
        assert number.meaning.endswith(".") and number.fit
        assert f" {number.name} " in auto.__doc__ and number.meaning in auto.__doc__
