"""Where the files lie that the program brings along."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
LOCKS = (ROOT / "requirements.lock", ROOT / "requirements-dev.lock")
MIGRATIONS = ROOT / "migrations"
STATIC = ROOT / "static"
TEMPLATES = ROOT / "templates"
WORDING = ROOT / "app" / "wording"
DEMO_STUDY = ROOT / "app" / "demo" / "feeding.zip"
ANALYSIS = ROOT / "worker" / "analysis" / "exported"
"""The scripts that compute a report from exported tables; handed out, and read as files."""
