"""Numbers on which the decisions of `auto`, the first compiled call and the estimated costs depend.

`python -m benchmarks regret` and `limits` measure the effect of a changed number. Costs in nanoseconds are measured
separately (`rates.json`).
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple


class Number(NamedTuple):
    """A number on which a decision of `auto` depends."""

    name: str  # Attribute of `DECISIONS`.
    value: float
    unit: str
    meaning: str  # Behaviour below and above the value.
    fit: str  # How the value was found.


REPLAY = "least mean regret in replays of recorded solvers on problems drawn at random"
LIMITED = "with these, 208 problems under 0.5 to 10 ms end at 1.02 times the residual of the best of five sweeps"
NUMBERS = (
    Number(
        "small_rows",
        64.0,
        "rows",
        "Up to this size, the compiled call solves matrices and bodies without a cost limit.",
        "Above it, Python takes less than a tenth of a solve.",
    ),
    Number(
        "island_rows",
        150.0,
        "rows",
        "The compiled call solves islands with friction one by one if none is larger.",
        "Dense factors of larger islands cost more than sweeps over all of them.",
    ),
    Number(
        "call_cost",
        1e7,
        "ns",
        "The compiled call over J and M runs up to this estimated cost, because it does not check for Ctrl-C.",
        "A delay of 10 ms is not noticed.",
    ),
    Number(
        "call_sweeps",
        32.0,
        "sweeps",
        "The compiled call sweeps few contacts up to this often, then runs Newton's method.",
        "On 110 problems drawn at random 16 take 1.12 of the time, 64 take 0.98; on islands 64 take 1.05.",
    ),
    Number(
        "call_extrapolation",
        4.0,
        "",
        "These sweeps continue while their rate reaches tol within this multiple of the remaining checks.",
        "2 and 8 change the time of the same problems by less than 3 %.",
    ),
    Number(
        "call_island_rows",
        12.0,
        "rows",
        "Larger islands get proportionally fewer of these sweeps, under the cone law none.",
        "On 20 stacks in islands 6 take 0.97 of the time, 24 take 1.05.",
    ),
    Number(
        "call_factorisations",
        120.0,
        "factorisations",
        "Newton's method in the compiled call ends after this many; the stages of `auto` follow.",
        "60 and 240 change the time of the same problems by less than 1 %.",
    ),
    Number(
        "call_iterations",
        200.0,
        "iterations",
        "The compiled call is made if at least this many are allowed.",
        "It does not count them, and a result after more than are allowed is not returned.",
    ),
    Number(
        "warm_residual",
        1e-3,
        "",
        "The compiled call starts pivots from an impulse with at most this residual, otherwise from zero.",
        "Of an impulse that is as good, most active rows are known.",
    ),
    Number(
        "first_sweeps",
        100.0,
        "sweeps",
        "Sweeps before a factorising solver, unless it costs less; they predict how many remain.",
        REPLAY + "; values from 64 to 128 lose less than 5 %",
    ),
    Number(
        "predicted_residual",
        1e-16,
        "",
        "Predictions of remaining sweeps replace a smaller tol by this one.",
        "Rounding prevents smaller residuals.",
    ),
    Number(
        "relaxed_rows",
        900.0,
        "rows",
        "From this size on, the convex relaxation of Coulomb's law is solved first.",
        "Below, Newton's method on Coulomb's law needs few more factorisations than on the relaxation.",
    ),
    Number(
        "face_contacts",
        1.5,
        "contacts",
        "With fewer contacts for each pair of bodies, large problems with friction are swept before any analysis.",
        "1 in piles of balls, 2 to 4 in walls, heaps, pyramids, towers, houses of cards, arches, ragdolls.",
    ),
    Number(
        "cheap_newton",
        150.0,
        "sweeps",
        "Below this cost, Newton's method runs without sweeps before it if more contacts share pairs of bodies.",
        "80 to 133 on these structures of 3,000 and 10,000 rows, 340 to 1,200 on piles of balls and gravel.",
    ),
    Number(
        "large_sweeps",
        8.0,
        "sweeps",
        "Sweeps of large problems with friction before their number is first predicted, then after each doubling.",
        "A prediction takes as long as a sweep.",
    ),
    Number(
        "sweep_fraction",
        0.1,
        "",
        "Sweeps may cost this fraction of Newton's method, whatever they predict.",
        "On 12 piles of 7,000 to 200,000 rows, 0.05 leaves one for Newton's method, 17 times slower.",
    ),
    Number(
        "relaxed_tol",
        0.01,
        "",
        "The relaxation is solved to this multiple of tol.",
        "Coulomb's residual is larger.",
    ),
    Number(
        "relaxed_start",
        6.0,
        "factorisations",
        "From this interior point of the relaxation on, both laws are compared after each.",
        "None ends with fewer.",
    ),
    Number(
        "slip_ratio",
        0.1,
        "",
        "Contacts slip if an interior point's residual of the relaxation is below this multiple of Coulomb's.",
        "At least 0.4 on piles without slip; pyramids reach 0.1 within 11 factorisations.",
    ),
    Number(
        "trial_residual",
        0.1,
        "",
        "If contacts slip, the relaxation is solved, and `admm` starts there, up to this residual on Coulomb's law.",
        "0.002 to 0.08 on pyramids and heaps at rest, which `admm` may solve; 0.2 to 3 on structures that slide.",
    ),
    Number(
        "near_sliding",
        0.02,
        "",
        "If contacts slip and a smaller fraction is near sliding, Newton's method on Coulomb's law follows at once.",
        "0.01 on heaps, which it solves soon, 0.03 on pyramids.",
    ),
    Number(
        "relaxed_solved",
        1e-5,
        "",
        "The relaxation is solved below this multiple of Coulomb's residual.",
        "`admm` starts at the relaxation's solution.",
    ),
    Number(
        "relaxed_ratio",
        2.0,
        "",
        "The relaxation may take this multiple of the expected number of factorisations.",
        "Piles of balls take 8 to 18 of 36.",
    ),
    Number(
        "trial_iterations",
        50.0,
        "iterations",
        "Iterations of `admm` from the relaxation's solution before each prediction of how many remain.",
        "In 50, pyramids at rest gain a factor of 100, heaps 3 to 7.",
    ),
    Number(
        "turn_factorisations",
        180.0,
        "factorisations",
        "First turn of Newton's method on large problems with friction; later turns double.",
        "With 150, heaps that a path solves with 170 take 1.3 times as long; with 360, a pile is not solved.",
    ),
    Number(
        "cheap_turn",
        720.0,
        "factorisations",
        "The same if Newton's method costs few sweeps.",
        "On 20 walls, heaps, pyramids, cards, towers and ragdolls it takes 0.9 of the time with 180.",
    ),
    Number(
        "turn_extension",
        30.0,
        "factorisations",
        "A turn continues while its last ones, this many, halve the residual.",
        "Sliding towers and pyramids that one turn does not solve take 15 to 45 more.",
    ),
    Number(
        "last_cost",
        1e8,
        "ns",
        "If no stage remains, Newton's method that has not ended runs on up to this cost.",
        "Nine rows of masses over many orders took 4.4e7.",
    ),
    Number(
        "admm_fraction",
        0.4,
        "",
        "A turn of `admm` on large problems with friction may cost this fraction of that of Newton's method.",
        "As before; not measured again.",
    ),
    Number(
        "factorisations",
        18.0,
        "factorisations",
        "Newton's method is expected to need this many with friction or over J and M; 1 for linear problems.",
        REPLAY + "; values from 12 to 25 lose less than 4 %",
    ),
    Number(
        "pivot_factorisations",
        4.0,
        "factorisations",
        "`direct`, and Newton's method for a matrix or bodies, are expected to need this many for bounded rows.",
        REPLAY + "; values of 2 and 8 lose 3 %",
    ),
    Number(
        "budget_ratio",
        16.0,
        "",
        "A factorising solver may use this multiple of its estimated cost before solvers alternate.",
        REPLAY + "; values from 8 to 32 lose less than 2 %",
    ),
    Number(
        "total_ratio",
        200.0,
        "",
        "All solvers together may use this multiple of Newton's estimated cost.",
        "No problem drawn at random was solved later.",
    ),
    Number(
        "time_share",
        0.5,
        "",
        "Under a time limit, a stage that another one follows may use this fraction of the remaining time.",
        "The two stages then lose at most a factor of two each.",
    ),
    Number(
        "ample_time",
        8.0,
        "",
        "Below this multiple of the least cost of Newton's method, sweeps precede the choice of the first stage.",
        "The estimates for this choice may exceed a shorter limit.",
    ),
    Number(
        "unchecked_sweeps",
        32.0,
        "sweeps",
        "So many of these sweeps are made without checks.",
        "Checks would take as long.",
    ),
    Number(
        "min_share",
        0.25,
        "",
        "These sweeps have at least this fraction of the time, otherwise what Newton's method leaves.",
        LIMITED,
    ),
    Number(
        "newton_time",
        1.4,
        "",
        "Newton's method follows if this multiple of its cost fits, or with friction assumed_pace.",
        LIMITED,
    ),
    Number(
        "pace_margin",
        0.6,
        "",
        "It then takes its cost times this multiple of the measured time of sweeps per counted work.",
        "Factorisations and their checks take 1.2 to 2.8 of it.",
    ),
    Number(
        "assumed_pace",
        2.0,
        "",
        "Without such sweeps, solvers that factor are assumed to take this multiple of their cost.",
        "The number of their steps varies, and machines differ.",
    ),
    Number(
        "call_time",
        3.0,
        "",
        "The compiled call for more than small_rows is made if this multiple of its least cost fits.",
        "It may use half of the time, and hands nothing over if it does not end.",
    ),
    Number(
        "formation_time",
        4.0,
        "",
        "Sweeps use a formed A if this multiple of the cost to form it remains.",
        "As before; not measured again.",
    ),
    Number(
        "admm_sweeps",
        500.0,
        "sweeps",
        "If no solver that factors ends in time, `admm` shares the time with sweeps if so many fit.",
        "As before; not measured again.",
    ),
)


# The values as attributes.
DECISIONS: Any = SimpleNamespace(**{number.name: number.value for number in NUMBERS})
# Up to this many rows, the compiled call `SolverSpec.small` is tried first, because Python's overhead dominates a
# solve.
SMALL_ROWS = int(DECISIONS.small_rows)


def describe_numbers() -> str:
    """Return the numbers as lines of name, value, unit and meaning."""
    width = max(len(number.name) for number in NUMBERS)
    return "\n".join(f"    {n.name:{width}} {n.value:6g} {n.unit:15} {n.meaning}" for n in NUMBERS)
