"""Scenarios: every parameter of a simulation, and its TOML."""
