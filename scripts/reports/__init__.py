"""Measurements and the pages that show them: `scripts/report NAME`, then `scripts/report pages`."""
