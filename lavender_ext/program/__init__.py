"""The error of quadratic programs, and the forms of their rows that backends and Newton steps need."""
