"""The bucket that TEST_STORAGE_URL names, on a server that tests.on_s3 has started."""

import os

BUCKET = os.environ.get("TEST_STORAGE_URL")
