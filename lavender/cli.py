"""The command `lavender`. What a subcommand needs is imported when it runs, so that --help is quick."""

from __future__ import annotations

import importlib
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lavender._version import __version__
from lavender.errors import InputError, LavenderError
from lavender.web.command import view, web

if TYPE_CHECKING:
    from rich.console import Console

    from lavender.bench import Event, Plan, Records

    _ParamType = click.ParamType[Any]  # generic for type checkers since click 8.2, never for click 8.1
else:
    _ParamType = click.ParamType

__all__ = ["main"]

EXIT_BAD_INPUT = 2
EXIT_CONTRADICTED = 1
EXIT_INTERRUPTED = 130
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_order(word: str) -> bool:
    from lavender.ordering import ORDERS

    return word.partition(":")[0] in ORDERS


def _is_solver(word: str) -> bool:
    from lavender import registry

    return word in registry.specs() and not Path(word).exists()


class ManyValues(click.Command):
    """`--levels 1e-3 1e-6` as well as `--levels 1e-3,1e-6`: what follows is taken while it fits the option."""

    FITS: dict[str, Callable[[str], bool]] = {  # noqa: RUF012 - a constant of the class
        "--levels": _is_number,
        "--budgets": _is_number,
        "--time-budgets": _is_number,
        "--solvers": _is_solver,
        "--orders": _is_order,
    }

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Fold the values of such an option into one word, then parse as click does."""
        folded: list[str] = []
        i = 0
        while i < len(args):
            word = args[i]
            folded.append(word)
            i += 1
            if word in self.FITS and i < len(args):
                values = [args[i]]
                i += 1
                while i < len(args) and not args[i].startswith("-") and self.FITS[word](args[i]):
                    values.append(args[i])
                    i += 1
                folded.append(",".join(values))
        return super().parse_args(ctx, folded)


class Suites(ManyValues):
    """`bench auto`, `gallery`, `kernels`, `peers`, `stand` are commands; other first words are files (or ./peers)."""

    OWN = {  # noqa: RUF012 - a constant of the class
        "auto": "lavender.bench.regret:command",
        "gallery": "lavender.bench.endurance:command",
        "motions": "lavender.bench.motions:command",
        "mujoco": "lavender.bench.simulators:command",
        "kernels": "lavender.bench.kernels:command",
        "peers": "lavender.bench.peers:command",
        "stand": "lavender.bench.stand:command",
    }

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """The context of the command that the first word names, or of this one."""
        if not args or args[0] not in self.OWN:
            return super().make_context(info_name, args, parent, **extra)
        module, _, attribute = self.OWN[args[0]].partition(":")
        _one_thread()
        own: click.Command = getattr(importlib.import_module(module), attribute)
        return own.make_context(f"{info_name} {args[0]}", args[1:], parent, **extra)


class Numbers(_ParamType):
    """Numbers with commas or blanks between them."""

    name = "x,x,..."

    def __init__(self, kind: type = float) -> None:
        self.kind = kind

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        """A tuple of numbers."""
        if not isinstance(value, str):
            return tuple(value)
        try:
            return tuple(self.kind(word) for word in value.replace(",", " ").split())
        except ValueError:
            return self.fail(
                f"{value!r} is not a list of {'whole ' if self.kind is int else ''}numbers", param, ctx
            )


class Names(_ParamType):
    """Words with commas or blanks between them."""

    name = "a,b,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """A tuple of words."""
        return tuple(value.replace(",", " ").split()) if isinstance(value, str) else tuple(value)


class Seeds(_ParamType):
    """N or A:B, whole numbers."""

    name = "n"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> range:
        """The seeds."""
        if isinstance(value, range):
            return value
        first, colon, last = str(value).partition(":")
        if not colon:
            first, last = "0", first
        if not (first.isdecimal() and last.isdecimal() and int(first) < int(last)):
            return self.fail(f"{value!r} is not N or A:B, whole numbers with A < B", param, ctx)
        return range(int(first), int(last))


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="lavender")
def cli() -> None:
    """Constraint solvers of rigid-body simulation: any solver by name, its error in units, its cost."""


def _one_thread() -> None:
    # For libraries that are loaded later; those that are loaded are limited while timing.
    for name in THREADS:
        os.environ.setdefault(name, "1")


def _console(stderr: bool = False) -> Console:
    from rich.console import Console

    console = Console(stderr=stderr)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console = Console(stderr=stderr, width=140)  # into a file or a pipe: tables keep their columns
    return console


def _plan_options(command: Callable[..., Any]) -> Callable[..., Any]:
    options = (
        click.option("--solvers", type=Names(), help="Solvers by name; all that are installed if not given."),
        click.option(
            "--levels",
            type=Numbers(),
            default="1e-3,1e-6,1e-9",
            show_default=True,
            help="Relative residuals to reach.",
        ),
        click.option(
            "--budgets",
            type=Numbers(int),
            default="4,8,16,32,64",
            show_default=True,
            help="Exact iteration counts.",
        ),
        click.option(
            "--orders",
            type=Names(),
            default=None,
            help="Sweep orders beside 'given', at the middle budget; random:3 is seed 3.",
        ),
        click.option(
            "--repeats",
            type=int,
            default=3,
            show_default=True,
            help="Solves of each kind; minimum and median count.",
        ),
        click.option(
            "--time-limit",
            type=float,
            default=None,
            metavar="S",
            help="Of one solve; 1 s, or 0.25 s for the built-in suite.",
        ),
        click.option(
            "--memory", type=float, default=None, metavar="GB", help="Limit for backends of other packages."
        ),
        click.option(
            "--in-process",
            is_flag=True,
            help="Run backends of other packages here, not in a process of their own.",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def _plan(
    files: Sequence[str],
    levels: Sequence[float],
    budgets: Sequence[int],
    orders: Sequence[str] | None,
    repeats: int,
    time_limit: float | None,
) -> Plan:
    from lavender.bench import Plan

    if time_limit is None:
        time_limit = 1.0 if files else 0.25  # all of the suite in a minute
    more: dict[str, Any] = {} if orders is None else {"orders": orders}
    return Plan(levels=levels, budgets=budgets, repeats=repeats, time_limit=time_limit, **more)


@cli.command(cls=ManyValues)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@_plan_options
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("lavender-report"),
    show_default=True,
    help="Folder of the report.",
)
@click.option(
    "--sequence/--no-sequence",
    default=None,
    help="Each FOLDER holds the steps of a simulation: carry impulses from step to step. Known by itself of what "
    "`lavender run --record` leaves.",
)
@click.option("--campaign", is_flag=True, help="Error and robustness by many workers; no times.")
@click.option(
    "--seeds",
    type=Seeds(),
    default="1",
    metavar="N | A:B",
    help="With --campaign: seeds 0 to N - 1, or A to B - 1, of cases that take one.",
)
@click.option("--workers", type=int, default=-1, help="With --campaign: processes; -1 is one for each core.")
@click.option(
    "--backend", default="loky", show_default=True, help="With --campaign: a backend of joblib, such as dask."
)
@click.option(
    "--compare",
    type=click.Path(path_type=Path),
    help="Earlier records (.jsonl, or their folder) to compare with.",
)
@click.option(
    "--time-budgets",
    type=Numbers(),
    default=(),
    metavar="S,S,...",
    help="Seconds for which a solver is recommended; default: three decades about the fastest times.",
)
@click.option(
    "--peers",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="What `lavender bench peers --out FILE` measured, to show beside.",
)
@click.option("--no-figures", is_flag=True, help="Leave out the SVG and PNG files.")
def report(
    files: tuple[str, ...],
    solvers: tuple[str, ...] | None,
    levels: tuple[float, ...],
    budgets: tuple[int, ...],
    orders: tuple[str, ...] | None,
    repeats: int,
    time_limit: float | None,
    memory: float | None,
    in_process: bool,
    out: Path,
    sequence: bool | None,
    campaign: bool,
    seeds: range,
    workers: int,
    backend: str,
    compare: Path | None,
    time_budgets: tuple[float, ...],
    peers: Path | None,
    no_figures: bool,
) -> None:
    """Speed against error: every solver on every case, to each level and at each budget.

    FILES are problems (.npz, .hdf5), folders of them, folders of recorded steps, or cases of the built-in
    suite such as "stack(n=64)"; without any, the built-in suite runs. A records.jsonl is shown again
    without solving. The same command goes on where it was stopped.
    """
    from lavender import bench
    from lavender.bench.peers import read as read_peers
    from lavender.report.terminal import print_report
    from lavender.report.write import write

    for limit in time_budgets:
        if not (math.isfinite(limit) and limit > 0.0):
            raise InputError(f"time budget {limit} must be a positive number of seconds")
    console = _console()
    old = None if compare is None else bench.read(compare)
    rivals = None if peers is None else read_peers(peers)
    shown = [Path(f) for f in files if f.endswith(".jsonl")]
    if shown:
        if len(files) > 1:
            raise InputError("a records.jsonl is shown alone: give one, and no problems")
        records, stopped = bench.read(shown[0]), False
    elif campaign:
        many = bench.CampaignPlan(levels=levels, budgets=budgets, orders=orders or ())
        words = bench.seeds(files, len(seeds), seeds.start)
        records, stopped = _campaign(words, solvers, many, out / "records.jsonl", workers, backend)
    else:
        plan = _plan(files, levels, budgets, orders, repeats, time_limit)
        records, stopped = _measure(files, solvers, plan, out / "records.jsonl", memory, in_process, sequence)
    print_report(records, console, old=old, times=time_budgets)
    index = write(records, out, figures=not no_figures, old=old, times=time_budgets, peers=rivals)
    console.print(f"\n{len(records)} runs in {out / 'records.csv'}, page: [bold]{index}[/]", highlight=False)
    if stopped:
        console.print("[yellow]Stopped; the same command goes on from here.[/]")
        raise click.exceptions.Exit(EXIT_INTERRUPTED)


@cli.command(cls=Suites)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@_plan_options
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("records.jsonl"),
    show_default=True,
    help="File of the records.",
)
def bench(
    files: tuple[str, ...],
    solvers: tuple[str, ...] | None,
    levels: tuple[float, ...],
    budgets: tuple[int, ...],
    orders: tuple[str, ...] | None,
    repeats: int,
    time_limit: float | None,
    memory: float | None,
    in_process: bool,
    out: Path,
) -> None:
    """As `report`, but only the records: a .jsonl file that `lavender report` shows later.

    `lavender bench peers` compares with other engines and solvers instead, `lavender bench stand` says how long towers
    stand in each, `lavender bench gallery` runs every scene for ten minutes, `lavender bench auto` measures what auto
    loses against the best of our own solvers; see their own --help.
    """
    plan = _plan(files, levels, budgets, orders, repeats, time_limit)
    records, stopped = _measure(files, solvers, plan, out, memory, in_process)
    _console().print(f"{len(records)} runs in {out}", highlight=False)
    if stopped:
        raise click.exceptions.Exit(EXIT_INTERRUPTED)


def _measure(
    files: Sequence[str],
    solvers: Sequence[str] | None,
    plan: Plan,
    path: Path,
    memory: float | None,
    in_process: bool,
    sequence: bool | None = None,
) -> tuple[Records, bool]:
    """Run with a progress bar; (records, was it stopped by Ctrl-C)."""
    from lavender import bench

    _one_thread()
    bench.solver_names(solvers)  # before anything is loaded: names first
    if sequence and not files:
        raise InputError("--sequence needs a folder of problem files, one for each step")
    with bench.Store(path) as store:
        items = bench.resolve(files, sequence)
        found: list[Records] = []
        with _progress() as watch:
            try:
                bench.run(
                    items,
                    solvers,
                    plan,
                    store,
                    watch=watch,
                    isolate=not in_process,
                    memory=int(memory * 2**30) if memory else None,
                    into=found,
                )
            except KeyboardInterrupt:
                return found[0], True
        return found[0], False


def _campaign(
    words: Sequence[str], solvers: Sequence[str] | None, plan: Any, path: Path, workers: int, backend: str
) -> tuple[Records, bool]:
    """Run a campaign with a progress bar; (records, was it stopped by Ctrl-C)."""
    from lavender import bench

    _one_thread()
    with bench.Store(path) as store, _progress() as watch:
        try:
            made = bench.campaign(words, solvers, plan, store, workers=workers, backend=backend, watch=watch)
        except KeyboardInterrupt:
            return bench.read(path).latest(), True
        return made, False


class _progress:
    """A progress bar over pairs of case and solver, on a terminal; silent elsewhere."""

    def __enter__(self) -> Callable[[Event], None]:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self.bar = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[what]}", markup=False),
            console=_console(stderr=True),
            transient=True,
            refresh_per_second=4,  # drawing takes time from what is being timed
        )
        self.bar.start()
        task = self.bar.add_task("", total=None, what="")

        def watch(event: Event) -> None:
            self.bar.update(
                task, completed=event.done, total=event.total, what=f"{event.case} {event.solver}".strip()
            )

        return watch

    def __exit__(self, *_: object) -> None:
        self.bar.stop()


@cli.command()
@click.argument("file")
@click.option("--solver", required=True, help="Name of the solver; see `lavender solvers`.")
@click.option(
    "--tol",
    type=float,
    default=1e-6,
    show_default=True,
    help="Relative residual asked for; 0 runs the whole budget.",
)
@click.option("--max-iter", type=int, default=None, help="Iteration budget; default: the solver's.")
@click.option("--time-limit", type=float, default=None, metavar="S")
@click.option("--order", default=None, help="Sweep order, for solvers that take one.")
@click.option("--seed", type=int, default=None, help="Of a random order.")
@click.option("--history", is_flag=True, help="Print the residual along the way.")
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    default=None,
    help="Write impulse, slack and what was said of them, .npz.",
)
def solve(
    file: str,
    solver: str,
    tol: float,
    max_iter: int | None,
    time_limit: float | None,
    order: str | None,
    seed: int | None,
    history: bool,
    output: Path | None,
) -> None:
    """Solve one problem (a file, or a case of the suite) and say how wrong the answer is."""
    from lavender import bench
    from lavender.report.text import residual, seconds
    from lavender.solve import solve as solve_problem

    _one_thread()
    if output is not None:
        _check_writable(output)
    (item, *more) = bench.resolve([file])
    if more:
        raise InputError(f"{file} holds {len(more) + 1} problems; give one file")
    options: dict[str, Any] = {k: v for k, v in (("order", order), ("seed", seed)) if v is not None}
    solution = solve_problem(
        item.problem, solver, tol=tol, max_iter=max_iter, time_limit=time_limit, history=history, **options
    )
    click.echo(f"{item.name}: {item.problem.law}, {item.problem.m} rows")
    if solution.history is not None:
        click.echo(f"{'iterations':>10}  {'time':>9}  {'relative':>9}  {'energy':>9}  {'velocity':>9}")
        h = solution.history
        for n, t, r, e, v in zip(h.iterations, h.time, h.relative, h.energy, h.velocity, strict=True):
            click.echo(f"{n:>10}  {seconds(t):>9}  {residual(r):>9}  {residual(e):>9}  {residual(v):>9}")
    click.echo(str(solution))
    if output is not None:
        import numpy as np

        try:
            with output.open("wb") as f:
                np.savez(
                    f,
                    impulse=solution.impulse,
                    slack=solution.slack,
                    error=solution.residual.error,
                    relative=solution.residual.relative,
                    energy=solution.residual.energy,
                    velocity=solution.residual.velocity,
                    floor=solution.residual.floor,
                    status=solution.status.name,
                    solver=solution.solver.name,
                    iterations=solution.iterations,
                    setup_time=solution.setup_time,
                    solve_time=solution.solve_time,
                )
        except OSError as error:
            raise _unwritable(output, error) from None
        click.echo(f"written: {output}")
    if solution.status.name == "INTERRUPTED":
        raise click.exceptions.Exit(EXIT_INTERRUPTED)


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"cannot write {path} ({error.strerror or error}): give a path that you may write to")


def _check_writable(path: Path) -> None:
    # Opened for appending: what is there stays, and nothing is left where nothing was.
    existed = path.exists()
    try:
        with path.open("ab"):
            pass
    except OSError as error:
        raise _unwritable(path, error) from None
    if not existed:
        path.unlink()


@cli.command()
@click.argument("scene")
@click.option("--steps", type=int, default=240, show_default=True, help="Steps to run.")
@click.option("--iterations", type=int, default=None, help="Budget of the velocity solve; 4 to 64 sweeps.")
@click.option(
    "--warm-start/--no-warm-start", default=True, show_default=True, help="Carry impulses from step to step."
)
@click.option(
    "--set",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    help="A parameter of the scene, e.g. n=20 or order=top_down; may be repeated.",
)
@click.option("--residual", is_flag=True, help="Judge all rows of every step too.")
@click.option("--plot", type=click.Path(path_type=Path), default=None, help="Figure of the run (.svg, .png).")
@click.option("--trace", type=click.Path(path_type=Path), default=None, help="Every step's values, .csv.")
@click.option(
    "--record",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder for the problem of every step, .npz.",
)
@click.option(
    "--skip", type=int, default=0, show_default=True, help="Steps before the first that is recorded."
)
@click.option("--view", is_flag=True, help="Show the run in a page on this machine, live, then until Ctrl-C.")
@click.option(
    "--film",
    type=click.Path(path_type=Path),
    default=None,
    help="Film of the run: .gif or .png pictures, or a file for `lavender view`.",
)
def run(
    scene: str,
    steps: int,
    iterations: int | None,
    warm_start: bool,
    parameters: tuple[str, ...],
    residual: bool,
    plot: Path | None,
    trace: Path | None,
    record: Path | None,
    skip: int,
    view: bool,
    film: Path | None,
) -> None:
    """Run a LavenderSim scene of the gallery; record its steps as a sequence for `report`.

    SCENE is stack, pyramid, card_house, pile, chain, bridge, heavy_on_light, table, ramp, spinner,
    newtons_cradle or four_bar.
    """
    from lavender.engine import run_scene

    live = sys.stdout.isatty()

    def show(text: str) -> None:
        # on a terminal each line takes the place of the one before
        click.echo(f"\r{text}\x1b[K" if live else text, nl=not live)

    found = run_scene(
        scene,
        steps=steps,
        iterations=iterations,
        warm_start=warm_start,
        parameters=_parameters(parameters),
        residual=residual,
        trace=trace,
        plot=plot,
        record=record,
        skip=skip,
        view=view,
        film=film,
        every=1 if live else max(1, steps // 20),
        show=show,
    )
    if live:
        click.echo()
    best = 1e3 * found.cost.min()
    click.echo(f"{found.scene}: {len(found)} steps, {found.time[-1]:.3f} s, {best:.3g} ms a step at best")
    for name, path in (("trace", trace), ("figure", plot), ("film", film)):
        if path is not None:
            click.echo(f"{name}: {path}")
    if record is not None:
        click.echo(f"{found.recorded} problems in {record}: lavender report {record}")


def _parameters(words: tuple[str, ...]) -> dict[str, Any]:
    """`n=20` as {"n": 20}: numbers, true and false, none; else a word."""
    found: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or not name:
            raise InputError(f"--set {word!r}; NAME=VALUE is needed")
        known = {"true": True, "false": False, "none": None}
        if value.lower() in known:
            found[name] = known[value.lower()]
            continue
        try:
            found[name] = float(value) if not value.lstrip("+-").isdigit() else int(value)
        except ValueError:
            found[name] = value
    return found


@cli.command()
@click.option("--problem", default=None, help="Say for this problem (file or suite case) who takes it.")
def solvers(problem: str | None) -> None:
    """What is installed, or why not, and what each solver can do."""
    from rich.table import Table

    from lavender import bench, registry
    from lavender.problem import OPERATORS

    given = bench.resolve([problem])[0].problem if problem else None
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("solver", "laws", "reads", "can", "what it is"):
        table.add_column(name, no_wrap=name == "solver", overflow="fold")
    reasons = registry.known(given)
    for name, spec in sorted(registry.specs().items()):
        abilities = [
            word
            for word, has in (
                ("exact", spec.exact),
                ("warm start", spec.impulse),
                ("budget", spec.resumable),
                ("order", spec.order),
                ("seed", spec.seed),
                ("threads", spec.threads),
                ("history", spec.history),
            )
            if has
        ]
        reason = reasons[name]
        what = spec.summary if reason is None else f"[yellow]{_plain(reason)}[/]"
        laws = [law for law in ("linear", "lcp", "coulomb", "cone") if law in spec.laws]
        table.add_row(
            name,
            " ".join(laws),
            " ".join(o for o in OPERATORS if o in spec.operators),
            ", ".join(abilities),
            what,
            style="" if reason is None else "dim",
        )
    _console().print(table)


def _plain(text: str) -> str:
    from rich.markup import escape

    return escape(text)


@cli.command(cls=ManyValues)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--solvers", type=Names(), help="Solvers by name; all that take the problem if not given.")
@click.option("--reference", default="osqp", show_default=True, help="Whose answer to compare with.")
@click.option("--tol", type=float, default=1e-6, show_default=True)
def check(files: tuple[str, ...], solvers: tuple[str, ...] | None, reference: str, tol: float) -> None:
    """Compare solvers with a reference and with the judge.

    Exits with 1 when a claim is contradicted, with 2 when a file cannot be read.
    """
    from lavender import bench
    from lavender.check import cross_check

    _one_thread()
    console = _console()
    contradicted = unread = 0
    bench.solver_names(solvers)
    for item in bench.resolve(files):
        try:
            found = cross_check(item.problem, solvers=solvers, reference=reference, tol=tol)
        except LavenderError as error:
            console.print(f"{item.name}: {_plain(str(error))}", style="yellow", highlight=False)
            unread += isinstance(error, InputError)
            continue
        finally:
            item.forget()
        console.print(f"[bold]{_plain(item.name)}[/]", highlight=False)
        console.print(str(found), highlight=False, markup=False)
        contradicted += len(found.contradicted)
    if contradicted:
        console.print(f"[bold red]{contradicted} claims are contradicted[/]")
        raise click.exceptions.Exit(EXIT_CONTRADICTED)
    if unread:
        raise click.exceptions.Exit(EXIT_BAD_INPUT)


@cli.command()
@click.argument("model", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--steps", default=500, show_default=True, help="Steps of the simulation.")
@click.option("--every", default=5, show_default=True, help="Steps between two problems.")
@click.option(
    "--controls", default="zero", show_default=True, metavar="zero|random|FILE", help="FILE: .npy, (any, nu)."
)
@click.option("--seed", default=0, show_default=True, help="Of random controls.")
@click.option(
    "--out", required=True, type=click.Path(file_okay=False, path_type=Path), help="Folder of the problems."
)
def record(model: Path, steps: int, every: int, controls: str, seed: int, out: Path) -> None:
    """Run a MuJoCo model (MJCF) and keep its constraint problems, for `lavender report OUT`."""
    import numpy as np

    from lavender.io import record as record_steps

    try:
        import mujoco as mj
    except ImportError:
        raise InputError("mujoco cannot be imported: pip install mujoco") from None
    try:
        made = mj.MjModel.from_xml_path(str(model))
    except ValueError as error:  # MuJoCo's word about a file that it cannot read
        raise InputError(f"{model}: {error}") from None
    control: Any = controls
    if controls not in ("zero", "random"):
        try:
            control = np.load(controls, allow_pickle=False)
        except (OSError, ValueError) as error:
            raise InputError(f"--controls {controls}: {error}") from None
    found = record_steps(made, mj.MjData(made), out, steps, every=every, control=control, seed=seed)
    click.echo(str(found))
    if not found.files:
        raise InputError("no step had a constraint that could be kept: more --steps, or other --controls")


cli.add_command(web)
cli.add_command(view)


def main(args: Sequence[str] | None = None) -> None:
    """Entry point: what lavender raises on purpose becomes one line and status 2."""
    try:
        code = cli.main(
            args=None if args is None else list(args), prog_name="lavender", standalone_mode=False
        )
    except LavenderError as error:
        click.echo(f"lavender: {error}", err=True)
        code = EXIT_BAD_INPUT
    except click.exceptions.ClickException as error:
        error.show()
        code = error.exit_code
    except (click.exceptions.Abort, KeyboardInterrupt):
        click.echo("lavender: stopped", err=True)
        code = EXIT_INTERRUPTED
    except BrokenPipeError:
        # `lavender solvers | head`: nobody reads any more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except OSError as error:  # a full disk behind stdout, for one
        click.echo(f"lavender: {error}", err=True)
        code = EXIT_BAD_INPUT
    raise SystemExit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    main()
