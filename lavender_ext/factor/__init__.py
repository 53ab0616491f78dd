"""Factorisations in the order of a structure: bands, dense panels, components and elimination orders of graphs."""
