"""Campaigns: many runs of a whole session, for numbers that no single test shows. Run on demand, not by pytest."""
