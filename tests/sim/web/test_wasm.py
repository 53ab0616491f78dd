"""The kernels in WebAssembly give the bits of the native ones, under Node."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import lavender as lv
from lavender.sim.scene import SCENES
from lavender.sim.web import compile as wasm
from lavender.sim.web import pages
from lavender.sim.web.scenes import PRESETS_PATH, collect_page_data, describe_snapshot

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
CHECK = HERE / "check_wasm_exports.mjs"
# Left out where the kernels run with every check on: the module is compiled without them either way.
pytestmark = pytest.mark.slow

needs_compiler = pytest.mark.skipif(
    bool(wasm.explain_missing_requirement()), reason=wasm.explain_missing_requirement()
)


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """Folder of what the native kernels did."""
    folder = tmp_path_factory.mktemp("recording")
    subprocess.run([sys.executable, str(HERE / "record.py"), str(folder)], check=True, cwd=ROOT)
    return folder


HEAD = "from libc.stdint cimport int32_t\n"
GOOD = (
    HEAD
    + "cdef public int32_t lav_good(int32_t x) noexcept nogil:\n    return 2 * x + <int32_t>sizeof(void*)\n"
)


@needs_compiler
def test_wasm_build_of_the_same_sources_has_the_same_bytes(tmp_path):
    path = tmp_path / "good.pyx"
    path.write_text(GOOD)
    for name in ("one.wasm", "two.wasm"):
        built = wasm.build(tmp_path / name, ROOT, [path])
        assert built.functions == ("lav_good",)
        assert built.size < 1000
    assert (tmp_path / "one.wasm").read_bytes() == (tmp_path / "two.wasm").read_bytes()
    with pytest.raises(wasm.BuildFailed, match="below 10 bytes are allowed"):
        wasm.build(tmp_path / "good.wasm", ROOT, [path], max_bytes=10)


@pytest.mark.parametrize("name", list(wasm.PARTS))
def test_wasm_module_has_the_documented_size_and_can_grow(name, request):
    size = len(request.getfixturevalue({"lavender": "module", "newton": "newton_module"}[name]))
    page = (ROOT / "docs" / "engine.md").read_text(encoding="utf-8")
    (told,) = re.findall(rf"`{name}\.wasm` \((\d+) kB\)", page)
    assert size == pytest.approx(1000 * int(told), rel=0.03)  # compilers differ by a percent or two
    assert size < 0.95 * wasm.MAX_MODULE_BYTES


def node(*arguments):
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    return subprocess.run(
        ["node", *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="session")
def module_file(module, newton_module, tmp_path_factory):
    path = tmp_path_factory.mktemp("wasm") / "lavender.wasm"
    path.write_bytes(module)
    (path.parent / "newton.wasm").write_bytes(newton_module)
    return path


def test_wasm_module_has_the_bits_of_the_native_engine(module_file, recording):
    done = node(CHECK, module_file, recording)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "all the same: 16 scenes, 4800 steps, 640 solves by newton" in done.stdout


def test_page_scenes_are_the_start_of_native_ones():
    contents = json.loads(json.dumps(collect_page_data()))
    gallery = [
        name for name, build in SCENES.items() if build.__module__ == "lavender.sim.scene.gallery"
    ]
    assert sorted(scene["name"] for scene in contents["scenes"]) == sorted(gallery)
    for scene in contents["scenes"]:
        start = lv.Simulation(scene["name"]).snapshot()
        assert scene == scene | describe_snapshot(start)
        assert len(scene["bodies"]) == scene["size"][0]


@needs_compiler
def test_presets_of_the_page_have_the_results_of_the_documentation(tmp_path):
    """Run each preset with the page's modules; compare with the pages of the course."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    pages.write_page(tmp_path)
    output = subprocess.run(
        [node, HERE / "preset_results.mjs", tmp_path], check=True, capture_output=True, text=True
    )
    results = json.loads(output.stdout)
    page = (ROOT / "docs" / "course" / "lavendersim.md").read_text(encoding="utf-8")
    presets = json.loads(PRESETS_PATH.read_text(encoding="utf-8"))["presets"]
    for preset in presets:
        if captions := results[preset["name"]]["captions"]:
            (row,) = re.findall(
                rf"^\| {re.escape(preset['title'])}[^|]*\| (.*) \|$", page, re.MULTILINE
            )
            a, b = row.split("; ")
            assert captions[0] in a and captions[1] in b, (preset["name"], captions)
    chapter = (ROOT / "docs" / "course" / "answers.md").read_text(encoding="utf-8")
    cells = [
        [cell.strip(" *") for cell in line.split("|")]
        for line in chapter.splitlines()
        if line.startswith("|")
    ]
    alternating = {(row[3]): row[7] for row in cells if len(row) == 9}
    few_many = {n["last"]: n["a"] / n["b"] for n in results["experiment=4"]["numbers"]}
    assert alternating["first solve"] == f"{few_many[0]:.1f}"
    assert (
        alternating["steps 21–60"] == f"{few_many[60]:.0f}"
        and alternating["steps 181–240"] == f"{few_many[240]:.0f}"
    )
    cold_warm = results["experiment=5"]["numbers"][0]
    assert alternating["steps 21–90"] == f"{cold_warm['b'] / cold_warm['a']:.0f}"
