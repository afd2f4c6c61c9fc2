"""A cup of water, to the mouth, and tipped."""
