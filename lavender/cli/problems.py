"""Define `lavender problems`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.base.errors import InputError
from lavender.cli.options import (
    EXIT_UNMET,
    FILE,
    FOLDER,
    limit_to_one_thread,
    print_escaped,
    reject_unused_options,
)
from lavender.io.stored import check_writable, lock_output, write_text


@click.command()
@click.argument("groups", nargs=-1, metavar="[@SET | FILE | FOLDER]...")
@click.option("--out", type=FOLDER, help="Write every problem as a file here.")
@click.option("--check", is_flag=True, help="Build every problem and compare its numbers with the manifest.")
@click.option(
    "--certify",
    type=FILE,
    help="Prove properties of each solution and write this manifest; takes minutes and needs the extra `proof`.",
)
@click.option("--page", type=FILE, help="Write the catalogue as markdown.")
@click.pass_context
def problems(
    context: click.Context,
    groups: tuple[str, ...],
    out: Path | None,
    check: bool,
    certify: Path | None,
    page: Path | None,
) -> None:
    """List, build or check the problem set.

    Without an option, print a line for each problem of the named sets, or of all sets: name, size, and the proven
    properties of its solution. Only --certify accepts files and folders of your own. Problems that need a package that
    is not installed are left out, with a message.

    Exit code 1: the numbers of a problem differ from the manifest.
    """
    from lavender.lab import collection, suite
    from lavender.lab.bench.cases import is_path
    from lavender.lab.bench.record import make_file_name

    limit_to_one_thread()
    if certify is not None:
        reject_unused_options(context, ["out", "check", "page"], "with --certify")
    elif check:
        reject_unused_options(context, ["out"], "with --check")
    if out is not None:
        context.with_resource(lock_output(out, folder=True))
    for path in (certify, page):
        if path is not None:
            check_writable(path)
    names = [group.removeprefix("@") for group in groups]
    for name in names:
        if not is_path(name):
            suite.get_case_names_of_set(f"@{name}")  # An unknown set is an error before any work starts.
        elif certify is None:
            raise InputError(
                f"{name} is a file or folder, which only --certify accepts; give sets, such as @hard"
            )
    if certify is not None:
        certified = []
        for entry in collection.certify_groups(names):
            click.echo(f"{entry.name}: {entry.known}{'; ' if entry.reason else ''}{entry.reason}")
            certified.append(entry)
        collection.save_manifest(certified, certify)
        return
    entries = [e for e in collection.load_manifest() if not names or e.group in names]
    if page is not None:
        write_text(page, collection.format_catalogue(entries, collection.load_manifest(collection.RECORDED)))
    here, missing = collection.select_buildable(entries)
    for line in missing if check or out is not None else ():
        click.echo(f"left out: {line}", err=True)
    if check:
        wrong = list(collection.find_changed_problems(here))
        for line in wrong:
            click.echo(line)
        click.echo(f"{len(here) - len(wrong)} of {len(here)} problems are the same")
        if wrong:
            raise click.exceptions.Exit(EXIT_UNMET)
        return
    if out is not None:
        for entry in here:
            (case,) = suite.cases(entry.name)
            case.problem.save(out / f"{make_file_name(entry.name)}.npz")
        print_escaped(f"{len(here)} problems in {out}")
    elif page is None:
        for e in entries:
            print_escaped(f"@{e.group} {e.name}: {e.rows} rows, {e.law}, {collection.describe_properties(e)}")
