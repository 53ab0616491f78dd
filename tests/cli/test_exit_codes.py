"""Exit codes: the table of docs/commands.md, and for each command the codes that its work can end with."""

import re
from pathlib import Path

import pytest
from stacks import stack

import lavender as lv
from lavender import cli

COMMANDS_PAGE = Path(__file__).resolve().parents[2] / "docs" / "commands.md"
AIR = (
    '<mujoco><worldbody><body><freejoint/><geom size="1" friction="1"/></body></worldbody></mujoco>'
)
#: (code, command). FOLDER contains an unreadable file; AIR is a model of MuJoCo whose body touches nothing.
ENDS = [
    (0, "solve PROBLEM"),
    (1, "solve PROBLEM --solver pgs --max-iter 1"),
    (0, "solve PROBLEM --solver pgs --max-iter 1 --tol 0"),
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
    (
        0,
        "report PROBLEM --solvers pgs --tolerances 1e-12 --time-limit 1e-9 --budgets 2 --repeats 1 --no-figures",
    ),
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
    (1, "check granularF(n=3) --solvers sor"),
    (0, "check granularF(n=3) --solvers sor,newton"),
    (1, "slip AIR"),
    (2, "slip nothing.xml"),
    (2, "audit nothing.xml"),
    (2, "record AIR --steps 1 --out recorded"),
    (1, "tune AIR --worlds 2 --steps 10 --repeats 1"),
]
#: Commands with a wrong word, number or combination of options.
WRONG = """
nocommand | slove PROBLEM | report --solvers pgz | report no/such.npz | report stak(n=8) | report --tolerances 0
report a.jsonl b.npz | report missing.jsonl | report --tolerances many | report --time-budgets 0 | report PROBLEM --list
report PROBLEM --steps 3 | report PROBLEM --sequence-time-limit 3 | report PROBLEM --solvers direct --budgets 3
report --workers 1 --time-limit 3 | report a.jsonl --tolerances 1e-3
report a.xml --seed 3 --controls zero
report PROBLEM --seed 3 | report PROBLEM --workers 0 | report PROBLEM --workers -2 | check a.jsonl
report PROBLEM --workers 1000000000 | solve PROBLEM --solver direct --order reverse
solve PROBLEM --solver pgs --output no/such/folder.npz
solve random_spd(n=5000000) | check PROBLEM --reference nobody | run stac | run stack --set n | run stack --set m=3
run stack --iterations 3 | run stack --order given --set order=reverse | run stack --warm-start --set warm_start=false
run stack --iterations 8 --set solver_iterations=4 | run stack --replace | run stack --plot x.plot
run stack --film x.mp4 | record a.xml --out o --seed 3 --controls zero
audit AIR --steps 0 | audit AIR --worlds 0 | audit AIR --keep 0 | audit AIR --engine kamino --workers 3 | audit PROBLEM
audit AIR --engine kamino --precision float32 | tune AIR --worlds 1 | tune AIR --steps 3 --horizon 2 | tune PROBLEM
record AIR --out r --steps 0 | slip AIR --steps 0 | slip AIR --contact wheel | slip PROBLEM
tune AIR --worlds 2 --steps 2 --max-velocity-error -1
"""


@pytest.fixture
def run_line(lavender, tmp_path):
    """Run a command in which words in capitals are files: (status, stdout, stderr)."""
    stack(8).save(tmp_path / "PROBLEM.npz")
    lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0]).save(tmp_path / "INFEASIBLE.npz")
    (tmp_path / "AIR.xml").write_text(AIR)
    folder = tmp_path / "FOLDER"
    folder.mkdir()
    stack(4).save(folder / "good.npz")
    (folder / "bad.npz").write_bytes(b"no problem")
    places = {path.stem: path for path in tmp_path.glob("[A-Z]*")}

    def run(line):
        if line.split()[0] in ("audit", "record", "slip", "tune"):
            pytest.importorskip("mujoco")
        return lavender(*(places.get(word, word) for word in line.split()))

    return run


def test_documented_exit_codes_equal_the_package():
    rows = re.findall(
        r"^\| (\d+) \| (.*) \|$", COMMANDS_PAGE.read_text().partition("## Exit codes")[2], re.M
    )
    assert {int(code): meaning for code, meaning in rows} == cli.EXIT_CODES


@pytest.mark.parametrize(
    ("code", "words"), ENDS, ids=[f"{words} is {code}" for code, words in ENDS]
)
def test_command_ends_with_its_documented_code(run_line, code, words):
    ended, out, err = run_line(words)
    assert ended == code, out + err


@pytest.mark.parametrize("words", re.split(r" \| |\n", WRONG.strip()))
def test_command_with_a_wrong_argument_prints_an_error_and_ends_with_2(run_line, words):
    ended, out, err = run_line(words)
    assert (ended, out) == (2, ""), out + err
    assert len(err.strip().splitlines()) == 1 or err.startswith("Usage: "), err
