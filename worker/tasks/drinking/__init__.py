"""A cup of water, brought to the mouth and tipped."""
