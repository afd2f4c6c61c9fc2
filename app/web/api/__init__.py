"""The JSON API, its documentation and tokens."""
