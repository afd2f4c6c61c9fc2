"""Data exports, preference arrays, reports."""
