"""Imports a table of flux linkages that another program or a test bench wrote, as a flux-linkage map of a machine
file: text.py splits a text into blocks of cells, columns.py knows names and units, layouts.py makes points of blocks,
mat.py of MAT files, correct.py makes a legal map of points, command.py writes it."""
