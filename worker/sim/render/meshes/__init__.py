"""Shapes and colours of what is drawn."""
