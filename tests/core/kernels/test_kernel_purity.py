"""The check of the kernels' purity sees every kind of breach, and passes a clean core."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
SPEC = importlib.util.spec_from_file_location("check_kernels", ROOT / ".ci" / "check_kernels.py")
check_kernels = importlib.util.module_from_spec(SPEC)
sys.modules[SPEC.name] = check_kernels
SPEC.loader.exec_module(check_kernels)

pytest.importorskip("Cython", reason="the check translates the kernels with Cython (extra: test)")
pytestmark = pytest.mark.skipif(bool(check_kernels.tools_missing()), reason=check_kernels.tools_missing())

CLEAN = """
from libc.math cimport fabs, floor, sqrt
from libc.stdint cimport int32_t
import numpy as np

cdef struct row_t:
    double d
    int32_t first

cdef inline double clip(double x, double low, double high) noexcept nogil:
    return low if x < low else (high if x > high else x)

cdef public double lav_norm(const row_t* rows, const double* x, int32_t n) noexcept nogil:
    cdef double s = 0.0
    cdef double scratch[4]
    cdef int32_t i
    for i in range(4):
        scratch[i] = 0.0
    for i in range(n):
        scratch[i % 4] += fabs(clip(x[rows[i].first], -1e3, 1e3)) / rows[i].d
        s += floor(scratch[i % 4])
    return sqrt(s)

def norm(x):
    if len(x) == 0:
        raise ValueError("empty")
    return float(np.sqrt(sum(v * v for v in x)))
"""

IMPURE = """
from cython.parallel cimport prange
from libc.math cimport sin
from libc.stdint cimport int32_t
from libc.stdlib cimport free, malloc

cdef double SCALE = 1e-9
cdef extern from *:
    '''
    static const double TABLE[8] = {1, 2, 4, 8, 16, 32, 64, 3};
    '''
    const double* TABLE

cdef public double lav_reads_variable(double x) noexcept nogil:
    return x + SCALE

cdef public double lav_reads_table(int32_t i) noexcept nogil:
    return TABLE[i]

cdef public double lav_calls_python(double x) noexcept nogil:
    with gil:
        print(x)
    return x

cdef public double lav_runs_threads(const double* x, int32_t n) noexcept nogil:
    cdef int32_t i
    cdef double s = 0.0
    for i in prange(n):
        s += x[i]
    return s

cdef public double lav_allocates(int32_t n) noexcept nogil:
    cdef double* x = <double*>malloc(8 * n)
    cdef double s = x[n - 1]
    free(x)
    return s

cdef public double lav_calls_libm(double x) noexcept nogil:
    return sin(x)
"""


IMPORTED = """
from .other cimport twice
cdef public double lav_doubles(double x) noexcept nogil:
    return twice(x)
"""

#: A body for each extension, and what names it; nobody may name the last, which every compiler reads as it is guarded.
DIALECT = {
    "double s[n]; s[0] = n; return s[0];": "forbids variable length array",
    "return ({ double s = n; s; });": "forbids braced-groups",
    "\n#ifdef LAVENDER_ONE_LANE\nreturn n ?: 1;\n#else\nreturn n;\n#endif\n": "middle term",
}
VECTORS = "typedef double two __attribute__((vector_size(16))); two s = {n, n}; return s[0];"


def inline(bodies):
    """A module of one function in C for each body."""
    text, uses = "cdef extern from *:\n    '''\n", ""
    for i, body in enumerate(bodies):
        text += f"    static inline double lavender_{i}(int n) {{ {body} }}\n"
        uses += f"    double lavender_{i}(int n) noexcept nogil\n"
    calls = " + ".join(f"lavender_{i}(<int>n)" for i in range(len(bodies)))
    return f"{text}    '''\n{uses}\ncdef public double lav_x(double n) noexcept nogil:\n    return {calls}\n"


def verdict(folder, name, text):
    path = folder / f"{name}.pyx"
    path.write_text(text)
    return check_kernels.check(path, folder)


def test_a_clean_core_passes_although_its_module_uses_python(tmp_path):
    found = verdict(tmp_path, "clean", inline([VECTORS]) + CLEAN)
    assert found.breaches == []
    assert found.functions == ["lav_x", "lav_norm"]
    assert found.code > 0 and not found.exempt


def test_every_kind_of_breach_is_named_where_no_name_exempts_it(tmp_path):
    (tmp_path / "__init__.py").touch()
    (tmp_path / "other.pxd").write_text("cdef double twice(double x) noexcept nogil\n")
    breaches = verdict(tmp_path, "impure", IMPORTED + inline(DIALECT) + IMPURE).breaches
    for sign in DIALECT.values():
        assert any("not strict C11" in breach and sign in breach for breach in breaches), sign
    found = "\n".join(breaches)
    for sign in (
        r"static data: \.bss\.\S*other_twice",
        r"static data: \.bss\.\S*impure_SCALE",
        r"constant table or string: \.rodata\.TABLE",
        r"needs PyGILState_Ensure \(in .*lav_calls_python",
        r"needs PyEval_RestoreThread \(in .*lav_runs_threads",
        r"needs malloc \(in lav_allocates\)",
        r"needs free \(in lav_allocates\)",
        r"needs sin \(in lav_calls_libm\)",
    ):
        assert re.search(sign, found), f"{sign} not in\n{found}"
    exempt = verdict(tmp_path, "threaded", IMPORTED)
    assert exempt.exempt
    assert exempt.breaches == []


def test_a_division_that_raises_is_a_breach(tmp_path, monkeypatch):
    checked = {**check_kernels.OPTIONS["directives"](), "cdivision": False}
    monkeypatch.setitem(check_kernels.OPTIONS, "directives", lambda: checked)
    text = "cdef public double lav_ratio(double x, double y) noexcept nogil:\n    return x / y\n"
    assert any("PyExc_ZeroDivisionError" in text for text in verdict(tmp_path, "division", text).breaches)


@pytest.mark.parametrize(
    ("text", "sign"),
    [
        ("cdef public double lav_x(double x) nogil: return x", "must be declared noexcept nogil"),
        ("cdef public double lav_x(long n) noexcept nogil: return n", "'long n' is not of a fixed-width"),
        ("cdef public double lav_x(double[::1] x) noexcept nogil: return x[0]", "'double[::1] x' is not"),
        ("cdef public Py_ssize_t lav_x(double x) noexcept nogil: return 1", "'Py_ssize_t lav_x' is not"),
        ("cdef public void lav_x(uint64_t seed) noexcept nogil: pass", "64-bit integer by value"),
        ("cdef public double x(double y) noexcept nogil: return y", "named lav_*"),
        ("# cython: boundscheck=False\ncdef public void lav_x() noexcept nogil: pass", "build_options.py"),
        ("from lavender.problem import Problem", "imports lavender"),
        ("def f(): return 1", "has no core function"),
    ],
)
def test_a_breach_in_the_text_is_named(tmp_path, text, sign):
    path = tmp_path / "text.pyx"
    path.write_text(text)
    _, breaches = check_kernels.read_source(path)
    assert any(sign in breach for breach in breaches)


def test_a_breach_fails_the_command_line(tmp_path, capsys):
    path = tmp_path / "python_only.pyx"
    path.write_text("def f():\n    return 1\n")
    assert check_kernels.main([str(path)]) == 1
    assert "BREACH" in capsys.readouterr().out
