"""The drawn arm: points and lines in inertial axes for many positions at once, by the model's own kinematics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_online.description.bodies import FlexibleLink, RigidLink
from sms_online.description.tree import BASE, mounts
from sms_online.model.chain import Configuration
from sms_online.model.model import Model
from sms_online.model.points import LinkPoints
from sms_online.stream import Array

# A dimension of the spacecraft that the description does not state is drawn as this share of its largest.
LEAST_SIDE = 0.2
# In the plane the spacecraft is a plate so far below the arm, as a share of its reach, that the arm passes over it.
PLATE_DEPTH = 0.03
# m, where the description states no length at all, as of a single axis.
UNKNOWN_REACH = 1.0
# A fixed base is drawn as a cube with this share of the arm's reach as half its side.
PEDESTAL = 0.06
# A last link whose description states no point but its joint is drawn so long, as a share of the arm's reach.
STUB = 0.15


@dataclass(frozen=True)
class Drawing:
    """B pictures of an arm, in m.

    S (B, 3); base_rotation (B, 3, 3); base_origin (B, 3): joint 1, the origin of {0}. joints (B, joints, 3). links:
    for each link its line (B, P, 3), from joint to end, of a prismatic joint from where it is mounted. A rigid link
    without a stated tip ends in its centre of mass. ghost (B, G, 3): the same arm if it were rigid. markers (B, M, 3).
    tip (B, 3): the end of the line of the link of the last joint that moves.
    """

    S: Array
    base_origin: Array
    base_rotation: Array
    joints: Array
    links: tuple[Array, ...]
    ghost: Array
    markers: Array
    tip: Array


class Scene:
    """What can be drawn of a model.

    exaggeration: factor on the deflections of links and joints. box: centre and half sides (3,) of the spacecraft in
    {0}, m: the smallest box about its centre of mass that holds joint 1 and S. reach: length of the stretched arm, m.
    markers: (link from 1, marker from 1) of each drawn marker.
    """

    def __init__(self, model: Model, exaggeration: float = 1.0) -> None:
        self.model = model
        self.exaggeration = exaggeration
        system = model.system
        self._ends = [_extent(link) for link in system.links]
        self.reach = self._longest() or UNKNOWN_REACH
        if system.spacecraft is None:
            self.box = (np.zeros(3), np.full(3, PEDESTAL * self.reach))
        else:
            center = np.array(system.spacecraft.center_of_mass)
            half = np.maximum(np.abs(center), np.abs(np.array(system.spacecraft.tracked_point) - center))
            half = np.maximum(half, LEAST_SIDE * (float(half.max()) or PEDESTAL * self.reach))
            if model.layout.planar:
                center[2], half[2] = -PLATE_DEPTH * self.reach, 0.0
            self.box = (center, half)
        for i in model.chain.tree.ending:
            if not self._ends[i].any() and i < len(system.joints) and system.joints[i].kind == "revolute":
                # Across the axis, so that its turning is seen.
                self._ends[i] = STUB * self.reach * np.eye(3)[np.argmin(np.abs(system.joints[i].axis))]
        links = [i for i, link in enumerate(system.links) if link.points]
        self._points = [LinkPoints(system, model.chain, i) for i in links]
        self.markers = tuple((i + 1, j + 1) for i in links for j in range(len(system.links[i].points)))
        layout = model.layout
        self._q = [index + layout.offset for index in layout.q]
        self._theta_m = [index + layout.offset for index in layout.theta_m]
        numbers = np.arange(layout.n_x)
        self._elastic = np.concatenate([numbers[layout.elastic(i)] for i in range(len(layout.q_f))])

    def draw(self, x: Array) -> Drawing:
        """Pictures of the positions x (B, n_x)."""
        shown = self._with_deflections(x, self.exaggeration)
        configuration = self.model.chain.configure(shown)
        frames = configuration.frames
        n = len(self.model.system.joints)
        rigid = self.model.chain.configure(self._with_deflections(x, 0.0))
        links = tuple(self._line(configuration, i) for i in range(len(self._ends)))
        return Drawing(
            S=configuration.r_S,
            base_origin=frames[0].origin,
            base_rotation=frames[0].rotation,
            joints=np.stack([frames[2 * i + 2].origin for i in range(n)], axis=1),
            links=links,
            ghost=np.stack(self._skeleton(rigid), axis=1),
            markers=self._markers(configuration),
            tip=links[self.model.chain.tree.last][:, -1],
        )

    def _longest(self) -> float:
        """Length of the longest way from the base to the end of a link, stretched, m."""
        system, tree = self.model.system, self.model.chain.tree
        every = mounts(system)

        def length(i: int) -> float:
            link = system.links[i]
            root = link.root_position if isinstance(link, FlexibleLink) else (0.0, 0.0, 0.0)
            # Where {0} lies in the base is no length of an arm on it.
            offset = every[i].mount_position if tree.parents[i] != BASE else (0.0, 0.0, 0.0)
            return float(np.linalg.norm(self._ends[i]) + np.linalg.norm(root) + np.linalg.norm(offset))

        return max(sum(length(k) for k in (i, *tree.inwards(i))) for i in range(len(system.links)))

    def _skeleton(self, configuration: Configuration) -> list[Array]:
        """Points (B, 3) of one line through all links: to each end of the tree, and back where there are several."""
        tree = self.model.chain.tree
        out: list[Array] = []
        for end in tree.ending:
            way = [configuration.frames[2 * i + 2].origin for i in (*tree.inwards(end)[::-1], end)]
            out += [*way, self._line(configuration, end)[:, -1], *(way[::-1] if len(tree.ending) > 1 else ())]
        return out

    def _with_deflections(self, x: Array, factor: float) -> Array:
        """The same motor angles with every deflection, of links and of joints, multiplied."""
        out = x.copy()
        out[:, self._elastic] *= factor
        out[:, self._q] = x[:, self._theta_m] + factor * (x[:, self._q] - x[:, self._theta_m])
        return out

    def _line(self, configuration: Configuration, i: int) -> Array:
        """Axis of link i (from 0): its ends, and between them the points at which the model integrates its shape."""
        joints = self.model.system.joints
        mount, link = configuration.frames[2 * i + 1 : 2 * i + 3]
        # A slide, or the bracket of a flexible link.
        apart = self.model.chain.roots[i].offset is not None
        start = [mount.origin] if apart or (i < len(joints) and joints[i].kind == "prismatic") else []
        shape = configuration.shape(i)
        if shape is None:
            return np.stack((*start, link.origin, link.origin + link.rotation @ self._ends[i]), axis=1)
        inner = link.origin[:, None] + np.einsum("bij,bgj->bgi", link.rotation, shape.points)
        ends = np.stack((*start, link.origin), axis=1)
        return np.concatenate((ends, inner, configuration.end(i, link).origin[:, None]), axis=1)

    def _markers(self, configuration: Configuration) -> Array:
        """Markers (B, M, 3) where the model has them, in inertial axes."""
        none = np.empty((configuration.size, 0, 3))
        return np.concatenate([none, *(points(configuration) for points in self._points)], axis=1)


def _extent(link: RigidLink | FlexibleLink) -> Array:
    """What a link is drawn to while it is straight, (3,) in its frame, m; the origin where nothing is stated."""
    if isinstance(link, FlexibleLink):
        return np.array((link.length, 0.0, 0.0))
    return np.array(link.tip if any(link.tip) else link.center_of_mass)
