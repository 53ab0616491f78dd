"""Problems of few rows: look, solve and judge in one call, over kernels of other rooms; islands as such problems."""
