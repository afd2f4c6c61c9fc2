"""The pages and the API. Routes translate HTTP; the services decide."""
