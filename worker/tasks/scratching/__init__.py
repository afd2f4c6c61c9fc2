"""An itch on the right arm, which gives way."""
