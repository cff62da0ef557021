"""CAN frames to samples, decoded in arrays. Each frame of a wanted message is one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sms_adapters.can_signals import WantedMessage, decode_signal, raw_word
from sms_adapters.conversion import Conversions, FrameCounter
from sms_adapters.raw import ERROR_FRAME, REMOTE_FRAME, CanFrames, DecodedSamples, Raw, concatenate_frames
from sms_online.description.sources import Signal
from sms_online.stream import Mask, increments

# Unknown identifiers that are remembered, to name them.
_SHOWN_IDS = 5


class CanDecoder:
    """Decodes the frames of wanted messages: a `Decoder`.

    messages: those wanted. signals: what the system file says of each, in the order of their columns. t_device is the
    frames' stamp. A frame with the stamp of its message's last one is a repetition (counted as repeated_time).
    """

    def __init__(self, messages: Sequence[WantedMessage], signals: Sequence[Signal]) -> None:
        self.channels = tuple(signal.channel for signal in signals)
        kinds = ("error_frame", "remote", "unknown_id", "wrong_length", "repeated_time", "non_finite", "out_of_range")
        self.counters = dict.fromkeys((*kinds, *FrameCounter.KINDS), 0)
        self.unknown_ids: list[int] = []  # the first of them
        self.messages = tuple(messages)
        self._ids = np.array([message.id for message in messages], dtype=np.uint32)
        self._parts = [(k, part) for k, message in enumerate(messages) for part in message.parts]
        self._conversions = [
            Conversions([signals[column] for column in part.columns], self.counters) for _, part in self._parts
        ]
        self.turns = {channel: turns for each in self._conversions for channel, turns in each.turns.items()}
        self._sequences = [
            None if message.counter is None else FrameCounter(1 << message.counter.length, self.counters)
            for message in messages
        ]
        self._last_stamp = np.full(len(messages), np.nan)

    def push(self, *items: Raw) -> DecodedSamples:
        """The samples in some frames; (M, C) values with NaN in the channels of other messages."""
        parts: list[CanFrames] = []
        for item in items:
            if not isinstance(item, CanFrames):
                raise TypeError(f"{type(item).__name__} pushed into a decoder of CAN frames")
            parts.append(item)
        raw = parts[0] if len(parts) == 1 else concatenate_frames(parts)
        values = np.full((len(raw), len(self.channels)), np.nan)
        used = np.zeros(len(raw), dtype=np.bool_)
        plain = self._plain(raw)
        admitted = [
            self._admitted(k, message, raw, np.flatnonzero(plain & (raw.id == message.id)))
            for k, message in enumerate(self.messages)
        ]
        for (k, part), convert in zip(self._parts, self._conversions, strict=True):
            rows = admitted[k]
            words = self.messages[k].words(raw.data, rows)
            if part.condition:
                held = part.held(words)
                rows, words = rows[held], words[held]
            if not rows.size:
                continue
            numbers = np.stack([decode_signal(signal, words) for signal in part.signals], axis=1)
            values[rows[:, None], list(part.columns)] = convert(numbers)
            used[rows] = True
        # A frame whose every value was refused is no sample.
        used &= ~np.isnan(values).all(axis=1)
        return DecodedSamples(raw.arrival[used], raw.stamp[used], values[used])

    def _plain(self, raw: CanFrames) -> Mask:
        """(N,) frames that hold data and have a wanted identifier; the others are counted."""
        error, remote = (raw.flags & ERROR_FRAME) != 0, (raw.flags & (ERROR_FRAME | REMOTE_FRAME)) == REMOTE_FRAME
        self.counters["error_frame"] += int(np.count_nonzero(error))
        self.counters["remote"] += int(np.count_nonzero(remote))
        data = ~(error | remote)
        known = np.isin(raw.id, self._ids)
        unknown = raw.id[data & ~known]
        self.counters["unknown_id"] += unknown.size
        if unknown.size and len(self.unknown_ids) < _SHOWN_IDS:
            new = [id_ for id_ in dict.fromkeys(unknown.tolist()) if id_ not in self.unknown_ids]
            self.unknown_ids += new[: _SHOWN_IDS - len(self.unknown_ids)]
        plain: Mask = data & known
        return plain

    def _admitted(self, k: int, message: WantedMessage, raw: CanFrames, rows: NDArray[np.intp]) -> NDArray[np.intp]:
        """The rows of message k that give a sample: of the right length, neither repeated nor late."""
        whole = rows[raw.length[rows] == message.length]
        self.counters["wrong_length"] += rows.size - whole.size
        stamps = raw.stamp[whole]
        fresh = increments(stamps, self._last_stamp[k]) != 0  # true where there is no stamp
        if stamps.size:
            self._last_stamp[k] = stamps[-1]
        self.counters["repeated_time"] += int(np.count_nonzero(~fresh))
        admitted: NDArray[np.intp] = whole[fresh]
        sequence = self._sequences[k]
        if sequence is not None and message.counter is not None:
            counts = raw_word(message.counter, message.words(raw.data, admitted)).astype(np.int64)
            admitted = admitted[sequence.admit(counts)]
        return admitted
