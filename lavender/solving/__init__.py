"""Solve a problem and judge the result; explain the decisions of `auto`."""
