"""The form of a study: fields, what is typed."""
