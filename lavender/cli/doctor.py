"""`lavender doctor`: what this installation is, and whether its kernels give the bits that they give elsewhere."""

from __future__ import annotations

import json

import click

from lavender.bench import doctor as bench_doctor

__all__ = ["doctor"]


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Everything as JSON, for a report of a bug.")
def doctor(as_json: bool) -> None:
    """Versions, processor, compiler, backends, and a self-test of bits. Status 1 where bits differ."""
    found = bench_doctor.examine()
    if as_json:
        click.echo(json.dumps(found, indent=2, ensure_ascii=True))
    else:
        for key, value in found.items():
            if key not in ("self_test", "same_bits"):
                text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
                click.echo(f"{key:<14}{text}")
        wrong = {name: said for name, said in found["self_test"].items() if said != "same"}
        click.echo(
            f"{'self-test':<14}{len(found['self_test']) - len(wrong)} of {len(found['self_test'])} give their bits"
        )
        for name, said in wrong.items():
            click.echo(f"{'':<14}{name}: {said}")
    if not found["same_bits"]:
        raise SystemExit(1)
