"""Many captures worked off at once: rows that are never lost, workers that may die, one table in the end."""
