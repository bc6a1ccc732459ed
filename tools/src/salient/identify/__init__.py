"""Identification: a drive measures its own motor, whose flux linkages nobody knows."""
