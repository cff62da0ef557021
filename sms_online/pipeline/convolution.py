"""Corrections of grid samples that ask for samples on both sides, so that every channel is passed on as much later."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import correlate1d

from sms_online.pipeline.synchronise import GridSamples
from sms_online.state import Stage, State
from sms_online.stream import Array


class ConvolutionState(State):
    """What a convolution keeps: values (B, C), the last samples of a segment, which the next ones ask for."""

    values: Array
    segment: int = -1


class Convolution(Stage):
    """Corrects channels by weights of the samples about each instant, and then sample by sample.

    kernels: weights (2M + 1,) by the channel's number. margin: M of the longest; what lies so close to a gap is lost.
    """

    def __init__(self, kernels: Mapping[int, Array]) -> None:
        self._kernels = kernels
        self.margin = max((kernel.size // 2 for kernel in kernels.values()), default=0)
        self.state = ConvolutionState(np.empty((0, 0)))

    def push(self, piece: GridSamples) -> list[GridSamples]:
        """The samples that can be corrected by now."""
        if piece.segment != self.state.segment:
            self.state.segment, self.state.values = piece.segment, piece.values[:0]
        values = np.concatenate((self.state.values, piece.values))
        self.state.values = values[max(0, len(values) - 2 * self.margin) :]
        inner = slice(self.margin, len(values) - self.margin)
        if inner.stop <= inner.start:
            return []
        corrected = values[inner].copy()
        for column, kernel in self._kernels.items():
            corrected[:, column] = correlate1d(values[:, column], kernel, mode="nearest")[inner]
        self._correct(corrected)
        last = int(piece.index[-1]) - self.margin
        index = np.arange(last + 1 - len(corrected), last + 1, dtype=np.int64)
        return [GridSamples(index, corrected, piece.segment)]

    def _correct(self, values: Array) -> None:
        """Correct samples (B, C) in place, each by itself."""
        raise NotImplementedError
