"""The worker's runs, reports and bundles."""
