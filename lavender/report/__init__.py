"""Measure solvers on cases, and write the runs as terminal tables, figures, files and a page.

lines = lavender.report.run(["pile.npz"], ["pgs", "osqp"])    # a pandas DataFrame, as `read` returns it
lavender.report.select_runs(lines)           # one row for each run
lavender.report.write(lines, "report")       # records.csv, tables, figures, index.html
lavender.report.read("report")               # the lines of its records.jsonl
lavender.report.tables.tabulate_solvers(lavender.report.Report(lines))
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lavender.report import tables
    from lavender.report.cases import Item, make_sequence, resolve_sources
    from lavender.report.findings import Report, write
    from lavender.report.runner import Event, carry_impulses, run, select_solver_names
    from lavender.report.store import Store, read, select_runs
    from lavender.report.structure import classify_structure
    from lavender.report.timing import CampaignPlan, Plan

# Module -> public names in it, imported when a name is first used: tables and pages need pandas, solving does not.
_PUBLIC_NAMES = {
    "cases": ("Item", "make_sequence", "resolve_sources"),
    "structure": ("classify_structure",),
    "findings": ("Report", "write"),
    "store": ("Store", "read", "select_runs"),
    "timing": ("CampaignPlan", "Plan"),
    "runner": ("Event", "carry_impulses", "run", "select_solver_names"),
}
_MODULE_OF_NAME = {name: module for module, names in _PUBLIC_NAMES.items() for name in names}

__all__ = [
    "CampaignPlan",
    "Event",
    "Item",
    "Plan",
    "Report",
    "Store",
    "carry_impulses",
    "classify_structure",
    "make_sequence",
    "read",
    "resolve_sources",
    "run",
    "select_runs",
    "select_solver_names",
    "tables",
    "write",
]
__dir__ = sorted(__all__).copy  # Completion shows public names only.


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name == "tables":
        return import_module("lavender.report.tables")
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF_NAME[name]}"), name)
    globals()[name] = value
    return value
