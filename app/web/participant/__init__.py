"""A participant's pages, from link to debrief."""
