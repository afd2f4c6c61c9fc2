"""The worker's runs, reports and bundles, as pages need them."""
