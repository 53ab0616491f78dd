"""The pytest plug-in that measures an engine on scenes of known motion, in a process of its own."""

import subprocess
import sys

import pytest

PLUGIN = "lavender.lab.phenomena.pytest_plugin"
ADAPTER = """
import numpy as np
from lavender import CapabilityError
from lavender.lab.phenomena.engines import Stepping, create_engine

def Good(scene):
    return create_engine("own", scene)

class Frozen(Stepping):
    dt = 1.0 / 60.0
    setting = "nothing moves"
    def __init__(self, scene):
        if scene.joints:
            raise CapabilityError("it has no joints")
        self.scene = scene
    def step(self):
        pass
    def get_state(self):
        return self.make_initial_state()
"""


def run_pytest(folder, *arguments):
    """Run pytest in a folder with the plug-in, installed or not; return its output and exit status."""
    (folder / "their_engine.py").write_text(ADAPTER)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:lavender-phenomena", "-p", PLUGIN, "-p", "no:cacheprovider", "-q",
         "-rs", *arguments],
        cwd=folder, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    return done.stdout + done.stderr, done.returncode


def test_an_engine_within_the_bounds_passes(tmp_path):
    output, code = run_pytest(tmp_path, "--phenomena", "their_engine:Good", "--phenomena-names", "stick")
    assert code == 0, output
    assert "passed" in output


def test_a_wrong_engine_fails_with_quantity_value_and_bound(tmp_path):
    output, code = run_pytest(
        tmp_path, "--phenomena", "their_engine:Frozen", "--phenomena-names", "slide,pendulum"
    )
    assert code == 1
    assert "exact motion:" in output and "passes:" in output and "at most" in output
    assert "Traceback" not in output
    assert "it has no joints" in output  # the pendulum is skipped with the engine's reason


def test_tests_of_the_engine_itself_run_too(tmp_path):
    (tmp_path / "test_own.py").write_text(
        "import their_engine\n\ndef test_own():\n    assert their_engine.Frozen.dt > 0.0\n"
    )
    output, code = run_pytest(
        tmp_path, "--phenomena", "their_engine:Good", "--phenomena-names", "stick", "-vv"
    )
    assert code == 0 and "test_own" in output and "stick[0]" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--phenomena", "their_engine"], "MODULE:ADAPTER is needed"),
        (["--phenomena", "no_engine:X"], "No module named 'no_engine'"),
        (["--phenomena", "their_engine:Missing"], "Missing"),
        (["--phenomena", "their_engine:ADAPTER_TEXT"], "ADAPTER_TEXT"),
        (["--phenomena", "their_engine:Good", "--phenomena-names", "stik"], "stick"),
    ],
)
def test_wrong_options_are_usage_errors(tmp_path, arguments, message):
    output, code = run_pytest(tmp_path, *arguments)
    assert code == 4 and message in output


def test_nothing_is_added_without_the_option(tmp_path):
    output, code = run_pytest(tmp_path)
    assert code == 5 and "no tests ran" in output
