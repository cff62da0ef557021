"""Exit codes of the command line."""

OK = 0
NOTHING_RECEIVED = 1
BAD_INPUT = 2
NOTHING_DETERMINED = 3
INTERRUPTED = 130
