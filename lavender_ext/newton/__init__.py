"""Newton systems of the whole problem: block Cholesky and LU, interior point steps, natural maps."""
