"""Exit codes of the command line."""

OK = 0
BAD_INPUT = 2
NOTHING_DETERMINED = 3
INTERRUPTED = 130
