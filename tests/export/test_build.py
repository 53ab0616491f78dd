"""What is written builds: as C11 and C++17 without a warning, and by CMake."""

import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import random_problems as rp
import vectors
from clib import functions, run
from test_same_bits import kinds_of, of_matrix
from tower import self_test_problem

import lavender as lv
from lavender import export as export
from lavender.base.errors import LavenderError

CHECK = Path(__file__).parent / "parity" / "check.c"
EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "c"
TOWER = EXAMPLES / "tower.c"
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Werror"]
# The first and the last that are promised; the library is compiled as C11 wherever it is run.
LANGUAGES = {
    "C99": ["-std=c99"],
    "C++11": ["-std=c++11", "-x", "c++"],
    "C++17": ["-std=c++17", "-x", "c++"],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "language", "small"),
    [
        ("gcc", "C99", []),
        ("gcc", "C++17", []),
        pytest.param("clang", "C++11", [], marks=pytest.mark.nightly),
        pytest.param("gcc", "C99", ["-DLAV_SWEEPS_ONLY"], marks=pytest.mark.nightly),
        pytest.param("clang", "C++11", ["-DLAV_SWEEPS_ONLY"], marks=pytest.mark.nightly),
    ],
)
def test_exported_library_compiles_without_warnings_in_c_and_cpp(
    folder, tmp_path, name, language, small
):
    command = [name]
    quick = ["-fsyntax-only"]
    if name == "clang" and shutil.which(name) is None:  # zig's compiler is clang's
        pytest.importorskip(
            "ziglang", reason="neither clang nor ziglang is installed (extra: wasm)"
        )
        command = [sys.executable, "-m", "ziglang", "cc", "-Wno-unused-command-line-argument"]
        quick = ["-O0", "-fno-sanitize=undefined", "-c", "-o", tmp_path / "l.o"]
    elif shutil.which(name) is None:
        pytest.skip(f"{name} is not installed")
    run(*command, *LANGUAGES[language], *WARNINGS, *small, *quick, folder / "lavender.c")


def test_exported_c_needs_only_sqrt_and_moves_of_memory(folder, shared):
    assert not re.search(r"Python\.h|PyObject|malloc|\bfree\(", (folder / "lavender.c").read_text())
    if shutil.which("nm") is None:
        pytest.skip("nm is not installed")
    wanted = {line.split()[-1].split("@")[0] for line in run("nm", "-D", "-u", shared).splitlines()}
    ours = {"sqrt", "floor", "ceil", "memcpy", "memset", "memmove"}
    assert {name for name in wanted if not name.startswith("_")} <= ours
    given = {line.split()[-1] for line in run("nm", "-D", "--defined-only", shared).splitlines()}
    assert {name for _, name, _ in functions(export.HEADER.read_text())} == {
        n for n in given if n.startswith("lav_")
    }


@pytest.mark.parametrize(
    "flag, sign",
    [
        ("-ffast-math", "ffast-math"),
        pytest.param(
            "-mfpmath=387",
            "-mfpmath=sse",
            marks=pytest.mark.skipif(platform.machine() != "x86_64", reason="registers of x86"),
        ),
    ],
)
def test_c_library_with_flags_that_change_numbers_does_not_compile(folder, compiler, flag, sign):
    done = subprocess.run(
        [compiler, flag, "-fsyntax-only", folder / "lavender.c"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode and sign in done.stderr


def test_exported_library_contains_the_licence_of_the_project(folder):
    licence = (Path(__file__).resolve().parents[2] / "LICENSE").read_text(encoding="utf-8")
    assert (folder / "LICENSE.txt").read_text(encoding="utf-8") == licence


def test_checksums_are_of_the_files(folder):
    import hashlib

    for line in (folder / "SHA256SUMS").read_text().splitlines():
        value, name = line.split("  ")
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == value


def test_export_accepts_a_path_as_text_and_refuses_others(tmp_path, folder):
    written = export.write(str(tmp_path / "c"))
    assert {p.name for p in written} >= {"lavender.c", "SHA256SUMS"}
    assert all(
        p.read_bytes() == (folder / p.relative_to(tmp_path / "c")).read_bytes() for p in written
    )
    with pytest.raises(lv.InputError, match="path is 3"):
        export.write(3)


def test_export_does_not_replace_other_files(tmp_path, folder):
    (tmp_path / "lavender.h").write_text("mine")
    with pytest.raises(LavenderError, match="--replace"):
        export.write(str(tmp_path))
    assert [p.name for p in tmp_path.iterdir()] == ["lavender.h"]


@pytest.mark.nightly
def test_cmake_builds_installs_and_is_found(folder, tmp_path):
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    flags = [
        "-DCMAKE_BUILD_TYPE=Debug",
        f"-DCMAKE_C_FLAGS={' '.join(WARNINGS)}",
        f"-DCMAKE_INSTALL_PREFIX={tmp_path / 'in'}",
    ]
    run("cmake", "-S", folder, "-B", tmp_path / "b", "-DBUILD_SHARED_LIBS=ON", *flags)
    run("cmake", "--build", tmp_path / "b")
    run("cmake", "--install", tmp_path / "b")
    user = tmp_path / "user"
    user.mkdir()
    (user / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.13)\nproject(user C)\nfind_package(lavender 1.0 REQUIRED)\n"
        f"add_executable(user {TOWER})\ntarget_link_libraries(user lavender::lavender)\n"
    )
    run("cmake", "-S", user, "-B", user / "b", f"-DCMAKE_PREFIX_PATH={tmp_path / 'in'}")
    run("cmake", "--build", user / "b")
    run(user / "b" / "user")
    assert "-llavender" in next((tmp_path / "in").rglob("lavender.pc")).read_text()


@pytest.mark.nightly
@pytest.mark.parametrize("name, what", [("gcc", "address,undefined"), ("clang", "memory")])
def test_c_library_passes_sanitizers(folder, tmp_path, name, what):
    flags = [
        "-std=c11",
        "-O0",
        "-g1",
        f"-fsanitize={what}",
        "-fno-sanitize-recover=all",
        "-I",
        folder,
    ]
    if (
        name == "gcc"
    ):  # a third of the time to compile: calls in place of code, a signal in place of words
        flags += [
            "-fno-sanitize=null,object-size,pointer-overflow",
            "-fsanitize-undefined-trap-on-error",
        ]
        flags += ["--param=asan-instrumentation-with-call-threshold=0"]
    (tmp_path / "empty.c").write_text("int main(void) { return 0; }\n")
    if (
        shutil.which(name) is None
        or subprocess.run(
            [name, *flags, tmp_path / "empty.c", "-o", tmp_path / "empty"],
            check=False,
            capture_output=True,
        ).returncode
    ):
        pytest.skip(f"no {name} with -fsanitize={what}")
    write_vectors(tmp_path)
    run(name, *flags, "-c", folder / "lavender.c", "-o", tmp_path / "lavender.o")
    for source in (TOWER, CHECK):
        run(name, *flags, source, tmp_path / "lavender.o", "-lm", "-o", tmp_path / source.stem)
        run(tmp_path / source.stem, cwd=tmp_path, env={"ASAN_OPTIONS": "detect_leaks=0"})


def write_vectors(out):
    given = [
        (self_test_problem(), "sequential_impulses", {}),
        (self_test_problem(), "anderson", {"memory": 3}),
        (rp.random_contact_problem(4), "block_gauss_seidel", {"order": "symmetric"}),
        (rp.random_contact_problem(5, "cone"), "nncg", {"restart": "against"}),
        (lv.Problem.lcp(np.array([[2.0, 1.0], [1.0, 2.0]]), [1.0, 0.5]), "direct", {}),
        (rp.random_contact_problem(6), "auto", {}),
        (rp.random_contact_problem(7), "admm", {}),
        *(
            (of_matrix(given), "nncg", {})
            for given in kinds_of("cone", mu=0.0)
            if given.rows is None
        ),
        (rp.random_lcp(3, m=8), "lemke", {}),
        (rp.random_lcp(3, m=8), "newton", {}),
    ]
    packed = [
        vectors.make_test_vector(problem, solver, 1e-6, 500, options)[0]
        for problem, solver, options in given
    ]
    (out / "vectors.bin").write_bytes(vectors.join_vectors(packed))
    return len(packed)


def test_test_vectors_are_met_and_a_changed_bit_is_seen(folder, shared, compiler, tmp_path):
    count = write_vectors(tmp_path)
    link = [CHECK, shared, f"-Wl,-rpath,{shared.parent}"]
    run(compiler, "-std=c11", *WARNINGS, "-I", folder, *link, "-o", tmp_path / "check")
    said = run(tmp_path / "check", cwd=tmp_path)
    assert (
        len(re.findall("^same ", said, re.MULTILINE)) == count - 2
    )  # `admm`, `auto` are held to the residual
    assert len(re.findall("^met ", said, re.MULTILINE)) == 2
    data = bytearray((tmp_path / "vectors.bin").read_bytes())
    data[-8] ^= 1  # the last bit of the last impulse
    (tmp_path / "vectors.bin").write_bytes(data)
    done = subprocess.run(
        [tmp_path / "check"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1 and "DIFFERS" in done.stdout


def test_examples_of_the_library_run(folder, shared, compiler, tmp_path, monkeypatch):
    link = [shared, f"-Wl,-rpath,{shared.parent}", "-lm", "-I", folder]
    flags = ("-std=c99", *WARNINGS, "-ffp-contract=off")
    run(compiler, *flags, EXAMPLES / "drop.c", *link, "-o", tmp_path / "drop")
    (tmp_path / "steps").mkdir()
    assert run(tmp_path / "drop", tmp_path / "steps").startswith("converged")
    found = [lv.load(path) for path in sorted((tmp_path / "steps").glob("*.npz"))]
    assert len(found) == 240 and lv.solve(found[-1], "newton").success
    monkeypatch.chdir(shared.parent)
    output = run(sys.executable, EXAMPLES / "lcp_ctypes.py")
    np.testing.assert_allclose(
        np.fromstring(output.strip("[] \n"), sep=" "), [0.5, 0.0], atol=1e-15
    )


@pytest.mark.skipif(
    shutil.which("mcs") is None or shutil.which("mono") is None, reason="needs Mono's mcs and mono"
)
def test_declarations_in_csharp_solve_an_lcp(shared, tmp_path, monkeypatch):
    run("mcs", "-unsafe", EXAMPLES / "Lcp.cs", f"-out:{tmp_path / 'lcp.exe'}")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(shared.parent))
    assert run("mono", tmp_path / "lcp.exe").split() == ["0.5", "0"]  # the LCP of README


@pytest.mark.slow
def test_example_box2d_with_its_solver_replaced_runs(folder, tmp_path):
    sources = os.environ.get("LAVENDER_BOX2D")
    if not sources or shutil.which("cmake") is None:
        pytest.skip(
            "needs cmake, and LAVENDER_BOX2D that names a folder with the sources of Box2D v3"
        )
    example = Path(__file__).resolve().parents[2] / "examples" / "box2d"
    run("cmake", "-S", example, "-B", tmp_path, f"-DBOX2D={sources}", f"-DLAVENDER={folder}")
    run("cmake", "--build", tmp_path)
    box2d, ours = run(tmp_path / "tower", "6", "60", "newton").splitlines()[-2:]
    # Medians of the residual: 1e-6 was asked for, and the impulses are kept in float32; one sweep leaves more.
    assert float(ours.split()[1]) < 1e-5 < float(box2d.split()[1])
