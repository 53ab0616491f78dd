"""Many problems in one call: `Batch` (the data in arrays), `residual_many` (judge) and `solve_many` (solve)."""
