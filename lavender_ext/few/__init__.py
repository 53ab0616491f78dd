"""Problems of few rows: look, solve and judge in one call, over the kernels of other rooms."""
