"""Wording in every language, templates."""
