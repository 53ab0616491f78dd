"""What is installed is whole, light to import, and as README and changelog say."""

import ast
import importlib.metadata
import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from worked import syntax_of_package

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

import lavender

ROOT = Path(__file__).resolve().parent.parent.parent


def test_version_equals_the_installed_one_and_has_changes():
    assert lavender.__version__ == importlib.metadata.version("lavender-contact")
    assert f"## [{lavender.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_citation_file_names_this_version_and_licence():
    said = dict(
        re.findall(r"^([\w-]+): (.+)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE)
    )
    assert said["version"] == lavender.__version__
    assert (
        said["license"]
        == tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["license"]
    )
    assert {"cff-version", "message", "title"} <= set(said)


def test_workflows_name_files_that_exist():
    said = "".join(
        path.read_text("utf-8") for path in (ROOT / ".github" / "workflows").glob("*.yml")
    )
    named = set(re.findall(r"\.ci/[\w.]+|tests/[\w/.]+", said))
    assert ".ci/run" in named
    assert [name for name in named if not (ROOT / name).exists()] == []


def declared(table):
    """Names of the distributions in a list of requirements of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    block = re.search(rf"^{table} = \[(.*?)\]$", text, re.MULTILINE | re.DOTALL)[1]
    return {name.lower() for name in re.findall(r'"([A-Za-z0-9_-]+)[>"]', block)}


def test_imports_of_the_package_are_declared():
    # Anything that lavender imports at all stands in pyproject.toml under its own name.
    known = declared("dependencies") | declared("report") | declared("fclib") | declared("qp")
    known |= (
        declared("cluster")
        | declared("peers")
        | declared("mujoco")
        | declared("torch")
        | declared("jax")
    )
    # If installed:
    known |= declared("newton") | {
        "lavendersim",
        "mujoco_warp",
        "pinocchio",
        "pydrake",
        "qoco",
        "siconos",
        "warp",
    }
    known |= {"genesis"}  # genesis-world, of the extra `genesis`
    known |= {"cupy"}  # imported only for a caller who gives arrays of it
    known |= {"PIL", "markupsafe"}  # which matplotlib and jinja2 require
    known |= {"typing_extensions"}  # for type checkers alone, which bring its stub
    known |= set(sys.stdlib_module_names) | {"lavender", "lavender_ext"}
    found = set()
    for tree in syntax_of_package().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add(node.module.split(".")[0])
    assert found - known == set()


@pytest.mark.parametrize("name", ["report", "test"])
def test_readme_command_starts_from_a_fresh_clone(name):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (line,) = re.findall(rf"^<!-- command: {name} -->\n```sh\n(.+)\n```$", text, re.MULTILINE)
    assert line.startswith("python3 -m venv .venv && .venv/bin/pip install ")


def test_debug_build_differs_in_two_checks():
    from lavender_ext.build_options import COMPILE_FLAGS, directives

    differ = {name for name, value in directives(debug=True).items() if value != directives()[name]}
    assert differ == {"boundscheck", "initializedcheck"}
    assert "-ffp-contract=off" in COMPILE_FLAGS
    assert not any("march" in flag for flag in COMPILE_FLAGS)


@pytest.mark.skipif(sys.platform == "win32" or not shutil.which("cc"), reason="needs a C compiler")
@pytest.mark.parametrize("fast", ["-ffast-math", "-Ofast", "-funsafe-math-optimizations"])
def test_cflags_with_fast_math_keep_rounding(fast, tmp_path):
    """They stand before our own flags, where a module is compiled and where it is linked."""
    from lavender_ext.build_options import COMPILE_FLAGS, LINK_FLAGS

    (tmp_path / "x.c").write_text("#ifdef __FAST_MATH__\n#error fast\n#endif\n")
    for step in (
        ["-c", "x.c", "-O3", *COMPILE_FLAGS],
        ["-###", "-shared", "x.o", "-o", "x.so", *LINK_FLAGS],
    ):
        done = subprocess.run(
            ["cc", fast, *step], cwd=tmp_path, capture_output=True, text=True, check=True
        )
    assert "-o x.so" in done.stderr.replace('"', "")
    assert "crtfastmath" not in done.stderr


def test_build_wasm_ships_both_modules(tmp_path, module, newton_module):
    pytest.importorskip("Cython", reason="the build translates the kernels (extra: test)")
    # As `pip wheel --no-build-isolation` runs it: built, or taken from the checkout where it is of these sources.
    shipped = tmp_path / "lavender" / "sim" / "web"
    command = [sys.executable, "setup.py", "-q", "build_wasm", "--build-lib", str(tmp_path)]
    subprocess.run(command, check=True, cwd=ROOT)
    assert (shipped / "lavender.wasm").read_bytes() == module
    assert (shipped / "newton.wasm").read_bytes() == newton_module
