"""Independent references: the plant on other solvers, SciPy and ngspice, and the bound of the torque over the speed."""
