"""Newton's method and sweeps over generalised velocities: softened blocks, dense factors, islands of trees."""
