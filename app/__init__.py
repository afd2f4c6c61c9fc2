"""The web server, and what both programs know: tables, files, settings."""
