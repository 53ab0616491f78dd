"""From a call to a judged answer: one problem, many, a quadratic program; the loop, the clock, the way of `auto`."""
