"""The tasks that are installed, as their folders describe them: what web server and worker both know of a task.

Nothing here imports a task, the simulator or either program.
"""
