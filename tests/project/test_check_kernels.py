"""The check of the kernels names what it is there to see. What does not stand alone: tests/sim/web/test_wasm.py."""

import importlib.util

import pytest
from worked import ROOT

from lavender.sim.web import extract_c as cut

SPEC = importlib.util.spec_from_file_location("check_kernels", ROOT / ".ci" / "check_kernels.py")
check_kernels = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(check_kernels)

#: Bodies, and what names each; nobody may name the last, which every compiler reads as it is guarded.
DIALECT = {
    "double s[n]; s[0] = n; return s[0];": "forbids variable length array",
    "return ({ double s = n; s; });": "forbids braced-groups",
    "\n#ifdef LAVENDER_ONE_LANE\nreturn n ?: 1;\n#else\nreturn n;\n#endif\n": "middle term",
    "typedef double two __attribute__((vector_size(16))); two s = {n, n}; return s[0];": "",
}


def test_read_dialect_of_nonstandard_c_names_each_breach(tmp_path):
    pytest.importorskip("Cython", reason="the check translates the kernels with Cython (extra: test)")
    path = tmp_path / "text.pyx"
    made = "".join(f"    static inline double of_{i}(int n) {{ {body} }}\n" for i, body in enumerate(DIALECT))
    said = "".join(f"    double of_{i}(int n) noexcept nogil\n" for i in range(len(DIALECT)))
    used = " + ".join(f"of_{i}(<int>n)" for i in range(len(DIALECT)))
    path.write_text(
        f"cdef extern from *:\n    '''\n{made}    '''\n{said}\n"
        f"cdef public double lav_x(double n) noexcept nogil:\n    return {used}\n"
    )
    [(_, text)] = cut.translate_modules_to_c(ROOT, [path], tmp_path)
    c_file = tmp_path / "text.c"
    c_file.write_text(text)
    found = check_kernels.read_dialect(c_file)
    assert all(line.startswith("not strict C11") for line in found)
    signs = [sign for sign in DIALECT.values() if sign]
    assert [sum(sign in line for line in found) for sign in signs] == [1] * len(signs)
    assert len(found) == len(signs), found


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
    ],
)
def test_read_source_of_a_wrong_declaration_names_it(tmp_path, text, sign):
    path = tmp_path / "text.pyx"
    path.write_text(text)
    assert any(sign in breach for breach in check_kernels.read_source(path))
