"""States of blocks and their margins, from impulse and slack."""

import numpy as np
import pytest
from gradient_problems import KINDS, combinations, drawn

import lavender as lv
from lavender.judge.states import compute_states


@pytest.mark.parametrize("kind", KINDS)
def test_states_of_an_accurate_answer_are_those_of_a_more_accurate_one(kind):
    for law, operator in (rest for of, *rest in combinations() if of == kind):
        for seed in range(2):
            problem = drawn(seed, kind, law, operator)
            exact = lv.solve(problem, tol=1e-14)
            scale = np.abs(exact.impulse).max(initial=1.0)
            rng = np.random.default_rng(seed)
            for size in (1e-4, 1e-8):
                states = compute_states(
                    problem, exact.impulse + size * scale * rng.standard_normal(problem.m)
                )
                # A perturbation of y = l - w/d is at most 1 + |A|/d times that of l, 1e3 covers these problems.
                for i in np.flatnonzero(exact.states.margin > 1e3 * size * scale):
                    assert states.names[i] == exact.states.names[i]


@pytest.mark.parametrize(
    ("impulse", "b", "name", "margin"),
    [
        ([0.0, 0.0, 0.0], [-3.0, 0.0, 0.0], "open", 3.0),
        ([2.0, 0.0, 0.8], [2.0, 0.0, 0.8], "sticks", 0.2),
        ([9.0, 0.0, 4.5], [9.0, 0.0, 6.0], "slides", 1.5),
        ([0.1, 0.0, 0.0], [0.1, 0.0, 0.0], "sticks", 0.05),
    ],
)
def test_states_margin_of_a_contact_is_the_allowed_change_of_its_impulse(impulse, b, name, margin):
    # A = 1/kg, so y = l - w = b: open below 0, sticks up to mu y_n = 0.5 y_n.
    problem = lv.Problem.contact(np.eye(3), b, mu=[0.5])
    state = compute_states(problem, np.array(impulse))[0]
    assert (state.name, state.margin) == (name, pytest.approx(margin))


def test_states_margin_is_that_of_the_given_impulse():
    problem = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])
    solution = lv.solve(problem, tol=1e-12)
    assert solution.states.names == ("free", "at a bound")
    assert [s.margin for s in solution.states] == pytest.approx([0.5, 0.75])  # l_1, and w_2 / d_2
    assert compute_states(problem, np.array([-3.0, 0.0])).names == ("free", "free")


def test_states_of_equal_bounds_have_no_margin():
    problem = lv.Problem.lcp(np.eye(2), [1.0, 1.0], [0.5, 0.0], [0.5, 3.0])
    states = lv.solve(problem, tol=1e-12).states
    assert states[0].margin == np.inf and str(states[0]) == "at a bound, no other state"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_states_of_wild_impulses_are_defined(bad):
    problem = lv.Problem.lcp(np.diag(np.full(5, 2.0)) + 0.1, np.ones(5))
    assert len(compute_states(problem, np.full(5, bad)).names) == 5


@pytest.mark.parametrize("block", [3, 4, -4])
def test_state_of_a_block_that_does_not_exist_raises_and_states_the_number_of_blocks(block):
    states = lv.solve(lv.Problem.lcp(np.eye(3), [1.0, -1.0, 2.0])).states
    assert states.names == ("free", "at a bound", "free") and states[-1].name == "free"
    with pytest.raises((IndexError, lv.InputError), match=r"there are 3 blocks|block is -1"):
        states[block]


@pytest.mark.parametrize("seed", range(40))
def test_state_of_a_contact_changes_exactly_beyond_its_margin(seed):
    """Normal and tangents have other diagonals d: y = b / d of a diagonal A, in N s."""
    rng = np.random.default_rng(seed)
    d = np.array([1.0, 1.0, 1.0]) * 10.0 ** rng.uniform(-2.0, 2.0, 3)[[0, 1, 1]]
    mu = rng.uniform(0.2, 1.5)
    normal = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    y = np.array(
        [
            normal,
            *(
                abs(normal)
                * mu
                * rng.choice([0.3, 0.9, 1.1, 3.0])
                * np.array([np.cos(angle), np.sin(angle)])
            ),
        ]
    )

    def find(change):
        problem = lv.Problem.contact(np.diag(d), d * (y + change), mu=[mu])
        return compute_states(problem, np.zeros(3))[0]

    state = find(np.zeros(3))
    along = y[1:] / np.linalg.norm(y[1:])
    ways = [np.array([s, 0.0, 0.0]) for s in (-1.0, 1.0)] + [
        np.array([0.0, *(s * along)]) for s in (-1.0, 1.0)
    ]
    # The limit of friction moves with the normal by mu: a change of the tangents alone meets it at the margin.
    assert all(
        find(0.99 * state.margin * way / max(1.0, mu * abs(way[0]))).name == state.name
        for way in ways
    )
    assert any(find(1.01 * state.margin * way).name != state.name for way in ways)


@pytest.mark.parametrize("seed", range(20))
def test_state_of_a_row_changes_exactly_beyond_its_margin(seed):
    rng = np.random.default_rng(seed)
    d = 10.0 ** rng.uniform(-2.0, 2.0)
    low, high = -rng.uniform(0.1, 1.0), rng.uniform(0.1, 1.0)
    y = rng.uniform(-2.0, 2.0)

    def find(change):
        problem = lv.Problem.lcp([[d]], [d * (y + change)], low, high)
        return compute_states(problem, np.zeros(1))

    states = find(0.0)
    assert all(
        find(s * 0.99 * states.margin[0]).case.tolist() == states.case.tolist() for s in (-1.0, 1.0)
    )
    assert any(
        find(s * 1.01 * states.margin[0]).case.tolist() != states.case.tolist() for s in (-1.0, 1.0)
    )
