"""What is installed is whole, light to import, and as README and changelog say."""

import ast
import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from worked import python, syntax_of_package

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

import lavender
import lavender_ext

ROOT = Path(__file__).resolve().parent.parent.parent


def test_version_equals_the_installed_one_and_has_changes():
    assert lavender.__version__ == importlib.metadata.version("lavender-contact")
    assert f"## [{lavender.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_import_without_built_kernels_names_the_command(tmp_path):
    # A fresh clone hides an installed lavender from whoever starts Python in it. Without site-packages (-S), since
    # an editable installation finds its kernels even so.
    # Other tests may be writing modules and byte code meanwhile.
    rest = shutil.ignore_patterns("*.so", "*.pyd", "*.wasm", "*.part", "__pycache__")
    for folder in (Path(lavender_ext.__file__).parent, Path(lavender.__file__).parent):
        shutil.copytree(folder, tmp_path / folder.name, ignore=rest)
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = python("-S", "-c", "import lavender", status=1, cwd=tmp_path, env=env)
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: the kernels in ")
    assert "pip install -e ." in last


def test_texts_with_pip_install_name_this_distribution():
    # `lavender` on PyPI is another project; ours is installed as lavender-contact.
    offers = re.compile(r"pip install[^\n`&|;]*?[ '\"]lavender(?![\w-])|\blavender\[\w")
    texts = [
        path
        for folder in ("lavender", "lavender_ext", "docs", "examples", "tests", "benchmarks", ".ci")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in {".py", ".md", ".html", ".jinja", ".j2", ".toml", ".js", ".mjs", ".pyx", ".pxd"}
        and path != Path(__file__).resolve()
        and "generated" not in path.parts
    ]
    texts += [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "pyproject.toml", ROOT / ".ci" / "run"]
    assert len(texts) > 100
    found = [f"{path.relative_to(ROOT)}: {m[0]}" for path in texts for m in offers.finditer(path.read_text("utf-8"))]
    assert found == []
    assert offers.search("pip install lavender")
    assert offers.search("pip install 'lavender[wasm]'")
    assert not offers.search("pip install 'lavender-contact[wasm]'")


def test_metadata_links_with_and_without_an_address_are_absolute_or_absent(tmp_path):
    pytest.importorskip("Cython", reason="setup.py imports it (extra: test)")

    def metadata(**env):
        python("setup.py", "-q", "egg_info", "--egg-base", tmp_path, env={**os.environ, **env})
        (info,) = tmp_path.glob("*/PKG-INFO")
        head, _, description = info.read_text(encoding="utf-8").partition("\n\n")
        return dict(re.findall(r"^Project-URL: (\w+), (.+)$", head, re.MULTILINE)), description

    urls, description = metadata(LAVENDER_FILES_URL="")
    assert urls == {}
    assert description.strip() == (ROOT / "README.md").read_text(encoding="utf-8").strip()
    urls, description = metadata(LAVENDER_FILES_URL="https://example.org/v1/")
    assert urls.pop("Source") == "https://example.org/v1"
    assert urls
    for url in urls.values():
        assert (ROOT / url.removeprefix("https://example.org/v1/")).is_file()
    links = re.findall(r"\]\(([^)]+)\)", description)
    assert "https://example.org/v1/docs/static/web.gif" in links
    assert len(links) >= 6 and all(link.startswith("https://") for link in links)


def test_citation_file_names_this_version_and_licence():
    said = dict(re.findall(r"^([\w-]+): (.+)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE))
    assert said["version"] == lavender.__version__
    assert said["license"] == tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["license"]
    assert {"cff-version", "message", "title"} <= set(said)


def test_workflows_name_files_that_exist():
    said = "".join(path.read_text("utf-8") for path in (ROOT / ".github" / "workflows").glob("*.yml"))
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
    known = declared("dependencies") | declared("fclib") | declared("qp")
    known |= declared("cluster") | declared("peers") | declared("mujoco") | declared("torch") | declared("jax")
    # If installed:
    known |= declared("newton") | {"lavendersim", "mujoco_warp", "pinocchio", "pydrake", "qoco", "siconos", "warp"}
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
    for step in (["-c", "x.c", "-O3", *COMPILE_FLAGS], ["-###", "-shared", "x.o", "-o", "x.so", *LINK_FLAGS]):
        done = subprocess.run(["cc", fast, *step], cwd=tmp_path, capture_output=True, text=True, check=True)
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
