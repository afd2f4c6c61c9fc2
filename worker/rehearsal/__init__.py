"""Scripted participants who use a running server."""
