"""Many captures processed in parallel: rows that are never lost, workers that may die, one table in the end."""
