"""Rows of other engines in the layout of a problem: MuJoCo's constraint rows."""
