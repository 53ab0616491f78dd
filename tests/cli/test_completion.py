"""Completion of names in a shell."""

import pytest
from click.shell_completion import ShellComplete

from lavender.cli.entry import cli

HAS_ALL_NAMES = {
    "solve x.npz --solver": ("pg", {"pgs"}),
    "report --solvers": ("auto,sequential_imp", {"auto,sequential_impulses"}),
    "check --solvers": ("nn", {"nncg"}),
    "run": ("four_b", {"four_bar"}),
    "run stack --solver": ("ad", {"admm"}),
    "audit model.xml --engine": ("mujo", {"mujoco", "mujoco_warp"}),
    "check x.npz --reference": ("osq", {"osqp"}),
    "contract": ("jac", {"jacobi"}),
    "solvers": ("hig", {"highs"}),
}


def complete(words, incomplete):
    """Return the items that a shell shows for a command line whose last word is `incomplete`."""
    return ShellComplete(cli, {}, "lavender", "_LAVENDER_COMPLETE").get_completions(
        words, incomplete
    )


@pytest.mark.parametrize("line", HAS_ALL_NAMES)
def test_names_of_solvers_scenes_and_engines_are_completed(line):
    incomplete, expected = HAS_ALL_NAMES[line]
    assert {item.value for item in complete(line.split(), incomplete)} >= expected
    assert all(item.value.startswith(incomplete) for item in complete(line.split(), incomplete))


@pytest.mark.parametrize("command", ["solve", "check", "report", "doctor", "explain"])
def test_problems_are_completed_by_cases_sets_and_files(command):
    items = complete([command], "toy")
    assert [item.value for item in items if item.type == "plain"] == ["toy_stack"]
    assert [item.value for item in items if item.type == "file"] == ["toy"]
    assert "@hard" in {item.value for item in complete([command], "@h")}
