"""What stands in a lab, and what robots meet and see of it: touching, and the ranges of ultrasonic sensors."""

from __future__ import annotations

from typing import Final

import numpy as np

from failover.simulators.world.motion import Floats
from failover.simulators.world.parts import Lab

RANGE_MAX_M: Final = 4.0
"""What an ultrasonic sensor tells where nothing is nearer."""
_PARALLEL: Final = 1e-12


class Room:
    """Walls as lines, columns as discs; robots are discs, too."""

    def __init__(self, lab: Lab) -> None:
        width, depth = lab.size
        around = [(0.0, 0.0, width, 0.0), (width, 0.0, width, depth), (width, depth, 0.0, depth), (0.0, depth, 0.0, 0.0)]
        lines = np.array([*around, *lab.walls], float)
        self._from, self._along = lines[:, :2], lines[:, 2:] - lines[:, :2]
        columns = np.array(lab.obstacles, float).reshape(-1, 3)
        self._centre, self._width = columns[:, :2], columns[:, 2]

    def clearance(self, place: Floats, radius: Floats) -> Floats:
        """``n × (lines + columns + n)``: metres from each robot's edge to each thing; to itself it is infinite."""
        off = place[:, None, :] - self._from
        part = np.clip((off * self._along).sum(axis=2) / (self._along**2).sum(axis=1), 0.0, 1.0)
        lines = np.linalg.norm(off - part[:, :, None] * self._along, axis=2)
        columns = np.linalg.norm(place[:, None, :] - self._centre, axis=2) - self._width
        robots = np.linalg.norm(place[:, None, :] - place, axis=2) - radius
        np.fill_diagonal(robots, np.inf)
        return np.concatenate([lines, columns, robots], axis=1) - radius[:, None]

    def stopped(self, before: Floats, after: Floats, radius: Floats) -> Floats:
        """Places that come of a move: a robot that would touch something, and come nearer to it, stays where it was."""
        old, new = self.clearance(before, radius), self.clearance(after, radius)
        is_blocked = np.any((new < 0) & (new < old), axis=1, keepdims=True)
        return np.where(is_blocked, before, after)

    def ranges(self, place: Floats, radius: Floats, angles: Floats) -> Floats:
        """``n × sensors``: metres from a robot's edge to what is nearest in each direction.

        Args:
            angles: ``n × sensors``, radians, of the room.
        """
        ray = np.stack([np.cos(angles), np.sin(angles)], axis=2)
        nearest = np.minimum(self._to_lines(place, ray), self._to_discs(place, radius, ray))
        return np.clip(nearest - radius[:, None], 0.0, RANGE_MAX_M)

    def _to_lines(self, place: Floats, ray: Floats) -> Floats:
        off = self._from - place[:, None, :]
        turned = ray[:, :, None, 0] * self._along[:, 1] - ray[:, :, None, 1] * self._along[:, 0]
        turned = np.where(np.abs(turned) < _PARALLEL, np.nan, turned)
        way = (off[:, :, 0] * self._along[:, 1] - off[:, :, 1] * self._along[:, 0])[:, None, :] / turned
        part = (off[:, None, :, 0] * ray[:, :, None, 1] - off[:, None, :, 1] * ray[:, :, None, 0]) / turned
        found: Floats = np.where((way >= 0) & (part >= 0) & (part <= 1), way, np.inf).min(axis=2)
        return found

    def _to_discs(self, place: Floats, radius: Floats, ray: Floats) -> Floats:
        off = np.concatenate([self._centre, place]) - place[:, None, :]
        width = np.concatenate([self._width, radius])
        along = (off[:, None, :, 0] * ray[:, :, None, 0]) + (off[:, None, :, 1] * ray[:, :, None, 1])
        rest = (off**2).sum(axis=2) - width**2
        count = len(place)
        rest[np.arange(count), len(self._centre) + np.arange(count)] = np.inf  # no robot sees itself
        square = along**2 - rest[:, None, :]
        way = np.where(rest[:, None, :] < 0, 0.0, along - np.sqrt(np.maximum(square, 0.0)))
        found: Floats = np.where((square >= 0) & (way >= 0), way, np.inf).min(axis=2, initial=np.inf)
        return found
