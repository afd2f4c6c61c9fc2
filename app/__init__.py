"""The web server, and what both programs know: database, artefacts, settings."""
