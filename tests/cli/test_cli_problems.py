"""`lavender problems`."""

from dataclasses import replace

import pytest

import lavender as lv
from lavender.lab import collection


def test_a_set_is_listed_written_and_checked(lavender, tmp_path, monkeypatch):
    code, out, _ = lavender("problems", "@walking")
    assert code == 0 and out.count("@walking walking(seed=") == out.count("enclosed within") == 12
    code, out, _ = lavender("problems", "@walking", "--out", tmp_path / "set")
    files = sorted((tmp_path / "set").glob("*.npz"))
    assert code == 0 and len(files) == 12 and "12 problems" in out
    names = {lv.load(path).name for path in files}
    assert names == {e.name for e in collection.load_manifest() if e.group == "walking"}
    assert lavender("problems", "@walking", "--check")[:2] == (0, "12 of 12 problems are the same\n")

    first, *rest = (e for e in collection.load_manifest() if e.group == "walking")
    collection.save_manifest([replace(first, sha="0" * 16), *rest], tmp_path / "other.json")
    changed = collection.load_manifest(tmp_path / "other.json")
    monkeypatch.setattr(collection, "load_manifest", lambda: changed)
    code, out, _ = lavender("problems", "--check")
    assert code == 1 and out.startswith(first.name) and "11 of 12" in out


def test_options_that_have_no_effect_are_refused(lavender, tmp_path):
    assert lavender("problems", "@nobody")[0] == 2
    lv.Problem.lcp([[1.0]], [1.0]).save(tmp_path / "a.npz")
    code, _, err = lavender("problems", tmp_path / "a.npz")
    assert code == 2 and "only --certify accepts" in err
    for words, sign in (
        (("@walking", "--check", "--out", tmp_path / "b"), "--out has no effect with --check"),
        (("--certify", tmp_path / "m.json", "--check"), "--check has no effect with --certify"),
        (("--page", tmp_path / "none" / "page.md"), "create it first"),
    ):
        code, _, err = lavender("problems", *words)
        assert code == 2 and sign in err


def test_a_manifest_is_made_with_proofs(lavender, tmp_path, monkeypatch):
    pytest.importorskip("flint")
    monkeypatch.setattr(collection.suite, "SETS", {"walking": ("walking(n=4)", "walking(n=5)")})
    code, out, _ = lavender("problems", "@walking", "--certify", tmp_path / "m.json")
    assert code == 0 and out.count(": enclosed") == 2
    assert [e.rows for e in collection.load_manifest(tmp_path / "m.json")] == [8, 10]
