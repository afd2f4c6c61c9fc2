"""Installed tasks, as their folders describe them.

Both programs read this. Nothing here imports a task, the simulator or another room of either program.
"""
