"""Define `lavender cases`."""

from __future__ import annotations

import click

from lavender.cli.options import print_escaped


@click.command()
@click.argument("pattern", default="")
def cases(pattern: str) -> None:
    """List the families of the built-in suite.

    The list shows parameters, defaults and purpose. PATTERN selects families by a part of their name or description.
    A case is a family with parameters: "pyramid(k=20)".
    """
    from lavender.base.errors import UnknownName
    from lavender.lab.suite.case import FAMILIES, format_parameter_value

    families = {
        name: f
        for name, f in sorted(FAMILIES.items())
        if pattern.lower() in name.lower() or pattern.lower() in f.summary.lower()
    }
    if not families:
        raise UnknownName("family of cases", pattern, FAMILIES)
    for name, f in families.items():
        values = {n: f.preset.get(n, p.default) for n, p in f.signature.parameters.items()}
        words = ", ".join(n if v is p.empty else f"{n}={format_parameter_value(v)}" for (n, v), p in
                          zip(values.items(), f.signature.parameters.values(), strict=True))  # fmt: skip
        print_escaped(f"{name}({words})", style="bold")
        print_escaped(f"    {f.summary}")
