"""Fixed-point iterations that remember: Anderson mixing, accelerated sweeps, proximal splitting."""
