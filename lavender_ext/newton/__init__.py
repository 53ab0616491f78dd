"""Newton's method by turns: systems of bodies, rows and programs, interior points, exchanges, rounds, and when."""
