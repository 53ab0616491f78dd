"""Factorisations in the order of a structure: symmetric bands, components and elimination orders of graphs."""
