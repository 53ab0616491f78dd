"""From a call to a judged answer: one problem, many; the loop, the clock, the decision trace of `auto`."""
