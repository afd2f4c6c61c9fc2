"""Bundles and controllers that run without the project."""
