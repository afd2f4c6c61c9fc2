"""How one is found for a person, and gated."""
