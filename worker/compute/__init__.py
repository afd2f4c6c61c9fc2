"""Simulation and learning together, in child processes."""
