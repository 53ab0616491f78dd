"""Shared parts of commands: option types, options of a plan, the console, exit codes."""

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

EXIT_UNMET = (
    1  # A claim is not met: a problem is not solved, a check fails, a file in a folder cannot be read.
)
EXIT_BAD_INPUT = 2  # The input is invalid, or another process is writing to the folder.
EXIT_INFEASIBLE = 3  # The problem is infeasible, with a certificate that the judge confirms.
EXIT_INTERRUPTED = 130
MIN_TERMINAL_WIDTH = 60  # [columns] Output for a narrower terminal has this width.
PATH = click.Path(path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
Option = tuple[tuple[str, ...], dict[str, Any]]  # names of an option, and keyword arguments of click.option
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def _is_number(word: str) -> bool:
    """Whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_order(word: str) -> bool:
    """Whether a word is a sweep order, with or without a seed."""
    from lavender.problem.ordering import ORDERS

    return word.partition(":")[0] in SWEEP_ORDERS


def _is_solver(word: str) -> bool:
    """Whether a word is a solver's name, perhaps misspelled, and not a file or case."""
    from lavender.lab import suite
    from lavender.solvers import registry

    if Path(word).exists():
        return False
    names = {family.partition("(")[0] for family in suite.families()}
    # A word that is neither a case nor a path is a misspelled solver name, which is rejected with suggestions.
    return word in registry.specs() or not (word in names or set(word) & set("(*?[/\\."))


class ManyValues(click.Command):
    """Command that accepts `--levels 1e-3 1e-6` as well as `--levels 1e-3,1e-6`: words are values while they fit."""

    VALUE_TESTS: dict[str, Callable[[str], bool]] = {  # noqa: RUF012 - a constant of the class
        "--tolerances": _is_number,
        "--velocity-tolerances": _is_number,
        "--budgets": _is_number,
        "--time-budgets": _is_number,
        "--solvers": _is_solver,
        "--orders": _is_order,
    }

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Join the values of such an option with commas, then parse the arguments."""
        folded: list[str] = []
        i = 0
        while i < len(args):
            word = args[i]
            folded.append(word)
            i += 1
            if word in self.VALUE_TESTS and i < len(args):
                values = [args[i]]
                i += 1
                while i < len(args) and not args[i].startswith("-") and self.VALUE_TESTS[word](args[i]):
                    values.append(args[i])
                    i += 1
                folded.append(",".join(values))
        return super().parse_args(ctx, folded)


class ValueList(_ParamType):
    """Option type: numbers or words, separated by commas or blanks."""

    def __init__(self, kind: type) -> None:
        self.kind = kind
        self.name = "a,b,..." if kind is str else "x,x,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        """Convert a value to a tuple."""
        if not isinstance(value, str):
            return tuple(value)
        try:
            return tuple(self.kind(word) for word in value.replace(",", " ").split())
        except ValueError:
            return self.fail(
                f"{value!r} is not a list of {'whole ' if self.kind is int else ''}numbers", param, ctx
            )


class Seeds(_ParamType):
    """Option type: N or A:B, integers."""

    name = "n"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> range:
        """Convert a value to a range of seeds."""
        if isinstance(value, range):
            return value
        first, colon, last = str(value).partition(":")
        if not colon:
            first, last = "0", first
        if not (first.isdecimal() and last.isdecimal() and int(first) < int(last)):
            return self.fail(f"{value!r} is not N or A:B, whole numbers with A < B", param, ctx)
        return range(int(first), int(last))


def set_one_thread() -> None:
    """Limit libraries that are loaded later to one thread; loaded libraries are limited while times are measured."""
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, "1")


def console(stderr: bool = False) -> Console:
    """Create the rich console: at least MIN_TERMINAL_WIDTH wide on a terminal, wide enough for any table elsewhere."""
    from rich.console import Console

    known = Console(stderr=stderr).is_terminal or os.environ.get("COLUMNS", "0").strip("0").isdigit()
    # At this width no line is folded or cut.
    width = max(shutil.get_terminal_size().columns, MIN_TERMINAL_WIDTH) if known else 10_000
    return Console(stderr=stderr, width=width)


def discard_output() -> None:
    """Redirect stdout to the null device, after its reader has closed it (as `| head` does)."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def ignore_closed_pipe() -> Iterator[None]:
    """Continue if the reader of stdout closes it, so that a command still writes its files."""
    try:
        yield
    except (BrokenPipeError, SystemExit):  # rich converts BrokenPipeError to SystemExit.
        discard_output()


def was_given(context: click.Context, name: str) -> bool:
    """Whether an option was given on the command line or in the environment, with any value."""
    return context.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT)


def add_options(
    options: Sequence[Option], **shared: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds options to a command, in this order, with `shared` arguments for all of them."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for names, more in reversed(options):
            command = click.option(*names, **shared, **more)(command)
        return command

    return decorate


def worlds_options(worlds: int, steps: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds the options of simulated worlds, with these default numbers."""
    options: list[Option] = [
        (("--worlds",), {"default": worlds, "help": "Number of worlds; the first is that of `lavender record`."}),
        (("--steps",), {"default": steps, "help": "Number of steps of each world."}),
        (("--spread",), {"default": 0.1, "metavar": "M/S",
                         "help": "Standard deviation of the noise on the initial velocities of the other worlds."}),
    ]  # fmt: skip
    options += [
        (names, more) for names, more in RECORDING_OPTIONS if names[0] in ("--controls", "--seed", "--states")
    ]
    return add_options(options, show_default=True)


def reject_unused_recording(context: click.Context, recorded: bool) -> None:
    """Reject recording options that would be ignored."""
    if not recorded:
        reject_unused(context, RECORDING, "without a MODEL.xml")
    elif context.params["control"] != "random":
        reject_unused(context, ["seed"], "without --controls random")


def reject_unused(context: click.Context, names: Sequence[str], reason: str) -> None:
    """Reject options that would be ignored.

    Raises
    ------
    InputError
        One of them was given; the message ends with `reason`.
    """
    options = {p.name: p.opts[0] for p in context.command.params}
    for name in names:
        if was_given(context, name):
            raise InputError(f"{options[name]} has no effect {reason}: leave it out")


def reject_idle(context: click.Context, solvers: Sequence[str] | None) -> None:
    """Reject options of a plan that none of the named solvers uses.

    Raises
    ------
    InputError
        An option has no effect.
    UnknownName
        A solver does not exist.
    """
    from lavender.lab.bench.running.runner import is_foreign
    from lavender.solvers import registry

    if not solvers:
        return
    specs = [registry.get(name) for name in solvers]
    if not any(s.resumable and not s.exact for s in specs):
        reject_unused(context, ["budgets"], "on solvers that cannot stop after any iteration")
    if not any(s.order and not s.exact for s in specs):
        reject_unused(context, ["orders"], "on solvers without a sweep order")
    if not any(map(is_foreign, specs)):
        reject_unused(context, ["memory"], "if no solver of another package runs")


#: Option for the answers of an engine.
precision_option = click.option(
    "--precision", type=click.Choice(["float64", "float32"]),
    help="Precision in which the engine computed its solutions; default: that of the problem, or float64.",
)  # fmt: skip
THRESHOLD: Option = (("--threshold",), {
    "type": float, "default": 1e-6, "help": "Velocity error [m/s] up to which an engine's solution is close enough.",
})  # fmt: skip
threshold_option = add_options([THRESHOLD], show_default=True)
#: Options of all commands that simulate and record a MuJoCo model.
RECORDING_OPTIONS: tuple[Option, ...] = (
    (("--steps",), {"default": 500, "help": "MODEL.xml: number of simulation steps."}),
    (("--record-every", "every"), {"default": 5, "help": "MODEL.xml: record every n-th step."}),
    (("--controls", "control"), {"default": "random", "metavar": "zero|random|FILE",
                                 "help": "MODEL.xml: controls. FILE: an .npy array of shape (any, nu)."}),
    (("--seed",), {"default": 0, "help": "MODEL.xml: seed of random controls."}),
    (("--states",), {"default": None, "metavar": "FILE|keyframes",
                     "help": "MODEL.xml: start from these states. FILE: an .npz, best with `state`, rows of "
                     "mjSTATE_INTEGRATION (with warm start and controls); otherwise qpos, qvel and other arrays of "
                     "MjData, such as `lavender audit` writes. keyframes: the model's own."}),
)  # fmt: skip
RECORDING = ("steps", "every", "control", "seed", "states", "threshold")  # parameter names of these options
recording_options = add_options([THRESHOLD, *RECORDING_OPTIONS], show_default=True)

#: Options of measurements.
PLAN_OPTIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("--solvers", {"type": ValueList(str), "help": "Solvers by name; default: all that are installed."}),
    ("--levels", {"type": ValueList(float), "default": "1e-3,1e-6,1e-9", "show_default": True,
                  "help": "Relative residuals to reach."}),
    ("--motion", {"is_flag": True, "help": "Also measure the motion error: the relative error of the velocities, "
                  "by a reference that is solved once for each case."}),
    ("--prove", {"is_flag": True, "help": "Measure the motion error from an exact solution that is enclosed with a "
                 "proof, if there is one (extra `proof`); implies --motion."}),
    ("--speed-levels", {"type": ValueList(float), "default": (), "metavar": "M/S,M/S,...",
                        "help": "Motion errors to reach, in metres per second; implies --motion."}),
    ("--budgets", {"type": ValueList(int), "default": "4,8,16,32,64", "show_default": True,
                   "help": "Numbers of iterations to run exactly."}),
    ("--orders", {"type": ValueList(str), "default": None,
                  "help": "Sweep orders to compare with 'given', at the middle budget; random:3 uses seed 3."}),
    ("--repeats", {"type": int, "default": 3, "show_default": True,
                   "help": "Repetitions of each solve; minimum and median are recorded."}),
    ("--time-limit", {"type": float, "default": None, "metavar": "S",
                      "help": "Limit of one solve; default: 1 s, or 0.25 s for the built-in suite."}),
    ("--sequence-time-limit", {"type": float, "default": None, "metavar": "S",
                      "help": "Time limit of a solver over all steps of a sequence with one setting; default: 5 s."}),
    ("--memory", {"type": float, "default": None, "metavar": "GB",
                  "help": "Memory limit of each process of another package's solver; default: half of the "
                  "machine's memory, shared by the workers (--workers)."}),
)  # fmt: skip
plan_options = add_options([((name,), more) for name, more in PLAN_OPTIONS])


def to_bytes(gigabytes: float | None) -> int | None:
    """Convert the value of an option in GB to bytes.

    Raises
    ------
    InputError
        It is not a positive number.
    """
    if gigabytes is None:
        return None
    if not 0.0 < gigabytes < 2**20:
        raise InputError(f"memory is {gigabytes} GB; a positive number is needed")
    return int(gigabytes * 2**30)


def escape_markup(text: str) -> str:
    """Escape markup of rich, and write control characters of a terminal as their codes."""
    from rich.markup import escape

    from lavender.lab.bench.record import printable

    return escape(printable(text, lines=True))


def echo(text: str, err: bool = False, style: str = "") -> None:
    """Print text that may contain names of files and problems: control characters are written as their codes."""
    from lavender.lab.bench.record import printable

    if style:
        console(err).print(escape_markup(text), style=style, highlight=False, soft_wrap=True)
    else:
        click.echo(printable(text, lines=True), err=err)


def exit_interrupted() -> NoReturn:
    """Exit after Ctrl-C, when the results so far are written."""
    echo("Stopped: the results are of the work until then.", style="yellow")
    raise click.exceptions.Exit(EXIT_INTERRUPTED)


class Reading:
    """Context for the work on each problem of a command: errors are reported and determine the exit code."""

    def __init__(self, report: Callable[[str], Any] | None = None) -> None:
        self.report = report or partial(echo, err=True)
        self.code = 0

    @contextlib.contextmanager
    def __call__(self, item: Item) -> Iterator[None]:
        """Work on one problem, whose memory is released at the end."""
        try:
            yield
        except LavenderError as error:
            self.report(f"{item.name}: {error}")
            named = isinstance(error, InputError) and item.named
            self.code = max(self.code, EXIT_BAD_INPUT if named else EXIT_UNMET)
        finally:
            item.forget()

    def end(self, unmet: Any = False) -> None:
        """Exit: with 2 if a named problem could not be read, with 1 if another could not, or if `unmet`."""
        if code := self.code or (EXIT_UNMET if unmet else 0):
            raise click.exceptions.Exit(code)


def parse_parameters(words: tuple[str, ...]) -> dict[str, Any]:
    """Convert words such as `n=20` to {"n": 20}: values are numbers, true, false, none, or strings."""
    parameters: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or not name:
            raise InputError(f"--set {word!r}; NAME=VALUE is needed")
        known = {"true": True, "false": False, "none": None}
        if value.lower() in known:
            parameters[name] = known[value.lower()]
            continue
        try:
            parameters[name] = float(value) if not value.lstrip("+-").isdigit() else int(value)
        except ValueError:
            parameters[name] = value
    return parameters
