"""Accelerated fixed-point iterations: Anderson mixing, accelerated sweeps, proximal splitting."""
