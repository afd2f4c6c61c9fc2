"""Tells the operator what is wrong."""
