"""Markers of a motion capture: where each is attached to its link."""

from __future__ import annotations

from sms_online.description.record import Record


class Marker(Record):
    """A marker that cameras see as a point.

    name: what it is called elsewhere, in a file of a motion capture for instance.
    position: in the frame {i} of the undeformed link, m. On a flexible link x is its station along the link, y and z
    are its offset from the neutral axis, which turns with the section there.
    """

    name: str = ""
    position: tuple[float, float, float]
