"""Measurements and the pages that show them: `scripts/report NAME`, then `scripts/report pages`.

A module measures one thing, keeps what it found in docs/results/NAME.json, and makes parts of the
pages from it (`PARTS`). Pictures are drawn while measuring.
"""
