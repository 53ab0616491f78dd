"""Factorisations in the order of a structure: bands, dense panels, sparse matrices, components and orders of graphs."""
