"""Dashboard figures, participants' states, health."""
