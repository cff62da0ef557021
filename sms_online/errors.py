"""Errors of input: one line with file, place, what was found and what was expected."""

from __future__ import annotations


class InputError(Exception):
    """Bad input from the person at the testbed; the command line prints it as one line and exits with code 2."""

    def __init__(self, source: str, place: str, found: str, expected: str) -> None:
        self.source = source
        self.place = place
        self.found = found
        self.expected = expected
        where = f"{source}, {place}" if place else source
        super().__init__(f"{where}: {found}; expected {expected}")
