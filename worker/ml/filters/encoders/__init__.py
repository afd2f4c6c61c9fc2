"""Action encoders, and what an action is worth."""
