"""Generators that the build runs: CAN codec, machine data, functional mock-up unit."""

from salient.light_can import without_mf4

without_mf4()
