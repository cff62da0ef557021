"""What each kind of fault that a decoder counts means to the person at the testbed."""

from __future__ import annotations

from collections.abc import Mapping

# Kind to (what was counted, what happened); the order is that of the messages.
FAULTS = {
    "error_frame": ("error frames", "the bus or its controller reports trouble"),
    "remote": ("remote frames skipped", "they ask for data and hold none"),
    "unknown_id": ("frames skipped", "no channel comes from their ids"),
    "wrong_length": ("frames skipped", "their length is not the described one"),
    "repeated_time": ("frames skipped", "their time repeats that of their message's last one"),
    "framing": ("frames skipped", "their framing is broken"),
    "crc": ("frames skipped", "their checksum is wrong"),
    "bad_frame": ("datagrams skipped", "they are no frames of the described version of NatNet"),
    "non_utf8": ("lines skipped", "they are not text"),
    "bad_number": ("lines skipped", "they are not the described numbers"),
    "too_long": ("stretches skipped", "longer than any frame or line that is described"),
    "cut_line": ("lines skipped", "their beginning was not received"),
    "repeated_counter": ("frames skipped", "their counter repeats the one before"),
    "late_counter": ("frames skipped", "their counter goes back"),
    "lost_counter": ("frames lost", "their counts are missing"),
    "restarted_counter": ("restarts", "a sender's counter began again"),
    "non_finite": ("values skipped", "NaN or infinite"),
    "hidden": ("positions skipped", "the cameras did not see all of their marker or body"),
    "out_of_range": ("values skipped", "outside the limits of their channel"),
}


def sentences(name: str, counters: Mapping[str, int]) -> list[str]:
    """One sentence for each kind of fault that occurred; name: of the source or file."""
    return [
        f"{name}: {counters[kind]} {what}, {why}" for kind, (what, why) in FAULTS.items() if counters.get(kind, 0) > 0
    ]
