"""The JSON API below /api/v1, its OpenAPI and its tokens."""
