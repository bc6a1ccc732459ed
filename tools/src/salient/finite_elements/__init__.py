"""Two-dimensional magnetostatic finite elements of a switched-reluctance machine: where the flux-linkage map of
tools/machines/finite_element.csv comes from."""
