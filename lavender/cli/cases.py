"""`lavender cases`."""

from __future__ import annotations

import click

from lavender.cli.options import say


@click.command()
@click.argument("pattern", default="")
def cases(pattern: str) -> None:
    """List the families of the built-in suite: parameters, defaults, purpose.

    PATTERN selects families whose name or description contains it. A case is a family with parameters:
    "pyramid(k=20)".
    """
    from lavender.base.errors import UnknownName
    from lavender.lab.suite.case import FAMILIES, spell

    found = {
        name: f
        for name, f in sorted(FAMILIES.items())
        if pattern.lower() in name.lower() or pattern.lower() in f.summary.lower()
    }
    if not found:
        raise UnknownName("family of cases", pattern, FAMILIES)
    for name, f in found.items():
        given = {n: f.preset.get(n, p.default) for n, p in f.signature.parameters.items()}
        words = ", ".join(n if v is p.empty else f"{n}={spell(v)}" for (n, v), p in
                          zip(given.items(), f.signature.parameters.values(), strict=True))  # fmt: skip
        say(f"{name}({words})", style="bold")
        say(f"    {f.summary}")
