"""Wording in every language, and the template engine."""
