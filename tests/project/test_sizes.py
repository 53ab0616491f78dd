"""Packages keep the sizes that three people can own; docs/architecture.md names the packages."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SUFFIXES = {".py", ".pyx", ".pxd", ".c", ".h", ".js", ".html", ".css", ".j2"}
GENERATED = {ROOT / "lavender" / "export" / "c" / "lavender.c"}
#: Lines that a package may have. A package joins the table when it has come below its budget; budgets only shrink.
BUDGETS = {
    "lavender/contract": 350,
    "lavender/export": 2900,
    "lavender/gradient": 1600,
    "lavender/suite": 1900,
    "lavender_ext/engine": 2650,
}


def count_lines(package):
    """Count the lines of the sources of a package."""
    files = (path for path in (ROOT / package).rglob("*") if path.suffix in SUFFIXES and path not in GENERATED)
    return sum(path.read_bytes().count(b"\n") for path in files)


@pytest.mark.parametrize("package", BUDGETS)
def test_package_has_at_most_five_percent_more_lines_than_its_budget(package):
    assert 0 < count_lines(package) <= 1.05 * BUDGETS[package]
