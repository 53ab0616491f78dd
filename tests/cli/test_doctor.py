"""`lavender doctor`: everything a report of a bug needs, and a self-test that can fail."""

import json
import re

import numpy as np
from click.testing import CliRunner

from lavender.cli.entry import cli
from lavender.report import doctor, machine

NEEDED = {
    "lavender",
    "python",
    "platform",
    "cpu",
    "cores",
    "versions",
    "build",
    "backends",
    "self_test",
    "same_bits",
}


def test_doctor_prints_versions_and_confirms_bits():
    done = CliRunner().invoke(cli, ["doctor", "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.output)
    assert set(found) >= NEEDED
    assert found["self_test"] == dict.fromkeys(doctor.HASHES, "same")
    assert found["versions"]["numpy"] == np.__version__
    assert found["backends"]["osqp"] == f"osqp {found['versions']['osqp']}"
    facts = machine.describe_run({})["build"]
    assert {"kernels", "compiler", "python_flags", "blas"} <= set(facts)
    assert {k: found["build"][k] for k in facts if k != "clock"} == {
        k: facts[k] for k in facts if k != "clock"
    }


def test_doctor_with_a_changed_bit_ends_with_1(monkeypatch):
    name = next(iter(doctor.HASHES))
    monkeypatch.setitem(doctor.HASHES, name, "0" * 16)
    done = CliRunner().invoke(cli, ["doctor"])
    assert done.exit_code == 1
    assert re.search(rf"^ *{name} +{'0' * 16} expected", done.output, re.MULTILINE)
    assert f"{len(doctor.HASHES) - 1} of {len(doctor.HASHES)} give their bits" in done.output
