"""Scenarios, the paper's experiments, metrics, plots and reports."""
