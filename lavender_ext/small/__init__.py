"""Small problems: check the start, solve and judge in one call, over kernels of other rooms; batches of them."""
