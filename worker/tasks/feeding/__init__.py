"""Eight balls of food on a spoon, to the mouth."""
