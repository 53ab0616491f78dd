"""What commands share: kinds of values, options of a plan, the console, exit codes."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from lavender.base.errors import InputError, LavenderError

if TYPE_CHECKING:
    from rich.console import Console

    from lavender.lab.bench import Item

    _ParamType = click.ParamType[Any]  # generic for type checkers since click 8.2, never for click 8.1
else:
    _ParamType = click.ParamType

EXIT_UNMET = 1  # a claim not met: unsolved, a failed check, an unreadable file met in a folder
EXIT_BAD_INPUT = 2  # or a folder that another process writes
EXIT_INFEASIBLE = 3  # with a certificate that the judge confirms
EXIT_INTERRUPTED = 130
LEAST_WIDTH = 60  # columns of a terminal
PATH = click.Path(path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
Option = tuple[tuple[str, ...], dict[str, Any]]  # names, and what click is told of it
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_order(word: str) -> bool:
    from lavender.problem.ordering import SWEEP_ORDERS

    return word.partition(":")[0] in SWEEP_ORDERS


def _is_solver(word: str) -> bool:
    from lavender.lab import suite
    from lavender.solvers import registry

    if Path(word).exists():
        return False
    names = {family.partition("(")[0] for family in suite.families()}
    # What is no case and no path either is a solver's name with a mistake in it, and is refused as such.
    return word in registry.specs() or not (word in names or set(word) & set("(*?[/\\."))


class ManyValues(click.Command):
    """`--levels 1e-3 1e-6` as well as `--levels 1e-3,1e-6`: what follows is taken while it fits the option."""

    FITS: dict[str, Callable[[str], bool]] = {  # noqa: RUF012 - a constant of the class
        "--levels": _is_number,
        "--speed-levels": _is_number,
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


class Listed(_ParamType):
    """Numbers, or words, with commas or blanks between them."""

    def __init__(self, kind: type) -> None:
        self.kind = kind
        self.name = "a,b,..." if kind is str else "x,x,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        """A tuple of them."""
        if not isinstance(value, str):
            return tuple(value)
        try:
            return tuple(self.kind(word) for word in value.replace(",", " ").split())
        except ValueError:
            return self.fail(
                f"{value!r} is not a list of {'whole ' if self.kind is int else ''}numbers", param, ctx
            )


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


def one_thread() -> None:
    """One thread for libraries that are loaded later; those that are loaded are limited while timing."""
    for name in THREADS:
        os.environ.setdefault(name, "1")


def console(stderr: bool = False) -> Console:
    """A terminal to print on, never so narrow that names are cut; into a file or a pipe as wide as tables need."""
    from rich.console import Console

    known = Console(stderr=stderr).is_terminal or os.environ.get("COLUMNS", "0").strip("0").isdigit()
    # nothing is folded or cut
    width = max(shutil.get_terminal_size().columns, LEAST_WIDTH) if known else 10_000
    return Console(stderr=stderr, width=width)


def unheard() -> None:
    """Nobody reads what is printed (`| head`): from here on it goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def going_on() -> Iterator[None]:
    """Around what a command prints before it has written its last file: written it is, whoever reads."""
    try:
        yield
    except (BrokenPipeError, SystemExit):  # rich makes an exit of it
        unheard()


def was_given(context: click.Context, name: str) -> bool:
    """An option stands on the command line (or in the environment), whatever its value."""
    return context.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT)


def adding(options: Sequence[Option], **same: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator that gives a command these options in their order, and all of them what is the `same`."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for names, more in reversed(options):
            command = click.option(*names, **same, **more)(command)
        return command

    return decorate


def worlds_options(worlds: int, steps: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Which worlds of a MuJoCo model are simulated, with these numbers as the defaults."""
    options: list[Option] = [
        (("--worlds",), {"default": worlds, "help": "How many; the first is that of `lavender record`."}),
        (("--steps",), {"default": steps, "help": "Of each world."}),
        (("--spread",), {"default": 0.1, "metavar": "M/S",
                         "help": "Standard deviation of what the others' first velocities differ by."}),
    ]  # fmt: skip
    options += [
        (names, more) for names, more in RECORDING_OPTIONS if names[0] in ("--controls", "--seed", "--states")
    ]
    return adding(options, show_default=True)


def refuse_unused_recording(context: click.Context, recorded: bool) -> None:
    """Refuse those that would be ignored."""
    if not recorded:
        refuse_unused(context, RECORDING, "without a MODEL.xml")
    elif context.params["control"] != "random":
        refuse_unused(context, ["seed"], "without --controls random")


def refuse_unused(context: click.Context, names: Sequence[str], where: str) -> None:
    """Refuse options that would be ignored.

    Raises
    ------
    InputError
        One of them was given.
    """
    options = {p.name: p.opts[0] for p in context.command.params}
    for name in names:
        if was_given(context, name):
            raise InputError(f"{options[name]} has no effect {where}: leave it out")


def refuse_idle(context: click.Context, solvers: Sequence[str] | None) -> None:
    """Refuse options of a plan that none of the named solvers heeds.

    Raises
    ------
    InputError, UnknownName
    """
    from lavender.lab.bench.running.runner import is_foreign
    from lavender.solvers import registry

    if not solvers:
        return
    specs = [registry.get(name) for name in solvers]
    if not any(s.resumable and not s.exact for s in specs):
        refuse_unused(context, ["budgets"], "on solvers that cannot stop after any iteration")
    if not any(s.order and not s.exact for s in specs):
        refuse_unused(context, ["orders"], "on solvers that take no order")
    if not any(map(is_foreign, specs)):
        refuse_unused(context, ["memory"], "where no solver of another package runs")


#: Of answers that an engine made.
precision_option = click.option(
    "--precision", type=click.Choice(["float64", "float32"]),
    help="Precision in which the engine computed its solutions; default: that of the problem, or float64.",
)  # fmt: skip
THRESHOLD: Option = (("--threshold",), {
    "type": float, "default": 1e-6, "help": "Velocity error [m/s] up to which an engine's solution is close enough.",
})  # fmt: skip
threshold_option = adding([THRESHOLD], show_default=True)
#: How a MuJoCo model is simulated and recorded: the same options of every command that does so.
RECORDING_OPTIONS: tuple[Option, ...] = (
    (("--steps",), {"default": 500, "help": "MODEL.xml: number of simulation steps."}),
    (("--every",), {"default": 5, "help": "MODEL.xml: record every n-th step."}),
    (("--controls", "control"), {"default": "random", "metavar": "zero|random|FILE",
                                 "help": "MODEL.xml: its controls. FILE: an .npy array of shape (any, nu)."}),
    (("--seed",), {"default": 0, "help": "MODEL.xml: seed of random controls."}),
    (("--states",), {"default": None, "metavar": "FILE|keyframes",
                     "help": "MODEL.xml: start from these states. FILE: an .npz, best with `state`, vectors of "
                     "mjSTATE_INTEGRATION (with warm start and controls) in its rows; else qpos and qvel, and other "
                     "arrays of MjData, such as `lavender audit` writes. keyframes: those of the model."}),
)  # fmt: skip
RECORDING = ("steps", "every", "control", "seed", "states", "threshold")  # their names
recording_options = adding([THRESHOLD, *RECORDING_OPTIONS], show_default=True)

#: Of what is measured.
PLAN_OPTIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("--solvers", {"type": Listed(str), "help": "Solvers by name; default: all that are installed."}),
    ("--levels", {"type": Listed(float), "default": "1e-3,1e-6,1e-9", "show_default": True,
                  "help": "Relative residuals to reach."}),
    ("--motion", {"is_flag": True, "help": "Also measure the motion error: how wrong the velocities of the bodies are, "
                  "relative to a reference that is solved once for each case."}),
    ("--prove", {"is_flag": True, "help": "Measure the motion error from an exact solution that is enclosed with "
                 "proof, where one is (extra `proof`); implies --motion."}),
    ("--speed-levels", {"type": Listed(float), "default": (), "metavar": "M/S,M/S,...",
                        "help": "Motion errors to reach, in metres per second; implies --motion."}),
    ("--budgets", {"type": Listed(int), "default": "4,8,16,32,64", "show_default": True,
                   "help": "Numbers of iterations to run exactly."}),
    ("--orders", {"type": Listed(str), "default": None,
                  "help": "Sweep orders to compare with 'given', at the middle budget; random:3 uses seed 3."}),
    ("--repeats", {"type": int, "default": 3, "show_default": True,
                   "help": "Repetitions of each solve; minimum and median are kept."}),
    ("--time-limit", {"type": float, "default": None, "metavar": "S",
                      "help": "Limit of one solve; default: 1 s, or 0.25 s for the built-in suite."}),
    ("--pass-limit", {"type": float, "default": None, "metavar": "S",
                      "help": "Limit of a solver over all steps of a sequence, at one budget or level; default: 5 s."}),
    ("--memory", {"type": float, "default": None, "metavar": "GB",
                  "help": "Memory limit of each process of another package's solver; default: half of the "
                  "machine's memory, shared by the workers (--workers)."}),
)  # fmt: skip
plan_options = adding([((name,), more) for name, more in PLAN_OPTIONS])


def bytes_of(gigabytes: float | None) -> int | None:
    """Bytes of an option in GB.

    Raises
    ------
    InputError
        Not a positive number.
    """
    if gigabytes is None:
        return None
    if not 0.0 < gigabytes < 2**20:
        raise InputError(f"memory is {gigabytes} GB; a positive number is needed")
    return int(gigabytes * 2**30)


def plain(text: str) -> str:
    """Text with what rich would take for markup escaped, and what a terminal would obey written as its code."""
    from rich.markup import escape

    from lavender.lab.bench.record import printable

    return escape(printable(text, lines=True))


def say(text: str, err: bool = False, style: str = "") -> None:
    """Print what names of files and problems are part of: what a terminal would obey is written as its code."""
    from lavender.lab.bench.record import printable

    if style:
        console(err).print(plain(text), style=style, highlight=False, soft_wrap=True)
    else:
        click.echo(printable(text, lines=True), err=err)


def end_stopped() -> NoReturn:
    """The end of a command that Ctrl-C ended early, once what was done is written."""
    say("Stopped: of what was done until then.", style="yellow")
    raise click.exceptions.Exit(EXIT_INTERRUPTED)


class Reading:
    """Around what is done with each problem of a command: what a file makes raise is told, and costs the exit code."""

    def __init__(self, tell: Callable[[str], Any] | None = None) -> None:
        self.tell = tell or partial(say, err=True)
        self.code = 0

    @contextlib.contextmanager
    def __call__(self, item: Item) -> Iterator[None]:
        """One problem, whose memory is let go of at the end."""
        try:
            yield
        except LavenderError as error:
            self.tell(f"{item.name}: {error}")
            named = isinstance(error, InputError) and item.named
            self.code = max(self.code, EXIT_BAD_INPUT if named else EXIT_UNMET)
        finally:
            item.forget()

    def end(self, unmet: Any = False) -> None:
        """The exit of the command: 2 where a named problem could not be read, 1 for another, or where `unmet`."""
        if code := self.code or (EXIT_UNMET if unmet else 0):
            raise click.exceptions.Exit(code)


def parameters_of(words: tuple[str, ...]) -> dict[str, Any]:
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
