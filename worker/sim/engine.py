"""The one place that imports pybullet, which bullet, drawing and geometry wrap."""

from worker.sim.quiet import silenced_stderr

with silenced_stderr():  # the engine greets with its build time, in every process
    import pybullet

__all__ = ["pybullet"]
