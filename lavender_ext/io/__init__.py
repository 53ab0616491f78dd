"""Conversion of constraint rows of other engines to a problem: MuJoCo."""
