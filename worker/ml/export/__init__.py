"""Bundles that run without this project."""
