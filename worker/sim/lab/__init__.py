"""A laboratory's own Gymnasium environment: its episodes, its signals, its pictures."""
