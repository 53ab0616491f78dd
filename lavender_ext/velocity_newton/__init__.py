"""Newton's method over generalised velocities: soft blocks, dense and sparse factors, islands of trees."""
