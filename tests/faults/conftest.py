"""Somebody in the middle of a study, as tests of pages have them."""

from tests.app.conftest import taking_part

__all__ = ["taking_part"]
