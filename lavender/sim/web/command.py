"""The command `lavender web`."""

from __future__ import annotations

from pathlib import Path

import click


def _print_message(text: str) -> None:
    click.echo(text, err=True)


@click.group(invoke_without_command=True)
@click.pass_context
def web(context: click.Context) -> None:
    """Open a page that runs the kernels in a browser.

    The kernels are compiled to WebAssembly. The commands build the module and the page.
    """
    if context.invoked_subcommand is not None:
        return
    # Write the page to a temporary folder and serve it until Ctrl-C.
    import webbrowser
    from tempfile import TemporaryDirectory

    from lavender.sim.web import pages

    with TemporaryDirectory(prefix="lavender-web-") as folder:
        pages.write_page(Path(folder), _print_message)
        with pages.create_file_server(Path(folder)) as server:
            address = f"http://127.0.0.1:{server.server_address[1]}/"
            click.echo(f"{address}   Ctrl-C ends")
            webbrowser.open(address)
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                click.echo()


@web.command()
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path), metavar="OUT.wasm")
@click.option(
    "--part",
    type=click.Choice(["lavender", "newton"]),
    default="lavender",
    show_default=True,
    help="lavender: the independent module; newton: the module for exact solves, loaded in addition to it.",
)
def build(out: Path, part: str) -> None:
    """Compile the kernels to one WebAssembly module.

    It needs the extra `wasm`, or a compiler named in LAVENDER_WASM_CC and LAVENDER_WASM_LD.
    """
    from lavender.sim.web import pages

    result = pages.build_module(out, part)
    click.echo(f"{out}: {result.size} bytes, {len(result.functions)} functions ({result.compiler})")


@web.command()
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
def page(folder: Path) -> None:
    """Write the page into FOLDER, for any file server; nothing in it needs Python or a network."""
    from lavender.sim.web import pages

    click.echo(str(pages.write_page(folder, _print_message)))


@web.command()
def check() -> None:
    """Compare both WebAssembly modules bit by bit with the native kernels under Node; build them if necessary.

    It needs a checkout of the project, whose tests/sim/web it runs, and Node 18 or newer. Exit code 1: a bit differs.
    """
    from lavender.base.exits import EXIT_UNMET
    from lavender.sim.web import pages

    if not pages.compare_with_native_kernels(_print_message):
        raise click.exceptions.Exit(EXIT_UNMET)
