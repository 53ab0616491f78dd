"""Complementary and principal pivoting, with the dense and banded factorisations under them."""
