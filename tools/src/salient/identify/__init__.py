"""Identification: a drive measures its own motor, whose flux linkages are not known."""
