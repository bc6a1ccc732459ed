"""salient compare: the controllers beside each other, beside what is wanted of them, and beside an earlier run."""
