"""Records -> plain tables (lists of small frozen rows). Nothing is solved, timed or drawn here."""

from lavender.lab.report.tables.advice import (
    Advice,
    Choice,
    Line,
    advice,
    quantile,
    steps_of,
    time_budgets,
    to_level,
    within,
)
from lavender.lab.report.tables.campaigns import Robustness, robustness
from lavender.lab.report.tables.cases import (
    Claims,
    Reach,
    Spread,
    budgets,
    claims,
    failures,
    reaches,
    spreads,
)
from lavender.lab.report.tables.changes import NOISE, Change, changes, drift
from lavender.lab.report.tables.finals import Final, Race
from lavender.lab.report.tables.groups import families, is_campaign, levels_of, pairs
from lavender.lab.report.tables.means import (
    SHIFT,
    Backend,
    Profile,
    backends,
    geometric_mean,
    geometric_means,
    limit_of,
    profiles,
    times_to,
)
from lavender.lab.report.tables.sequences import Pass, by_sequence, passes

__all__ = [
    "NOISE",
    "SHIFT",
    "Advice",
    "Backend",
    "Change",
    "Choice",
    "Claims",
    "Final",
    "Line",
    "Pass",
    "Profile",
    "Race",
    "Reach",
    "Robustness",
    "Spread",
    "advice",
    "backends",
    "budgets",
    "by_sequence",
    "changes",
    "claims",
    "drift",
    "failures",
    "families",
    "geometric_mean",
    "geometric_means",
    "is_campaign",
    "levels_of",
    "limit_of",
    "pairs",
    "passes",
    "profiles",
    "quantile",
    "reaches",
    "robustness",
    "spreads",
    "steps_of",
    "time_budgets",
    "times_to",
    "to_level",
    "within",
]
