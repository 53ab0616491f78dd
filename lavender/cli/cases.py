"""Define `lavender cases`."""

from __future__ import annotations

import click

from lavender.cli.options import echo


@click.command()
@click.argument("pattern", default="")
def cases(pattern: str) -> None:
    """List the families of the built-in suite.

    The list shows parameters, defaults and purpose. PATTERN selects families whose name or description contains it.
    A case is a family with parameters: "pyramid(k=20)".
    """
    from lavender.base.errors import UnknownName
    from lavender.lab.suite.case import FAMILIES, spell

    families = {
        name: f
        for name, f in sorted(FAMILIES.items())
        if pattern.lower() in name.lower() or pattern.lower() in f.summary.lower()
    }
    if not families:
        raise UnknownName("family of cases", pattern, FAMILIES)
    for name, f in families.items():
        values = {n: f.preset.get(n, p.default) for n, p in f.signature.parameters.items()}
        words = ", ".join(n if v is p.empty else f"{n}={spell(v)}" for (n, v), p in
                          zip(values.items(), f.signature.parameters.values(), strict=True))  # fmt: skip
        echo(f"{name}({words})", style="bold")
        echo(f"    {f.summary}")
