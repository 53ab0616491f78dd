"""Small problems: look, solve and judge in one call, over kernels of other rooms; batches of them."""
