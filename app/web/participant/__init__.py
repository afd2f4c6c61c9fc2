"""A participant's pages, from the personal link to the end."""
