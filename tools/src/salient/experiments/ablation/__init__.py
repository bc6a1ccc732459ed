"""Contribution of each estimator and correction of the controller `salient`: runs without it."""
