"""The built-in problems, measurements and reports, and the examination of problems and answers."""
