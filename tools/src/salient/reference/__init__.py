"""Reference models of the plant on other solvers: SciPy and ngspice."""
