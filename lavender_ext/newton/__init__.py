"""Newton's method by turns: systems of bodies and rows, interior points, exchanges, rounds, and when."""
