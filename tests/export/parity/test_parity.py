"""The exported library, through its header alone, gives the bits of the extension: here and on AArch64."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
pytestmark = pytest.mark.slow


def missing_requirement():
    if shutil.which("gcc") is None:
        return "gcc is not installed"
    pytest.importorskip(
        "ziglang", reason="ziglang is not installed (extra: wasm): no compiler for AArch64"
    )
    return (
        ""
        if shutil.which("qemu-aarch64-static")
        else "no qemu-aarch64-static (Debian: qemu-user-static)"
    )


def test_x86_and_aarch64_have_the_bits_of_the_extension_and_contraction_is_seen():
    if missing_requirement():
        pytest.skip(missing_requirement())
    done = subprocess.run(
        [sys.executable, str(ROOT / ".ci" / "parity"), "--quick", "--steps", "20"],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line for line in done.stdout.splitlines() if line.startswith("| ")]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == ["x86_64", "aarch64", "aarch64"]
    assert [row.split(" | ")[-1].strip("| ") == "same" for row in rows] == [True, True, False]
    assert "differ, as it must, and lav_self_test says so" in rows[2]
