"""A laboratory's own Gymnasium environment."""
