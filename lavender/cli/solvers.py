"""Define `lavender solvers`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from lavender.cli.completion import complete_solver
from lavender.cli.options import escape_markup, make_console

if TYPE_CHECKING:
    from lavender.solvers.registry import SolverSpec

#: Words of the column "capabilities": (field of `SolverSpec`, word, explanation).
CAPABILITIES = (
    ("exact", "exact", "ends after finitely many steps or at rounding accuracy"),
    (
        "box_friction_laws",
        "boxes",
        "accepts contacts with friction that bound each tangent separately",
    ),
    ("impulse", "warm start", "starts from impulse="),
    ("resumable", "budget", "runs exactly max_iter iterations with tol=0"),
    ("order", "order", "accepts order="),
    ("seed", "seed", "accepts seed="),
    ("history", "history", "records history=True"),
)

#: Columns of a terminal from which the table has the forms of A that a solver reads.
WIDE = 100


@click.command()
@click.argument("name", required=False, shell_complete=complete_solver)
def solvers(name: str | None) -> None:
    """List the solvers and their capabilities, or describe the solver NAME.

    Solvers that are not installed show the package to install. For a backend of another package, the description has
    its observed behaviour with small programs.
    """
    if name is None:
        _list_solvers()
    else:
        _describe_solver(name)


def _get_capabilities(spec: SolverSpec) -> str:
    """Return the capabilities of a solver as words."""
    return ", ".join(word for field, word, _ in CAPABILITIES if getattr(spec, field))


def _join_in_order(names: Sequence[str], present: frozenset[str]) -> str:
    return " ".join(name for name in names if name in present)


def _describe_solver(name: str) -> None:
    """Print summary, reference, capabilities, options and observed behaviour of a solver."""
    from importlib.metadata import version

    from lavender.problem import LAWS, OPERATORS
    from lavender.programs.backends import describe_backend, get_behaviour
    from lavender.solvers import registry

    if name not in registry.specs():
        registry.get(name)  # Raises UnknownName with similar names.
    spec = registry.specs()[name]
    observations, measures = describe_backend(name)
    facts = (
        ("Not installed", registry.known()[name]),
        ("Plug-in of", spec.distribution and f"{spec.distribution} {version(spec.distribution)}"),
        ("Reference", spec.reference),
        ("Laws", _join_in_order(LAWS, spec.laws)),
        ("Reads", _join_in_order(OPERATORS, spec.operators)),
        ("Capabilities", _get_capabilities(spec)),
        *((f"Option {option}", text) for option, text in spec.options.items()),
    )
    lines = [f"{name}: {spec.summary}", *(f"{title}: {text}" for title, text in facts if text)]
    if observations:
        lines += [
            f"Observed with version {get_behaviour(name).version}, called alone at its default settings:"
        ]
        lines += [f"- {sentence}" for sentence in observations]
    elif spec.external:
        lines += ["Its behaviour was not observed."]
    if measures:
        lines += [
            "lavender therefore calls it as follows:",
            *(f"- {sentence}" for sentence in measures),
        ]
    console = make_console()
    for line in lines:
        console.print(escape_markup(line), highlight=False)


def _list_solvers() -> None:
    """Print a table of the solvers, installed ones first."""
    from rich.table import Table

    from lavender.problem import LAWS, OPERATORS
    from lavender.solvers import registry

    reasons = registry.known()
    console = make_console()
    shows_operators = console.width >= WIDE
    heads = ("solver", "laws", "reads", "capabilities", "description")
    table = Table(box=None, pad_edge=False, header_style="bold")
    for head in heads:
        if head != "reads" or shows_operators:
            table.add_column(head, overflow="fold", no_wrap=head == "solver")
    for name, spec in sorted(
        registry.specs().items(), key=lambda pair: (bool(reasons[pair[0]]), pair[0])
    ):
        reads = [_join_in_order(OPERATORS, spec.operators)] if shows_operators else []
        laws = _join_in_order(LAWS, spec.laws)
        cells = (name, laws, *reads, _get_capabilities(spec), reasons[name] or spec.summary)
        table.add_row(*map(escape_markup, cells))
    console.print(table, highlight=False)
    console.print()
    meanings = Table(box=None, pad_edge=False, header_style="bold")
    meanings.add_column("capability", no_wrap=True)
    meanings.add_column("meaning", overflow="fold")
    for _, word, meaning in CAPABILITIES:
        meanings.add_row(word, meaning)
    console.print(meanings, highlight=False)
