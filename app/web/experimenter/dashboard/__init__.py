"""Studies and participants as they change."""
