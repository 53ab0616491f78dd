"""Two ways to do one thing, in CPU time: two callables here, or one statement in two checkouts.

    python -m benchmarks pairs --base COMMIT|FOLDER [--setup CODE] STATEMENT ...

Each statement runs in a process of this checkout and in one of the base, alternating, in batches of about
`BATCH_TIME`. The ratio of a pair is the time of this checkout divided by that of the base in the same round, so that a
drift of the machine's speed leaves it as it is. The table has the medians of both times, and of the ratio the median
and the quantiles of 10 and 90 %. The base commit is built in a worktree that is removed in the end.

    python -m benchmarks pairs --base HEAD~1 --setup "import lavender as lv; p = lv.suite.case('stack(n=4)').problem" \
        "lv.solve(p)" "lv.residual(p, [0.0] * p.m)"

`time_alternately` is for callables of one process, `Checkout` for calls of other benchmarks in another checkout.
"""

from __future__ import annotations

import gc
import json
import os
import select
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import process_time_ns
from typing import Any, TypeVar

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
BATCH_TIME = 2e-3  # [s] CPU time of a batch of calls of one side.
MAX_CALLS = 10_000
ROUNDS = 15

Answer = dict[str, Any]
Result = TypeVar("Result")


def run_timed(call: Callable[[], Result]) -> tuple[Result, float]:
    """Return the result of a call and its CPU time [s], without collections of garbage."""
    collects = gc.isenabled()
    gc.disable()
    try:
        begun = process_time_ns()
        result = call()
        return result, 1e-9 * (process_time_ns() - begun)
    finally:
        if collects:
            gc.enable()


def time_call(call: Callable[[], Any], count: int = 1) -> float:
    """Return the CPU time [s] of one of `count` calls."""

    def repeat() -> None:
        for _ in range(count):
            call()

    return run_timed(repeat)[1] / count


def time_anew(make: Callable[[], Any], call: Callable[[Any], Any], repeats: int = 3) -> float:
    """Return the smallest CPU time [s] of a call, each time on what `make` has returned anew."""
    return min(run_timed(partial(call, make()))[1] for _ in range(repeats))


def choose_count(call: Callable[[], Any]) -> int:
    """Return the number of calls of a batch; the function is called once."""
    return max(1, min(MAX_CALLS, int(BATCH_TIME / max(time_call(call), 1e-8))))


def time_alternately(
    *calls: Callable[[], Any],
    rounds: int = ROUNDS,
    before: Callable[[], Any] | None = None,
) -> np.ndarray:
    """Return CPU times [s] of a call of each function, of shape (rounds, functions), measured in turn.

    `before` is called before each call and not timed; every batch then has one call.
    """
    counts = [1 if before is not None else choose_count(call) for call in calls]
    times = np.empty((rounds, len(calls)))
    for line in times:
        for i, (call, count) in enumerate(zip(calls, counts, strict=True)):
            if before is not None:
                before()
            line[i] = time_call(call, count)
    return times


def time_for(seconds: float, *calls: Callable[[], Any]) -> list[float]:
    """Return the smallest CPU time [s] of a call of each function, measured in turn for about `seconds`."""
    rounds = max(3, int(seconds / (len(calls) * BATCH_TIME)))
    return [float(time) for time in time_alternately(*calls, rounds=rounds).min(axis=0)]


def describe_ratio(times: np.ndarray) -> list[str]:
    """Return the cells of a row of `HEAD`: medians [us] of both columns, median and quantiles of second over first."""
    ratios = times[:, 1] / times[:, 0]
    low, high = np.quantile(ratios, [0.1, 0.9])
    base, head = 1e6 * np.median(times, axis=0)
    return [f"{base:.3g}", f"{head:.3g}", f"{np.median(ratios):.2f}", f"{low:.2f} to {high:.2f}"]


HEAD = ["base [us]", "this [us]", "ratio", "10 to 90 %"]


# -- another checkout ---------------------------------------------------------------------------------------


class Timer:
    """Statements of a process, by number."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], Any]] = []

    def prepare_statement(self, setup: str, statement: str) -> Answer:
        """Compile a statement and run it once; return the number of calls of a batch."""
        names: dict[str, Any] = {}
        exec(setup, names)
        code = compile(statement, "<statement>", "exec")
        self.calls.append(lambda: exec(code, names))
        return {"count": choose_count(self.calls[-1])}

    def time_statement(self, number: int, count: int) -> Answer:
        """Return the CPU time [s] of a call of a statement."""
        return {"seconds": time_call(self.calls[number], count)}


def serve(calls: Mapping[str, Callable[..., Answer]]) -> None:
    """Answer lines of JSON [name, argument, ...] by calls until the input ends."""
    warnings.simplefilter("ignore")
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # Backends print.
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        try:
            answer = calls[name](*arguments)
        except Exception as error:  # An answer too: what the call says.
            answer = {"status": f"{type(error).__name__}: {error}"[:200], "seconds": float("nan")}
        print(json.dumps(answer), file=out, flush=True)


class Checkout:
    """A process in a built checkout that runs a file of this one, which calls `serve`."""

    def __init__(
        self, folder: Path, server: str | Path = __file__, python: str = sys.executable
    ) -> None:
        path = str(Path(server).resolve())
        # The other checkout may have another version of this module, or none.
        code = (
            "import importlib.util, runpy, sys\n"
            f"spec = importlib.util.spec_from_file_location('benchmarks.pairs', {str(Path(__file__).resolve())!r})\n"
            "sys.modules[spec.name] = importlib.util.module_from_spec(spec)\n"
            "spec.loader.exec_module(sys.modules[spec.name])\n"
            f"runpy.run_path({path!r}, run_name='__main__')"
        )
        environment = os.environ | {"PYTHONPATH": str(folder)}
        self.process = subprocess.Popen(
            [python, "-c", code],
            cwd=folder,
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self.arguments = folder, server, python

    def ask(self, *call: Any, limit: float | None = None) -> Answer:
        """Return the answer of a call; of one that ends the process, or takes longer than `limit` [s], its status."""
        assert self.process.stdin is not None and self.process.stdout is not None
        if self.process.poll() is None:
            self.process.stdin.write(json.dumps(call) + "\n")
            self.process.stdin.flush()
        if not select.select([self.process.stdout], [], [], limit)[0]:
            self.process.kill()
        line = self.process.stdout.readline()
        if line:
            return dict(json.loads(line))
        ended = f"process ended ({self.process.wait()})"
        self.__init__(*self.arguments)  # type: ignore[misc]
        return {"status": ended, "seconds": float("nan")}

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.communicate()


@contextmanager
def build_base(commit: str) -> Iterator[Path]:
    """Check a commit out and compile its kernels; remove it in the end. A folder is a checkout that is built."""
    if Path(commit).is_dir():
        yield Path(commit).resolve()
        return
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "base"
        subprocess.run(
            ["git", "worktree", "add", "-q", "--detach", folder, commit], cwd=ROOT, check=True
        )
        try:
            command = [sys.executable, "setup.py", "-q", "build_ext", "--inplace"]
            quiet = subprocess.DEVNULL
            subprocess.run(command, cwd=folder, check=True, stdout=quiet, stderr=quiet)
            yield folder
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", folder], cwd=ROOT, check=False)


def compare_statement(sides: list[Checkout], number: int, setup: str, statement: str) -> list[str]:
    """Return the cells of one statement, or what a side says of it."""
    prepared = [side.ask("prepare_statement", setup, statement) for side in sides]
    if wrong := [answer["status"] for answer in prepared if "status" in answer]:
        return ["", "", "", wrong[0]]
    count = min(answer["count"] for answer in prepared)
    times = [
        [side.ask("time_statement", number, count)["seconds"] for side in sides]
        for _ in range(ROUNDS)
    ]
    return describe_ratio(np.array(times))


def make_command() -> Any:
    """Return the click command; a process of another checkout does not need it."""
    import click

    from benchmarks.output import markdown

    @click.command("pairs")
    @click.argument("statements", nargs=-1, required=True)
    @click.option("--base", required=True, help="Commit to compare with, or a built checkout.")
    @click.option(
        "--setup",
        default="import lavender as lv",
        show_default=True,
        help="Code before the statements.",
    )
    def command(statements: tuple[str, ...], base: str, setup: str) -> None:
        """Compare the CPU time of statements in this checkout and in another."""
        with build_base(base) as folder:
            sides = [Checkout(folder), Checkout(ROOT)]
            rows = [
                [text, *compare_statement(sides, n, setup, text)]
                for n, text in enumerate(statements)
            ]
        click.echo(markdown(["statement", *HEAD], rows))

    return command


if __name__ == "__main__":
    timer = Timer()
    serve({name: getattr(timer, name) for name in ("prepare_statement", "time_statement")})
else:
    command = make_command()
