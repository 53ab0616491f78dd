"""Newton's method, turn by turn: systems of bodies or rows, interior points, exchanges, rounds, what is tried when."""
