"""Engines behave as the facts behind the table of docs/engines.md state."""

import pytest
from engine_facts import load_facts


@pytest.mark.parametrize("fact", load_facts(), ids=lambda f: f"{f.engine}-{f.probe.__name__}")
def test_fact_about_an_installed_engine_still_holds(fact):
    for module in fact.module.split():
        pytest.importorskip(module)
    assert fact.probe(), f"{fact.engine} {fact.version}, {fact.subject}: {fact.text}"
