"""Momentum balance in weak form, streaming: one row for each generalized speed and window, (33)-(37).

Windows overlap by nine tenths: a weak-form row passes a band of frequencies of its own, and hops of a tenth lose none
of it (windows side by side cost fifteen times the error).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter

import msgspec
import numpy as np

from sms_online.model.base_parameters import RANDOM_SEED, RANK_TOLERANCE, BaseParameters, random_inputs, random_states
from sms_online.model.model import Model
from sms_online.pipeline.momentum_windows import (
    COPIES,
    EXPONENT,
    HOPS,
    INSTANTS,
    STEPS,
    Instants,
    Window,
)
from sms_online.pipeline.rough_forces import RoughForces, responses, stiction_std
from sms_online.pipeline.smoothed_columns import Samples, SmoothedColumns, WindowSampling
from sms_online.pipeline.smoothing import HALF_WIDTHS, WidthChoice, smooth, stride
from sms_online.pipeline.standstill import Standstill
from sms_online.pipeline.weak_form import test_function
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices, Mask

# Random states that show which entries of a row are zero by structure.
PATTERN_STATES = 8
# A hop compares the widths of the filter at so many instants.
COMPARED = 5
# Half widths of the filter are at most this share of a window: what a row takes in must pass the filter untouched, for
# its noise is propagated as if there were none.
WIDEST_SHARE = 5
# A window waits for so large a share of itself beyond its end, at most. The last samples of a window pass the widest
# filter that ends there, narrower from one to the next: at a jump from a wide filter to a narrow one the noise would be
# another than that of the rows before, from which a row is subtracted. The test function is below 0.3 % of its height
# there, and passes the windows that follow on to the wide filter.
PROMPT_SHARE = HOPS
# Samples before and after a window that its filter needs at most.
MARGIN = HALF_WIDTHS[-1]


def momentum_pattern(model: Model) -> Mask:
    """Entries (n_v, n_pi) of a weak-form row that the structure of the model does not make zero."""
    rng = np.random.default_rng(RANDOM_SEED)
    x, v = random_states(model, PATTERN_STATES, rng)
    inputs = random_inputs(model, PATTERN_STATES, rng)
    size = sum(np.abs(columns).max(axis=0) for columns in model.momentum_columns(x, v, inputs=inputs))
    return np.asarray(size > RANK_TOLERANCE * size.max(axis=0))


def half_hop(sample_rate: float, span: float) -> int:
    """Samples of half a hop between windows of `span` s, whole ones."""
    return max(1, round(span * sample_rate / INSTANTS))


def half_widths(width: int) -> tuple[int, ...]:
    """The filter's for windows of so many samples: where these are few, the narrowest one is all there is."""
    return tuple(M for M in HALF_WIDTHS if width >= WIDEST_SHARE * M) or HALF_WIDTHS[:1]


def prompt_margin(width: int) -> int:
    """Samples that a window of so many waits for beyond its end."""
    return max(HALF_WIDTHS[0], min(half_widths(width)[-1], width // PROMPT_SHARE))


class MomentumBalanceState(State):
    """What a momentum balance keeps of its segment.

    samples (B, ·): of all copies, from number `first` in the segment on. skip: samples of the segment that are in no
    window, None before the first. window: number of the next window's first sample; instant: of the next one, in half
    hops. compared: squares of the hops from the next window on. thinned, dense: of all columns and of rough forces, by
    the filter's half width.
    """

    samples: Array
    skip: int | None = None
    first: int = 0
    window: int = 0
    instant: int = 0
    compared: list[Array] = msgspec.field(default_factory=list)
    thinned: dict[int, SmoothedColumns] = msgspec.field(default_factory=dict)
    dense: dict[int, SmoothedColumns] = msgspec.field(default_factory=dict)


class MomentumBalance(Stage):
    """Turns grid samples of one segment into windows of rows.

    prompt: windows end at multiples of a hop on the grid, whenever the segment began, and come after `margin` samples
    behind them, with a narrower filter at their end; else they begin with the segment and wait for the widest filter.
    moments: windows hold what parameters that change evenly add to their rows, see `Window.moment`.
    rows, columns (nonzero,): places of the entries of Y that are not zero by the structure of the model. rough: forces
    that are summed from every sample, where all else is from a thinned motion.
    """

    def __init__(
        self, model: Model, base: BaseParameters, sample_rate: float, span: float, prompt: bool = True,
        moments: bool = False,
    ) -> None:  # fmt: skip
        self.model = model
        self._needed = model.of_parameters(base.needed)
        self.base = base
        self.sample_rate = sample_rate
        self.half_hop = half_hop(sample_rate, span)
        self.hop = 2 * self.half_hop
        self.width = INSTANTS * self.half_hop
        self.span = self.width / sample_rate
        self.rows, self.columns = np.nonzero(momentum_pattern(model)[:, list(base.independent)])
        self._physical = np.array(base.independent)[self.columns]
        self.rough = RoughForces(model)
        self._rough = np.flatnonzero(np.isin(self._physical, self.rough.columns))
        self._dry = np.unique(self.rough.axes) + model.layout.offset  # coordinates along which friction is dry
        self._widths = half_widths(self.width)
        # Samples before and after a window that its filter needs.
        self.lead = self._widths[-1]
        self.margin = prompt_margin(self.width) if prompt else self.lead
        # Half width behind the last of the differences that rates at instants come from, see `_differences`.
        self._between = self.margin - (3 * self.half_hop + 1) // 2
        self._prompt = prompt
        self._sampling = WindowSampling(self.width, self.hop, self.margin)
        self._choice = WidthChoice(self._widths)
        self.with_moments = moments
        strides = {1, *(stride(M, self.hop) for M in self._widths)}
        self._phi = {s: self._weights(s) for s in strides}
        self._moment_phi = {s: self._moment_weights(s) for s in strides}
        self.begin_segment()

    def _weights(self, s: int) -> tuple[Array, Array]:
        phi, phi_dot, _ = test_function(self.width // s, self.span, EXPONENT)
        return phi * s / self.sample_rate, phi_dot * s / self.sample_rate

    def _moment_weights(self, s: int) -> tuple[Array, Array]:
        """The same of the test function (t - t_c) φ."""
        phi, phi_dot = self._phi[s]
        ahead = np.linspace(-0.5 * self.span, 0.5 * self.span, phi.size)
        return ahead * phi, phi + ahead * phi_dot

    def begin_segment(self) -> None:
        """Forget the samples before a gap."""
        layout = self.model.layout
        columns = COPIES * (layout.n_x + self.model.n_signals)
        self.state = MomentumBalanceState(np.empty((0, columns)))
        self._standstill = Standstill(self._dry.size, self.sample_rate)

    def push(
        self, index: Indices, copies: list[Array], sigma: Array, lateness: Array | None = None
    ) -> tuple[list[Window], list[Instants]]:
        """Windows that B consecutive samples complete, and the states at their instants.

        index (B,): grid index. copies: x and signals side by side (B, n_x + n_signals) as measured, then with noise
        added and with the same subtracted. sigma (n_x,): noise of x, 1σ per sample. lateness (n_x,): 1σ of how late a
        sample is, s; None for none.
        """
        if self.state.skip is None:
            self.state.skip = -(int(index[0]) + self.lead) % self.hop if self._prompt else 0
        skipped, self.state.skip = min(self.state.skip, index.size), max(0, self.state.skip - index.size)
        self.state.samples = np.concatenate((self.state.samples, np.concatenate(copies, axis=1)[skipped:]))
        if self._dry.size:
            self._standstill.push(copies[0][skipped:, self._dry], sigma[self._dry])
        grid = int(index[-1]) - (self.state.first + self.state.samples.shape[0] - 1)
        chosen: list[tuple[int, int]] = []  # first sample and half width of each window
        while self.state.window + self.width + self.lead + self.margin < self.state.first + self.state.samples.shape[0]:
            chosen.append((self.state.window, self._choose(sigma, lateness)))
            self.state.window += self.hop
            self.state.compared.pop(0)
        instants = [piece for window, half_width in chosen for piece in self._instants(window, half_width)]
        windows: list[Window] = []
        # Windows of one width in a row are processed together.
        for half_width, run in groupby(chosen, key=itemgetter(1)):
            rows = self._rows(half_width, [window for window, _ in run], grid)
            if self.rough.columns.size:
                rows = self._with_rough(half_width, rows)
            windows += rows
        drop = self.state.window - self.state.first
        if drop > 0:
            self.state.samples, self.state.first = self.state.samples[drop:], self.state.window
            self._standstill.drop(self.state.window + self.lead)
        return windows, instants

    def _choose(self, sigma: Array, lateness: Array | None) -> int:
        """Half width for the next window, by all of it but its last hop, which the widest filter does not reach yet.

        Sample n of the segment is at n - first + lead of the buffer.
        """
        n_x = self.model.layout.n_x
        while len(self.state.compared) < HOPS - 1:
            start = self.state.window + len(self.state.compared) * self.hop - self.state.first + self.lead
            centres = start + (np.arange(COMPARED) * self.hop) // COMPARED
            self.state.compared.append(self._choice.squares(self.state.samples[:, :n_x], centres))
        if lateness is not None:
            hops = self.state.window - self.state.first + self.lead + np.arange(HOPS) * self.hop
            rates = np.diff(self.state.samples[hops, :n_x], axis=0) * (self.sample_rate / self.hop)
            sigma = np.sqrt(sigma**2 + lateness**2 * np.mean(rates**2, axis=0))
        return self._choice.widest(np.sum(self.state.compared, axis=0) / ((HOPS - 1) * COMPARED), sigma)

    def _instants(self, window: int, half_width: int) -> list[Instants]:
        """States at the instants up to the end of a window that have not been delivered yet."""
        last = (window + self.width) // self.half_hop
        numbers = np.arange(self.state.instant, last + 1)
        if numbers.size == 0:
            return []
        widths = np.minimum(half_width, self.margin + (last - numbers) * self.half_hop)
        apart = [(numbers[widths == M] * self.half_hop, M) for M in np.unique(widths)[::-1].tolist()]
        x, v, signals = self._states(apart)
        self.state.instant = last + 1
        # The narrowest filter leaves the steps of encoders, which differences multiply. Searches do without them: with
        # them that on a measured rig lost its springs, for a reason that is not known yet.
        if self._prompt and self._between >= HALF_WIDTHS[1]:
            v[0] = self.model.layout.speeds(x[0], self._differences(numbers))
        return [Instants(int(numbers[0]), x[0], v[0], signals[0])]

    def _differences(self, numbers: Indices) -> Array:
        """Rates (K, n_x) of x at instants, from what it is halfway between them, by differences of fourth order.

        Noise of rates that are smoothed each for itself does not add up to that of a motion in a sum over instants:
        columns of calibration would seem to determine what they do not. Of neighbours among these differences it does.
        """
        before, M = self.lead - self.state.first, self._between
        between = np.arange(-3, 5, 2) * self.half_hop
        n_x = self.model.layout.n_x
        samples = self.state.samples[:, :n_x]
        out = np.zeros((numbers.size, n_x))
        for offset, weight in zip(between.tolist(), (1.0, -27.0, 27.0, -1.0), strict=True):
            halves = {offset // 2, -(-offset // 2)}
            for half in halves:
                value, _ = smooth(samples, numbers * self.half_hop + half + before, M, self.sample_rate)
                out += weight / len(halves) * value
        return out * self.sample_rate / (24.0 * self.half_hop)

    def _states(self, samples: Samples) -> tuple[Array, Array, Array]:
        """x (copies, K, n_x), v (copies, K, n_v) and signals (copies, K, n_signals) at K samples.

        samples: their numbers, K in all, and half width M of their filter.
        """
        layout, before = self.model.layout, self.lead - self.state.first
        smoothed = [smooth(self.state.samples, numbers + before, M, self.sample_rate) for numbers, M in samples]
        values, rates = (np.concatenate(parts) for parts in zip(*smoothed, strict=True))
        apart = len(values), COPIES, values.shape[1] // COPIES
        values, rates = (part.reshape(apart).swapaxes(0, 1) for part in (values, rates))
        x, x_dot = values[..., : layout.n_x], rates[..., : layout.n_x]
        v = layout.speeds(x.reshape(-1, layout.n_x), x_dot.reshape(-1, layout.n_x))
        return x, v.reshape(COPIES, -1, layout.n_v), values[..., layout.n_x :]

    def _rows(self, half_width: int, windows: list[int], grid: int) -> list[Window]:
        s, n_v, entries = stride(half_width, self.hop), self.model.layout.n_v, self.rows.size
        kept = self._sampling.kept(self.state.thinned, half_width, s, windows[0], self._entries)
        phi, phi_dot = self._phi[s]
        width = COPIES * (entries + n_v)
        out = []
        for window, values in zip(windows, self._sampling.seen(kept, half_width, windows, self._columns), strict=True):
            weak = -(phi_dot @ values[:, :width] + phi @ values[:, width : 2 * width]).reshape(COPIES, -1)
            b = (phi @ values[:, 2 * width :]).reshape(COPIES, -1) - weak[:, entries:]
            last = grid + window + self.width + self.lead
            none = np.empty((2, STEPS + 1, 0)), np.empty((INSTANTS, 0))
            moment = np.empty(0)
            if self.with_moments:
                psi, psi_dot = self._moment_phi[s]
                moment = -(psi_dot @ values[:, :entries] + psi @ values[:, width : width + entries])
            out.append(Window(window // self.half_hop, last, weak[:, :entries], b, half_width, *none, moment))
        return out

    def _with_rough(self, half_width: int, rows: list[Window]) -> list[Window]:
        """Rows with the columns of rough forces, and what these leave undetermined."""
        phi, _ = self._phi[1]
        windows = [row.start * self.half_hop for row in rows]
        parts = np.cumsum([COPIES * (self._rough.size + self.model.layout.n_v), 2 * self.rough.rows.size])
        entries = int(parts[-1]) + self.rough.dry.size
        kept = self._sampling.kept(self.state.dense, half_width, 1, windows[0], entries)
        axis_of = np.searchsorted(self._dry, self.rough.axes + self.model.layout.offset)
        # Entries of columns and slopes by laws of dry friction: at a standstill their sign is noise's, not friction's.
        by_law = [
            places[:, None] == self.rough.dry for places in (self._physical[self._rough], self.rough.coefficients)
        ]
        out = []
        sampled = self._sampling.seen(kept, half_width, windows, self._rough_columns)
        for window, row, values in zip(windows, rows, sampled, strict=True):
            columns, slopes, breaking = np.split(values, parts, axis=1)
            samples = np.arange(window, window + self.width + 1) + self.lead
            still, turning = (seen(samples)[:, axis_of] for seen in (self._standstill.at, self._standstill.turning))
            moving, both = (~(still @ law.T) for law in by_law)
            columns = columns.reshape(len(columns), COPIES, -1).copy()
            columns[..., : self._rough.size] *= moving[:, None]
            slopes = slopes * np.tile(both, 2)
            weak = -np.tensordot(phi, columns, 1)
            Y = row.Y.copy()
            Y[:, self._rough] = weak[:, : self._rough.size]
            moment = row.moment.copy()
            if self.with_moments:
                moment[self._rough] = -self._moment_phi[1][0] @ columns[:, 0, : self._rough.size]
            rough = responses(slopes, phi * self.sample_rate, half_width, self.sample_rate, STEPS)
            rest = stiction_std(breaking, still | turning, phi)
            out.append(replace(row, Y=Y, b=row.b - weak[:, self._rough.size :], rough=rough, rest=rest, moment=moment))
        return out

    @property
    def _entries(self) -> int:
        n_v = self.model.layout.n_v
        return COPIES * (2 * self.rows.size + 3 * n_v)

    def _columns(self, samples: Samples) -> Array:
        """P and G, each of the base parameters, packed, and of what is known, and Q, for every copy: (K, entries).

        Rough forces are zero there.
        """
        x, v, signals = self._states(samples)
        own, K = self._distinct(x, v, signals)
        P, G = self._needed.momentum_columns(own[0], own[1], inputs=self.model.inputs(own[2]))
        G[:, :, self.rough.columns] = 0.0
        everywhere = np.arange(self.rows.size)
        packed = [self._packed(part, everywhere, K) for part in (P, G)]
        torque = signals[..., : len(self.model.layout.q)]
        force = self.model.generalized_force(torque.swapaxes(0, 1).reshape(-1, torque.shape[2]))
        return np.concatenate((*packed, force.reshape(K, -1)), axis=1)

    def _rough_columns(self, samples: Samples) -> Array:
        """G of rough forces alone, likewise, their slopes, and what breaks them loose: (K, entries)."""
        x, v, signals = self._states(samples)
        own, K = self._distinct(x, v, signals)
        change = self._change(samples, v[0])
        force = self.rough.force(own[0], own[1], own[2], np.tile(change, (len(own[0]) // K, 1)))
        measured = x[0], v[0], signals[0]
        by_law = self.rough.slopes(*measured, change), self.rough.breaking(*measured)
        return np.concatenate((self._packed(force, self._rough, K), *by_law), axis=1)

    def _change(self, samples: Samples, v: Array) -> Array:
        """What the rates of joints with rough forces change by from the sample before (K, n_v), of the motion v."""
        layout, before = self.model.layout, self.lead - self.state.first
        speeds = np.unique(self.rough.coordinates)
        angles = self.state.samples[:, speeds + layout.offset]
        out = np.zeros_like(v)
        if speeds.size:
            # The first sample of all has none before it.
            at = [(np.maximum(numbers - 1 + before, M), M) for numbers, M in samples]
            earlier = np.concatenate([smooth(angles, centres, M, self.sample_rate)[1] for centres, M in at])
            out[:, speeds] = v[:, speeds] - earlier
        return out

    def _distinct(self, x: Array, v: Array, signals: Array) -> tuple[list[Array], int]:
        """States of the copies one below the other, and how many a copy has: without noise all copies are one."""
        copies = COPIES if np.any(x[1] != x[0]) else 1
        return [part[:copies].reshape(-1, part.shape[2]) for part in (x, v, signals)], x.shape[1]

    def _packed(self, part: Array, entries: Indices, K: int) -> Array:
        """Entries of columns at the states of `_distinct`, and what is known of them, for every copy: (K, entries)."""
        own = part[:, self.rows[entries], self._physical[entries]]
        both = np.concatenate((own, self.base.known_part(part)), axis=1)
        both = both.reshape(-1, K, both.shape[1]).swapaxes(0, 1)
        return np.broadcast_to(both, (K, COPIES, both.shape[2])).reshape(K, -1)

    def dense(self, windows: Sequence[Window]) -> Array:
        """Rows [Y b] of windows' copies (W, copies, n_v, n + 1)."""
        rows = np.zeros((len(windows), COPIES, self.model.layout.n_v, self.base.n + 1))
        if len(windows):
            rows[:, :, self.rows, self.columns] = np.array([window.Y for window in windows])
            rows[..., -1] = np.array([window.b for window in windows])
        return rows

    def moments(self, windows: Sequence[Window]) -> Array:
        """Rows (W, n_v, n) of windows by the rates of the parameters about their centres, see `Window.moment`."""
        rows = np.zeros((len(windows), self.model.layout.n_v, self.base.n))
        if self.with_moments:
            rows[:, self.rows, self.columns] = np.array([window.moment for window in windows])
        return rows
