"""`python -m benchmarks NAME [OPTIONS]`, in the folder of the checkout."""

from __future__ import annotations

import importlib
import os

import click

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # before NumPy is imported

NAMES = (
    "backends",
    "corpus",
    "engine_claims",
    "kernels",
    "limits",
    "mujoco_newton",
    "page",
    "pairs",
    "peers",
    "programs",
    "rates",
    "regret",
    "scale",
    "score",
    "stability",
    "stand",
    "worlds",
)


class Benchmarks(click.Group):
    """Group of commands; a command's module is imported when it is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        return list(NAMES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return the command of `benchmarks.NAME`."""
        if cmd_name not in NAMES:
            return None
        command: click.Command = importlib.import_module(f"benchmarks.{cmd_name}").command
        return command


@click.group(cls=Benchmarks)
def cli() -> None:
    """Benchmarks of lavender itself."""


def main() -> None:
    """Run the command line; errors of lavender are printed as one line, as in its own commands."""
    from lavender.base.errors import LavenderError

    try:
        cli(prog_name="python -m benchmarks")
    except LavenderError as error:
        click.echo(f"benchmarks: {error}", err=True)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
