"""Generators that the build runs: CAN codec, machine data, functional mock-up unit."""
