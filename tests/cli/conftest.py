"""What tests of commands share: a problem's file, and the command in a folder of its own."""

import pytest
from stacks import stack

from lavender import cli, io


@pytest.fixture
def path(tmp_path):
    io.save(stack(8), tmp_path / "stack8.npz")
    return tmp_path / "stack8.npz"


@pytest.fixture
def lavender(capsys, tmp_path, monkeypatch):
    """Runs the command in a folder of its own: (status, stdout, stderr)."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("COLUMNS", "160")

    def run(*words):
        with pytest.raises(SystemExit) as end:
            cli.main([str(w) for w in words])
        out, err = capsys.readouterr()
        return end.value.code, out, err

    return run
