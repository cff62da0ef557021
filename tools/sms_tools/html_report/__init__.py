"""report.html of a session: one file that needs nothing else, to be read long after the session."""
