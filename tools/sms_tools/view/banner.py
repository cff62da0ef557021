"""The judgement of the session at the top of the first screen: a lamp in its colour, and in words beside it."""

from __future__ import annotations

import numpy as np
import rerun as rr

from sms_online.verdict.trust import Trust
from sms_tools.view import style
from sms_tools.view.arm_log import times

LAMP, WORDS = "verdict/lamp", "verdict/words"
# Half side of what is seen of the lamp, and its radius: it fills a window of any shape.
LAMP_SHOWN, LAMP_RADIUS = 1.0, 100.0


class Banner:
    """Writes the judgement whenever it reads differently.

    A text document has no colours, and emoji, which do, end the viewer, for its only font has none.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._shown: tuple[str, style.Color] | None = None

    def show(self, t: float, trust: Trust) -> None:
        """The judgement at t, s."""
        color = style.verdict_color(trust)
        text = markdown(trust)
        if self._shown == (text, color):
            return
        index = times(np.array([t]))
        lamp = rr.Points2D.columns(positions=[(0.0, 0.0)], colors=[color], radii=[LAMP_RADIUS])
        self._stream.send_columns(LAMP, index, lamp)
        document = rr.TextDocument.columns(text=[text], media_type=["text/markdown"])
        self._stream.send_columns(WORDS, index, document)
        self._shown = text, color


def markdown(trust: Trust) -> str:
    """The sentence as a heading, the other reasons and the next step on a line below."""
    level, _, reason = trust.sentence.partition(": ")
    others = " · ".join([*trust.others, *([f"next: {trust.next_step}"] if trust.next_step else [])])
    return f"# {level.upper()}: {_plain(reason)}\n\n{_plain(others)}"


def _plain(text: str) -> str:
    """Names with underscores and stars as they are, not as emphasis."""
    for sign in "\\_*":
        text = text.replace(sign, f"\\{sign}")
    return text
