"""Complete names of solvers, cases and scenes in a shell; click completes commands, options, choices and files."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import click
from click.shell_completion import CompletionItem


def _list_matches(names: Iterable[str], incomplete: str, prefix: str = "") -> list[CompletionItem]:
    return [CompletionItem(prefix + name) for name in sorted(names) if name.startswith(incomplete)]


def complete_solver(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the names of solvers that begin with the last word of `incomplete`, a list separated by commas."""
    from lavender.solvers import registry

    done, comma, last = incomplete.rpartition(",")
    return _list_matches(registry.specs(), last, done + comma)


def complete_case_or_file(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the families and sets of the suite that begin with `incomplete`, and a request for the shell's files."""
    from lavender import suite

    names = [*suite.FAMILIES, *(f"@{name}" for name in suite.SETS)]
    # bash forgets the items before a request for files.
    return [CompletionItem(incomplete, type="file"), *_list_matches(names, incomplete)]


def complete_file_or_word(*choices: str) -> Callable[..., list[CompletionItem]]:
    """Return a function that completes files and these choices."""

    def list_items(
        context: click.Context, parameter: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type="file"), *_list_matches(choices, incomplete)]

    return list_items


def complete_scene(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the names of the built-in scenes that begin with `incomplete`."""
    from lavender.sim.scene import SCENES

    return _list_matches(SCENES, incomplete)
