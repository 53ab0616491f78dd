"""The problem set: made again by its names with the same numbers, and what its manifest says is so."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lavender as lv
from lavender import bench, suite
from lavender.lab import collection
from lavender.lab.bench.cases import resolve_sources

ENTRIES = collection.load_manifest()


def test_the_manifest_has_every_problem_of_every_set_in_order():
    names = [n for chosen in suite.SETS.values() for n in chosen]
    assert [e.name for e in ENTRIES] == [
        n if suite.get_package_name_of_case(n) else suite.case(n).name for n in names
    ]
    assert all(e.licence and e.made for e in ENTRIES if suite.get_package_name_of_case(e.name))


@pytest.mark.parametrize("start", range(5))
def test_problems_are_made_again_with_the_same_numbers(start):
    chosen, _ = collection.select_buildable(e for e in ENTRIES[start::15] if e.rows < 2000)
    chosen = [
        e for e in chosen if e.made == suite.get_package_versions(suite.get_package_name_of_case(e.name))
    ]
    assert list(collection.find_changed_problems(chosen)) == []
    wrong = replace(chosen[0], sha="0" * 16)
    (line,) = collection.find_changed_problems([wrong])
    assert wrong.name in line and wrong.sha in line


AVX512 = "X86_V4 AVX512_ICL AVX512_SPR AVX512F AVX512CD AVX512_SKX"  # as NumPy has named them
OTHERS = {
    "Nehalem": {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": f"{AVX512} X86_V3 AVX2 FMA3"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
}


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_no_problem_hangs_on_the_processor(other):
    """NumPy warns of what it does not know; OpenBLAS ends in an illegal instruction."""
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    if "SkylakeX" in other.values() and not set(found) & set(AVX512.split()):
        pytest.skip("this processor has no AVX-512")
    changed = "c.find_changed_problems(e for e in c.load_manifest() if not e.made)"
    code = f"from lavender.lab import collection as c; print(*{changed}, sep='\\n', end='')"
    assert subprocess.check_output([sys.executable, "-c", code], env=os.environ | other, text=True) == ""


@pytest.mark.parametrize(
    "entry", [e for e in ENTRIES if e.rows <= 40 and not e.made][::6], ids=lambda e: e.name
)
def test_what_the_manifest_says_of_a_problem_is_found_again(entry):
    pytest.importorskip("flint")
    (case,) = suite.cases(entry.name)
    found = collection.certify_problem(case.problem, entry.name, entry.group)
    assert (found.known, found.unique, found.sweeps) == (entry.known, entry.unique, entry.sweeps)
    # An answer ends where the floor of another BLAS lets it.
    assert found.radius is None or found.radius <= max(100.0 * entry.radius, 1e-9)


def test_the_page_is_that_of_the_manifest():
    text = (Path(__file__).resolve().parents[2] / "docs" / "catalogue.md").read_text(encoding="utf-8")
    assert text == collection.format_catalogue(ENTRIES, collection.load_manifest(collection.RECORDED))


def test_a_manifest_comes_back_as_it_was_written(tmp_path):
    collection.save_manifest(ENTRIES, tmp_path / "m.json")
    assert collection.load_manifest(tmp_path / "m.json") == ENTRIES
    for text in ("{", "[1]", '[{"name": "x"}]'):
        (tmp_path / "m.json").write_text(text)
        with pytest.raises(lv.InputError, match="not a manifest"):
            collection.load_manifest(tmp_path / "m.json")


def test_a_set_is_named_by_its_sign_wherever_cases_are():
    assert [item.name for item in resolve_sources("@walking")] == [
        e.name for e in ENTRIES if e.group == "walking"
    ]
    with pytest.raises(lv.UnknownName, match=r"unknown set .*did you mean .walking"):
        resolve_sources("@walkin")


def test_robots_whose_package_is_absent_are_left_out_with_what_to_install(monkeypatch):
    monkeypatch.setattr("lavender.lab.suite.steps.find_spec", lambda name: None)
    names = [n for n in suite.SETS["robots"] if "dm_control" in n][:2]
    records = bench.run(
        ["two_particles", *names], ["pgs"], bench.Plan(tolerances=(1e-3,), budgets=(), orders=())
    )
    assert [s.case for s in records.skips] == names and len(records) == 1
    assert all("lavender-contact[robots]" in s.reason for s in records.skips)
    here, missing = collection.select_buildable(ENTRIES)
    assert len(missing) == 2 and not [e for e in here if e.made]


def test_walking_is_the_quadratic_program_that_it_says():
    """A foot so wide that nothing binds is the program without rows; in the usual ones pressures are at the rim."""
    wide = suite.walking(foot=1e3).problem
    q = wide.qp.q
    np.testing.assert_allclose(wide.generalized.mass @ lv.solve_qp(wide).x, -q, atol=1e-9 * np.abs(q).max())
    for seed in range(4):
        found = lv.solve_qp(suite.walking(seed=seed).problem, tol=1e-10)
        assert found.solution.success
        assert 0 < np.count_nonzero(found.z > 1e-9) < 16
