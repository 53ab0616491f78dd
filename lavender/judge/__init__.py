"""The judge: residuals, other measures, certificates, what each block does, and a solution that carries them."""
