"""Engines behave as the facts behind the table of docs/engines.md state."""

import pytest
from engine_facts import load_facts


@pytest.mark.parametrize("fact", load_facts(), ids=lambda f: f"{f.engine}-{f.probe.__name__}")
def test_engine_of_any_installed_version_behaves_as_the_fact_states(fact):
    for module in fact.module.split():
        pytest.importorskip(module)
    assert fact.probe(), f"{fact.engine} {fact.version}, {fact.subject}: {fact.text}"
