"""One call for one small problem: check its start, solve and judge it, with kernels of other packages."""
