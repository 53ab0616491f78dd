"""Run tasks in other processes with joblib: on this machine or on a dask cluster."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from lavender.base.errors import InputError, require_packages

# [s] Steps that take less time are judged in this process: each worker process takes a second to start.
MIN_DURATION_OF_WORKERS = 2.0
MAX_WORKERS = 4096  # [processes] More than any machine has cores.
CONNECT_TIMEOUT = 10.0  # [s] Time for a scheduler to answer.


def check_workers(workers: Any) -> None:
    """Raise InputError unless the number of workers is -1 or 1 to MAX_WORKERS."""
    if type(workers) is not int or not (workers == -1 or 1 <= workers <= MAX_WORKERS):
        need = f"-1 (one for each core) or a whole number from 1 to {MAX_WORKERS} is needed"
        raise InputError(f"workers is {workers!r}; {need}")


def map_unordered(
    function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], workers: int, backend: str
) -> Iterator[Any]:
    """Call `function` with each tuple of `arguments` on workers, and yield each result as soon as it is available.

    `backend` is a name that `connect_backend` returned. The iteration ends early, without an exception, if workers
    were lost.
    """
    require_packages("a measurement by worker processes", "joblib")
    import joblib

    lost: tuple[type[BaseException], ...] = (BrokenPipeError, ConnectionError)
    with contextlib.suppress(ImportError):
        from joblib.externals.loky.process_executor import BrokenProcessPool

        lost = (*lost, BrokenProcessPool)
    if backend == "dask":
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker

        lost = (*lost, KilledWorker, FutureCancelledError)
    with joblib.parallel_config(backend=backend, n_jobs=workers):
        calls = (joblib.delayed(_call_in_worker)(os.getpid(), function, each) for each in arguments)
        try:
            results = joblib.Parallel(return_as="generator_unordered", batch_size=1)(calls)
            try:
                for result in results:  # noqa: UP028 - `yield from` would close `results` without the filter below
                    yield result
            except GeneratorExit:
                with warnings.catch_warnings():  # joblib warns about the calls that it cancels.
                    warnings.simplefilter("ignore", UserWarning)
                    results.close()
                raise
        except lost:
            return


def _call_in_worker(
    parent: int, function: Callable[..., Any], call_arguments: tuple[Any, ...]
) -> Any:
    """Call the function in a worker."""
    if parent != os.getpid():
        warnings.filterwarnings("ignore", "solver plug-in")  # The parent has reported it.
    return function(*call_arguments)


def connect_backend(spec: str) -> tuple[str, contextlib.AbstractContextManager[Any]]:
    """Return joblib's name of a backend, and a context manager that holds the connection to its cluster."""
    from joblib.parallel import BACKENDS

    name, _, address = spec.partition("=")
    if name not in (*BACKENDS, "dask") or (address and name != "dask") or name == "ray":
        known = "'loky' runs processes on this machine, 'dask' or 'dask=ADDRESS' a cluster"
        raise InputError(f"joblib has no backend {spec!r}: {known}")
    if name != "dask":
        return name, contextlib.nullcontext()
    try:
        import dask
        import distributed
    except ImportError:
        raise InputError(
            "backend 'dask' needs distributed: pip install 'lavender-contact[cluster]'"
        ) from None
    address = address or dask.config.get("scheduler-address", "")
    try:
        if address:
            return name, distributed.Client(address, timeout=CONNECT_TIMEOUT)  # type: ignore[no-untyped-call]
        distributed.get_client()
    except (OSError, ValueError) as error:
        if address:
            raise InputError(f"no dask scheduler answers at {address!r} ({error})") from None
        need = "dask=tcp://HOST:8786, DASK_SCHEDULER_ADDRESS, or a distributed.Client that was made first"
        raise InputError(f"backend 'dask' needs a scheduler: {need}") from None
    return name, contextlib.nullcontext()  # The current client is used.
