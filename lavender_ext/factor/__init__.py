"""Factorisations: dense, banded, sparse by supernodes; elimination orders, components of graphs."""
