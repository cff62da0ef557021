"""The process that searches for effects while a session runs: requests from stdin, answers to stdout, pickled.

It ends when its input ends, however that comes about.
"""

from __future__ import annotations

import os
import pickle
import sys

from sms_online.diagnosis.online_search import search
from sms_online.diagnosis.searcher import AnyRequest

# The estimator and whoever else works on the machine come first.
NICENESS = 10


def main() -> None:
    """Answer until there are no more requests."""
    os.nice(NICENESS)
    # Answers keep the real stdout; what libraries print must not get between them.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        while True:
            request: AnyRequest = pickle.load(sys.stdin.buffer)
            pickle.dump(search(request), answers)
            answers.flush()
    except (EOFError, BrokenPipeError):
        pass


if __name__ == "__main__":
    main()
