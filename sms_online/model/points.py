"""Markers as cameras see them: points of the links in the laboratory's axes, and how the speeds move them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_online.description.bodies import FlexibleLink
from sms_online.description.channels import point_channels
from sms_online.description.schema import System
from sms_online.model import so3
from sms_online.model.chain import Chain, Configuration
from sms_online.stream import Array

# Step along a link by which places of markers are differentiated, m.
STATION = 1e-4


@dataclass(frozen=True)
class Local:
    """Points of one link in its frame {i}: position (B, n, 3), m, and by its elastic coordinates (B, n, 3, n_f)."""

    position: Array
    by_elastic: Array


class LinkPoints:
    """The markers of link i (from 0) of a system."""

    def __init__(self, system: System, chain: Chain, i: int) -> None:
        link = system.links[i]
        self.link = i
        self.names = tuple(point_channels(system, i + 1))
        self._chain = chain
        self._rest = np.array(link.points)
        kinematics = chain.flexible[i]
        self._sections = None
        if kinematics is not None:
            assert isinstance(link, FlexibleLink)
            self._sections = kinematics.sections(self._rest[:, 0])
            self._before = kinematics.sections(self._rest[:, 0] - STATION)
            self._offset = self._rest * np.array([0.0, 1.0, 1.0])

    def whole(self, available: Sequence[str]) -> list[int]:
        """Which of the names belong to markers that are measured in all axes."""
        per_marker = len(self.names) // len(self._rest)
        marker = np.array([name in available for name in self.names]).reshape(-1, per_marker).all(axis=1)
        return np.flatnonzero(np.repeat(marker, per_marker)).tolist()

    def local(self, q_f: Array) -> Local:
        """The points for the link's elastic coordinates q_f (B, n_f)."""
        if self._sections is None:
            rest = np.broadcast_to(self._rest, (len(q_f), *self._rest.shape))
            return Local(rest, np.zeros((*rest.shape, 0)))
        sections = self._sections(q_f)
        arm = (sections.rotation @ self._offset[..., None])[..., 0]
        return Local(sections.center + arm, sections.J - so3.skew(arm) @ sections.spin)

    def __call__(self, configuration: Configuration) -> Array:
        """The points in inertial axes (B, n, 3), m."""
        frame = configuration.frames[2 * self.link + 2]
        local = self.local(self._chain.elastic(configuration.x, self.link)).position
        return np.asarray(frame.origin[:, None] + local @ frame.rotation.swapaxes(1, 2))

    def by_place(self, configuration: Configuration) -> Array:
        """Their derivatives by station along the link and by offset along y and z, (B, n, 3, 3), the places last."""
        rotation = configuration.frames[2 * self.link + 2].rotation[:, None]
        if self._sections is None:
            return np.broadcast_to(rotation, (len(rotation), len(self._rest), 3, 3))
        q_f = self._chain.elastic(configuration.x, self.link)
        here, before = self._sections(q_f), self._before(q_f)
        moved = here.center - before.center + ((here.rotation - before.rotation) @ self._offset[..., None])[..., 0]
        return np.asarray(rotation @ np.concatenate((moved[..., None] / STATION, here.rotation[..., 1:]), axis=3))

    def by_displacement(self, configuration: Configuration) -> Array:
        """Their derivatives by displacements in the order of the speeds, (B, n, 3, n_v)."""
        local = self.local(self._chain.elastic(configuration.x, self.link))
        twist = configuration.jacobians[2 * self.link + 2][:, None]
        velocity = twist[:, :, :3] - so3.skew(local.position) @ twist[:, :, 3:]
        velocity[..., self._chain.layout.q_f[self.link]] += local.by_elastic
        return np.asarray(configuration.frames[2 * self.link + 2].rotation[:, None] @ velocity)


class Points:
    """The markers of a whole system as channels `link_i.marker_j.x` …; only those named, where any are."""

    def __init__(self, system: System, chain: Chain) -> None:
        self._chain = chain
        self._axes = [0, 1] if chain.layout.planar else [0, 1, 2]
        self.links = [LinkPoints(system, chain, i) for i, link in enumerate(system.links) if link.points]
        self.names = tuple(name for link in self.links for name in link.names)

    def __call__(self, x: Array) -> Array:
        """Readings (B, channels) at x (B, n_x), m."""
        configuration = self._chain.configure(x)
        parts = [link(configuration)[..., self._axes].reshape(len(x), -1) for link in self.links]
        return np.concatenate(parts, axis=1)

    def by_displacement(self, x: Array) -> Array:
        """Their derivatives by displacements in the order of the speeds, (B, channels, n_v)."""
        configuration, n_v = self._chain.configure(x), self._chain.layout.n_v
        parts = [link.by_displacement(configuration)[:, :, self._axes].reshape(len(x), -1, n_v) for link in self.links]
        return np.concatenate(parts, axis=1)

    def by_place(self, x: Array) -> Array:
        """Their derivatives by the places of the markers, see `LinkPoints`, (B, channels, markers · axes)."""
        configuration, axes = self._chain.configure(x), self._axes
        out = np.zeros((len(x), len(self.names), len(self.names)))
        at = 0
        for link in self.links:
            by_place = link.by_place(configuration)[..., axes, :][..., axes]
            for k in range(by_place.shape[1]):
                own = slice(at, at + len(axes))
                out[:, own, own] = by_place[:, k]
                at += len(axes)
        return out
