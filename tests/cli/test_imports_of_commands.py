"""Packages that commands load: their help loads click and NumPy only, and each command what its work needs."""

import json

import pytest
from worked import python

from lavender.cli import cli

LOADED = """
import contextlib, io, json, sys
import lavender.io
from lavender.cli import main
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            main(words)
        except SystemExit as end:
            assert end.code in (0, None), (words, end.code)
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules} - set(sys.stdlib_module_names))))
"""
BOX = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
<body pos="0 0 .09"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""

#: Packages that take 20 ms or more to load.
SLOW = {
    "scipy",
    "pandas",
    "matplotlib",
    "jinja2",
    "rich",
    "joblib",
    "mujoco",
    "h5py",
    "qpsolvers",
    "osqp",
    "clarabel",
    "distributed",
    "dask",
    "torch",
    "jax",
}
#: {command: packages of SLOW that it loads}. A page is drawn by pandas, jinja2 and matplotlib.
NEEDED = {
    "explain problem.npz": set(),
    "run stack --steps 2": set(),
    "solvers": {"rich"},
    "record box.xml --record-every 1 --steps 2 --out recorded": {"mujoco", "scipy"},
    "audit box.xml --worlds 2 --steps 3 --out audited": {
        "mujoco",
        "pandas",
        "jinja2",
        "matplotlib",
        "rich",
        "joblib",
        "scipy",  # The rows of the steps that are compared with the rigid laws.
    },
}


def loaded_by(commands, folder):
    return set(json.loads(python("-c", LOADED, json.dumps(commands), cwd=folder).stdout))


def test_help_of_every_command_loads_click_and_numpy_only(tmp_path):
    """Modules with an underscore belong to Python's site packages or to Cython's runtime."""
    words = [["--help"], *([name, "--help"] for name in cli.list_commands(None))]
    foreign = {
        name
        for name in loaded_by(words, tmp_path)
        if not name.startswith("_") and name != "cython_runtime"
    }
    assert foreign - {"cmeel_pth"} == {"click", "numpy", "lavender", "lavender_ext"}


@pytest.mark.parametrize("command", NEEDED)
def test_command_loads_the_packages_of_its_own_work_only(command, tmp_path):
    import lavender as lv

    if "box.xml" in command:
        pytest.importorskip("mujoco")
    lv.Problem.contact([[2.0, 0.5], [0.5, 1.0]], [1.0, -2.0], [0.5]).save(tmp_path / "problem.npz")
    (tmp_path / "box.xml").write_text(BOX, encoding="utf-8")
    assert loaded_by([command.split()], tmp_path) & SLOW == NEEDED[command]
