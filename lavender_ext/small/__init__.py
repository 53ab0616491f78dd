"""One small problem in one call: check its start, solve and judge it, over kernels of other packages."""
