"""salient compare: the controllers side by side, with targets, theoretical limits, published values and a baseline."""
