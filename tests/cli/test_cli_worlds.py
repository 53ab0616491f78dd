"""`lavender audit` and `lavender tune`."""

import json

import pytest
from calls import EARLY_BOXES as EARLY

from lavender.lab import tune as tuning

pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'")


def test_an_audit_accepts_or_does_not(lavender, boxes, tmp_path):
    words = ("--worlds", 2, "--steps", 20, "--workers", 1, "--out", tmp_path / "out", "--accept", "1e-3")
    code, out, _ = lavender("audit", boxes(EARLY), *words)
    assert code == 1 and "ended early" in out
    assert len(out.splitlines()) <= 25
    page = (tmp_path / "out" / "index.html").read_text()
    assert "worst_1.npz" in page and "<svg" in page
    told = json.loads((tmp_path / "out" / "numbers.json").read_text())
    assert told["early"] > 0 and told["largest"] > 1e-3
    code, out, _ = lavender("audit", boxes(), *words)
    assert code == 0 and "none of 40 steps of 2 worlds ended early" in out
    assert not list((tmp_path / "out" / "worst").glob("*.npz"))  # those of another run are gone


def test_tuning_prints_a_page_and_few_lines(lavender, boxes, tmp_path, monkeypatch):
    monkeypatch.setattr(tuning, "TOLERANCES", (1e-6, 1e-12))
    monkeypatch.setattr(tuning, "ITERATIONS", {"Newton": (2,), "CG": (3, 25)})
    code, out, _ = lavender(
        "tune", boxes(EARLY), "--worlds", 2, "--steps", 20, "--rounds", 1, "--out", tmp_path / "out"
    )
    assert code == 0 and "held back" in out
    assert len(out.splitlines()) <= 25
    page = (tmp_path / "out" / "index.html").read_text()
    assert "&lt;option" in page and "<svg" in page
    assert (tmp_path / "out" / "figures" / "time-and-error.png").is_file()
