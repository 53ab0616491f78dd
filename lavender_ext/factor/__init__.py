"""Factorisations in the order of a structure: symmetric bands, dense panels of supernodes, components and elimination orders of graphs."""
