"""Exit codes: the table of docs/commands.md, and for each command the codes that its work can end with."""

import re
from pathlib import Path

import pytest
from stacks import stack

import lavender as lv
from lavender import cli

COMMANDS_PAGE = Path(__file__).resolve().parents[2] / "docs" / "commands.md"
AIR = '<mujoco><worldbody><body><freejoint/><geom size="1" friction="1"/></body></worldbody></mujoco>'
#: (code, command). FOLDER contains an unreadable file.
ENDS = [
    (0, "solve PROBLEM"),
    (1, "solve PROBLEM --solver pgs --max-iter 1"),
    (3, "solve INFEASIBLE --solver direct"),
    (2, "solve PROBLEM --solver nobody"),
    (0, "check PROBLEM --solvers pgs,newton"),
    (0, "check PROBLEM"),
    (1, "check PROBLEM --solvers newton,pgs --tol 1e-12 --time-limit 1e-9"),
    (1, "check PROBLEM --time-limit 1e-9 --solvers pgs"),
    (1, "check FOLDER --solvers newton"),
    (2, "check PROBLEM --solvers nobody"),
    (0, "explain PROBLEM"),
    (1, "explain FOLDER"),
    (2, "explain nothing.npz"),
    (0, "report PROBLEM --solvers pgs --tolerances 1e-3 --budgets 2 --repeats 1 --no-figures"),
    (0, "report PROBLEM --solvers pgs --tolerances 1e-12 --time-limit 1e-9 --budgets 2 --repeats 1 --no-figures"),
    (1, "report FOLDER --solvers pgs --tolerances 1e-3 --budgets 2 --repeats 1 --no-figures"),
    (2, "report nothing.npz"),
    (0, "doctor PROBLEM"),
    (1, "doctor FOLDER"),
    (2, "doctor nothing.npz"),
    (0, "solvers"),
    (0, "contract sor --list"),
    (2, "contract nobody"),
    (0, "run stack --steps 2"),
    (1, "run stack --steps 9 --set gravity=1e60 --set dt=1e60 --set mass=1e60 --set substeps=60"),
    (2, "run nowhere"),
    (2, "view nothing.npz"),
    (2, "export c PROBLEM"),
    (2, "nocommand"),
]
#: Commands that need MuJoCo; AIR is a model whose body touches nothing.
MUJOCO_ENDS = [
    (1, "slip AIR"),
    (2, "slip nothing.xml"),
    (2, "record AIR --steps 1 --out recorded"),
    (1, "tune AIR --worlds 2 --steps 10 --repeats 1"),
    (2, "audit nothing.xml"),
]


def test_documented_exit_codes_equal_those_of_the_package():
    rows = re.findall(r"^\| (\d+) \| (.*) \|$", COMMANDS_PAGE.read_text().partition("## Exit codes")[2], re.M)
    assert {int(code): meaning for code, meaning in rows} == cli.EXIT_CODES


@pytest.mark.parametrize(("code", "words"), ENDS, ids=[f"{words} is {code}" for code, words in ENDS])
def test_command_ends_with_its_documented_code(lavender, tmp_path, code, words):
    stack(8).save(tmp_path / "PROBLEM.npz")
    lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0]).save(tmp_path / "INFEASIBLE.npz")
    folder = tmp_path / "FOLDER"
    folder.mkdir()
    stack(4).save(folder / "good.npz")
    (folder / "bad.npz").write_bytes(b"no problem")
    places = {"PROBLEM": tmp_path / "PROBLEM.npz", "INFEASIBLE": tmp_path / "INFEASIBLE.npz", "FOLDER": folder}
    ended, out, err = lavender(*(places.get(word, word) for word in words.split()))
    assert ended == code, out + err


@pytest.mark.parametrize(("code", "words"), MUJOCO_ENDS, ids=[f"{words} is {code}" for code, words in MUJOCO_ENDS])
def test_mujoco_command_ends_with_its_documented_code(lavender, tmp_path, code, words):
    pytest.importorskip("mujoco", reason="these commands step MuJoCo models")
    (tmp_path / "air.xml").write_text(AIR)
    ended, out, err = lavender(*(tmp_path / "air.xml" if word == "AIR" else word for word in words.split()))
    assert ended == code, out + err
