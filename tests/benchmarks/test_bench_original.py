"""`python -m benchmarks original`: the figure, and the refusals; the engine itself is not installed for tests."""

import tarfile

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks import original
from lavender.base.errors import InputError


def test_the_figure_shows_every_run_of_both_engines(tmp_path):
    runs = {(n, turn): np.full((240, 3), 1e-3) for n in (4, 64) for turn in (False, True)}
    original.draw(runs, tmp_path / "tails.svg")
    text = (tmp_path / "tails.svg").read_text(encoding="utf-8")
    assert text.count('<g id="axes_') == 2
    # four curves in either engine; matplotlib numbers all lines of a figure
    assert text.count('clip-path="url(#') >= 2 * len(runs)


def test_a_source_of_another_version_and_a_missing_compiler_are_refused(tmp_path, monkeypatch):
    source = tmp_path / "lavendersim-0.3.0" / "engine" / "physics.cpp"
    source.parent.mkdir(parents=True)
    source.write_text("int main() {}", encoding="utf-8")
    archive = tmp_path / "lavendersim-0.3.0.tar.gz"
    with tarfile.open(archive, "w:gz") as held:
        held.add(tmp_path / "lavendersim-0.3.0", "lavendersim-0.3.0")
    monkeypatch.setattr(original.shutil, "which", lambda name: "/usr/bin/c++")
    with pytest.raises(InputError, match=r"not physics.cpp of lavendersim 0.2.0"):
        CliRunner().invoke(original.command, [str(archive)], catch_exceptions=False)
    monkeypatch.setattr(original.shutil, "which", lambda name: None)
    with pytest.raises(InputError, match=r"C\+\+ compiler is needed"):
        CliRunner().invoke(original.command, [str(archive)], catch_exceptions=False)
