"""The judge: residuals, other measures, certificates, states of blocks, and the solution that holds them."""
