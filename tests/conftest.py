"""What all tests share: one thread for BLAS, no display, reproducible examples, the reference problems."""

import os
import signal
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(
        variable, "1"
    )  # before NumPy starts its threads: small matrices only lose by them
os.environ.setdefault("MPLBACKEND", "Agg")
# Workers of xdist and other processes would compile all that they import each time: 1.8 of 3.0 s of a command.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # As shells start what runs in the background; no test of Ctrl-C could interrupt its process.
    signal.signal(signal.SIGINT, signal.default_int_handler)

from functools import partial

import hypothesis
import pytest

for variable in ("COLUMNS", "LINES"):
    # readline, which pytest loads, tells processes that it starts of a terminal: what they print would be folded.
    os.environ.pop(variable, None)
    os.unsetenv(variable)

# A shared machine may take any time for an example, and a generator may reject any share of them. The examples of a
# change are the same in every run; `--nightly` draws new ones, and .ci/fuzz (profile "search") draws many.
free = hypothesis.settings(
    deadline=None, suppress_health_check=list(hypothesis.HealthCheck), print_blob=True
)
hypothesis.settings.register_profile(
    "change", free, derandomize=True, max_examples=10, stateful_step_count=25
)
hypothesis.settings.register_profile("nightly", free, max_examples=200)
hypothesis.settings.register_profile("search", free, max_examples=1000)

PROBLEMS = os.environ.get("LAVENDER_PROBLEMS", "")


def pytest_addoption(parser):
    parser.addoption(
        "--nightly",
        action="store_true",
        help="also run the tests marked `nightly`, and 200 new examples",
    )


def pytest_configure(config):
    profile = "nightly" if config.getoption("nightly") else "change"
    hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", profile))


def pytest_collection_modifyitems(config, items):
    """Deselect the tests marked `nightly` without --nightly. The longest test begins first."""
    if not config.getoption("nightly"):
        config.hook.pytest_deselected(
            items=[item for item in items if item.get_closest_marker("nightly")]
        )
        items[:] = [item for item in items if not item.get_closest_marker("nightly")]
    items.sort(key=lambda item: "parity" not in item.path.parts)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """A test that asks for a backend which is not installed is skipped, with the package that it needs."""
    from lavender import SolverUnavailable

    try:
        return (yield)
    except SolverUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def problem_dir() -> Path:
    """Folder of the reference problems, named by LAVENDER_PROBLEMS."""
    if not PROBLEMS:
        pytest.skip("LAVENDER_PROBLEMS does not name a folder of reference problems")
    folder = Path(PROBLEMS)
    if not any(folder.glob("*.npz")) and not any(folder.glob("*.hdf5")):
        pytest.fail(f"LAVENDER_PROBLEMS={PROBLEMS} holds no .npz or .hdf5 file")
    return folder


@pytest.fixture
def boxes(tmp_path):
    """Writes the model `calls.BOXES` with these options of MuJoCo; its path."""
    from calls import BOXES

    def make(options=""):
        path = tmp_path / "boxes.xml"
        path.write_text(BOXES.format(options=options))
        return path

    return make


@pytest.fixture
def register():
    """As `lavender.register`, for one test, and in the place of a solver of the same name."""
    from lavender import registry

    before = registry.specs()
    yield partial(registry.register, replace=True)
    registry.registered.clear()  # In place, because the compiled front of `solve` holds this dict.
    registry.registered.update(before)


@pytest.fixture
def plug_in(register):
    """Registers a solver whose `run(problem, impulse)` is given; its name."""
    from lavender import SolverSpec

    def add(run, name="plug-in", **more):
        class PlugIn:
            def prepare(self, problem):
                return problem

            def update(self, state, problem):
                return problem

            def run(self, state, impulse, n, tol, time_limit=None):
                return run(state, impulse)

        laws = {"linear", "lcp", "coulomb", "cone"}
        register(
            SolverSpec(
                name, PlugIn, **{"laws": laws, "summary": "of a test", "resumable": False, **more}
            )
        )
        return name

    return add


@pytest.fixture
def clock():
    """The clock of time limits, which goes by what a test counts."""
    from calls import Clock

    from lavender_ext.core.deadline import play_clock

    made = Clock()
    play_clock(made)
    yield made
    play_clock(None)


def shipped(name):
    """A module of WebAssembly of these sources, as bytes; built once for each state of the sources."""
    from lavender.base.errors import LavenderError
    from lavender.sim.web import pages
    from lavender.sim.web.compile import explain_missing_requirement

    try:
        return pages.get_or_build_module(name=name)
    except LavenderError as error:
        if not explain_missing_requirement():  # what it is made with is there: it must be made
            raise
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def module():
    return shipped("lavender")


@pytest.fixture(scope="session")
def newton_module():
    return shipped("newton")
