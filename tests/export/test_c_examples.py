"""The planar example in C and the C++ header, against closed forms; the problems and answers that they write."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from clib import run

import lavender as lv
from lavender.io.npz import read_npz

EXAMPLES = Path(__file__).parents[2] / "examples" / "c"
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Werror"]

WRAPPED = """
#include "lavender.hpp"
#include <array>
#include <cstdio>
int main() {
  std::array<double, 4> a{2, 1, 1, 2};
  std::array<double, 2> b{1, -1}, lower{0, 0}, upper{1, 1}, x{}, slack{}, error{};
  lavender::problem q(LAV_MATRIX);
  q.n_blocks = q.n_rows = 2, q.n_entries = 4;
  lavender::set(q.value, std::span<const double>(a));
  lavender::set(q.b, std::span<const double>(b));
  lavender::set(q.lower, std::span<const double>(lower));
  lavender::solver first(LAV_DIRECT);
  first.set(q);
  first.run();
  lavender::solver solver = std::move(first);
  solver.impulse(x);
  const lav_verdict verdict = solver.judge(x, slack, error);
  std::printf("%g %g %g %g %g\\n", x[0], x[1], slack[0], slack[1], verdict.relative);
  try { first.run(); } catch (const lavender::error &e) { std::printf("%d\\n", e.code()); }
  lower[1] = 5;
  lavender::set(q.upper, std::span<const double>(upper));
  try { solver.set(q); } catch (const lavender::error &e) { std::puts(e.what()); }
}
"""


@pytest.fixture(scope="module")
def compiled(folder, compiler, tmp_path_factory):
    out = tmp_path_factory.mktemp("objects") / "lavender.o"
    run(compiler, "-std=c99", "-O0", "-ffp-contract=off", "-c", folder / "lavender.c", "-o", out)
    return out


@pytest.fixture(scope="module")
def planar(folder, compiler, compiled, tmp_path_factory):
    """Compile and run the planar engine; return its output and the folder of its steps."""
    out = tmp_path_factory.mktemp("planar")
    flags = ["-std=c99", *WARNINGS, "-O0", "-ffp-contract=off", "-I", folder]
    run(compiler, *flags, EXAMPLES / "planar.c", compiled, "-lm", "-o", out / "planar")
    (out / "steps").mkdir()
    return run(out / "planar", out / "steps"), out / "steps"


def test_planar_engine_disks_on_a_slope_roll_by_the_closed_form(planar):
    speed, spin = (float(planar[0].split(name)[1].split()[0]) for name in ("speed", "spin"))
    assert speed == pytest.approx(
        2 / 3 * 9.81 * math.sin(0.3) * 1.0, rel=1e-9
    )  # a = 2/3 g sin(slope), 1 s
    assert spin == pytest.approx(-speed / 0.5, rel=1e-9)


def test_c_example_dumped_answer_is_judged_as_its_impulse(planar):
    lines = [json.loads(line) for line in (planar[1] / "engine.jsonl").read_text().splitlines()]
    assert len(lines) == 60 and lines[7] == {
        "file": "step_007.npz",
        "rows": 6,
        "seconds": 0,
        "solver": "own PGS",
    }
    stored = read_npz(planar[1] / "step_007.npz")
    assert lv.residual(stored.problem, stored.impulse).relative < 1e-12  # 200 sweeps of six rows
    assert np.abs(stored.impulse).max() > 0.1


def test_cpp_header_moves_judges_and_throws_the_named_array(folder, compiler, compiled, tmp_path):
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    (tmp_path / "wrapped.cpp").write_text(WRAPPED)
    run(
        "g++",
        "-std=c++20",
        *WARNINGS,
        "-I",
        folder,
        tmp_path / "wrapped.cpp",
        compiled,
        "-o",
        tmp_path / "wrapped",
    )
    lines = run(tmp_path / "wrapped").splitlines()
    assert lines[:2] == ["0.5 0 0 1.5 0", "-14"]
    assert lines[2].startswith("lower[1]: lower > upper")
