"""Newton's method and sweeps over generalised velocities: soft blocks, dense and sparse factors, islands of trees."""
