"""Newton's method and sweeps over generalised velocities: softened blocks, dense and sparse factors, islands of trees."""
