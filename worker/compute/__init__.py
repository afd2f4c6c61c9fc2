"""Simulation and learning, in child processes."""
