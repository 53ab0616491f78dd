"""Commands on the folders that `Recorder` and `lavender audit` write."""

import numpy as np
import pytest

import lavender as lv


def make_step():
    """Return two worlds of blocks of 1 kg that fall on the ground at 1 m/s, and the exact impulses [N s]."""
    cones = lv.Cones.contacts(0.5, tangents=1)
    eye = np.broadcast_to(np.eye(2), (2, 2, 2)).copy()
    batch = lv.Batch(eye[:, ::-1].copy(), eye, np.tile([0.0, -1.0], (2, 1)), cones=cones)
    return batch, np.tile([1.0, 0.0], (2, 1))


@pytest.mark.parametrize(
    "words", [("check",), ("explain",), ("doctor",), ("report", "--solvers", "pgs")]
)
def test_folder_of_a_recorder_with_states_is_read_by_the_commands(lavender, tmp_path, words):
    with lv.io.Recorder(tmp_path / "r", every=1) as recorder:
        recorder.add(*make_step(), state={"q": np.zeros((2, 3))})
    out = ("--out", tmp_path / "o") if words[0] == "report" else ()
    code, printed, err = lavender(words[0], tmp_path / "r", *words[1:], *out)
    assert code == 0 and "states" not in printed + err
    code, printed, err = lavender(
        words[0], tmp_path / "r" / "states" / recorder.files[0], *words[1:], *out
    )
    assert code != 0 and "holds the state before a recorded step; its problem is" in " ".join(
        (printed + err).split()
    )


def test_folder_of_an_audit_is_read_as_its_worst_problems(lavender, tmp_path):
    with lv.io.Recorder(tmp_path / "worst", every=1) as recorder:
        recorder.add(*make_step())
    for name in ("records.npz", "states.npz"):
        np.savez(tmp_path / name, velocity=np.zeros(3))
    assert (
        lavender("check", tmp_path)[0] != 0
    )  # Not the folder of an audit: these files are not problems.
    (tmp_path / "numbers.json").write_text("{}")
    code, printed, err = lavender("check", tmp_path)
    assert code == 0, printed + err
