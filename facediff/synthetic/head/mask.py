"""A mask of the head: the skin of the face alone, in the number of vertices that scans have.

It is the head's front, smoothed twice by Catmull and Clark's rule ("Recursively generated B-spline surfaces", 1978).
The rule is linear, so that shapes of the head are shapes of the mask.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from facediff.synthetic.geometry import Array
from facediff.synthetic.head.layout import Index
from facediff.synthetic.head.parts import build_head

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_SKIN = ("skin", "mouth_far", "mouth_near", "lip_", "mouth_front", "eye_", "nostril")
_FRONT, _LOWEST = 30.0, -100.0  # Depth and height in mm from which on skin belongs to the mask
_LEVELS = 2
N_MASK_VERTICES = 23_550
"""Vertices of the mask, known without building it."""


@dataclass(frozen=True)
class Mask:
    """The topology of the mask.

    Attributes:
        operator: sparse factors (M, V) that turn values at the head's vertices into values at the mask's.
        faces: triangles, (F, 3).
        vertex_of: the mask's vertex at a vertex of the head, (V,); -1 where there is none.
    """

    operator: csr_array
    faces: Index
    vertex_of: Index

    def transfer(self, values: Array) -> Array:
        """Values (V, …) of the head's vertices at the mask's, (M, …)."""
        return np.asarray(self.operator @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])

    def region(self, index: Index) -> Index:
        """The mask's vertices in a region that is given by vertices of the head."""
        inside = np.zeros(self.operator.shape[1])
        inside[index] = 1.0
        return np.flatnonzero(self.operator @ inside > 0.5)


@lru_cache(maxsize=1)
def build_mask() -> Mask:
    """The mask of the average head; all masks have its topology."""
    from scipy.sparse import csr_array

    head = build_head()
    inside = np.zeros(len(head.vertices), dtype=bool)
    inside[head.both(*_SKIN)] = True
    inside[head.both("skin_shirt")] = False
    inside &= (head.vertices[:, 2] > _FRONT) & (head.vertices[:, 1] > _LOWEST)
    proper = np.array([len(set(quad)) == 4 for quad in head.quads.tolist()])
    quads = head.quads[inside[head.quads].all(axis=1) & proper]
    vertices, flat = np.unique(quads, return_inverse=True)
    quads = flat.reshape(quads.shape)
    ones = np.ones(len(vertices))
    operator = csr_array((ones, (np.arange(len(vertices)), vertices)), shape=(len(vertices), len(head.vertices)))
    for _ in range(_LEVELS):
        step, quads = _subdivided(quads, operator.shape[0])
        operator = step @ operator
    vertex_of = np.full(len(head.vertices), -1)
    vertex_of[vertices] = np.arange(len(vertices))
    return Mask(csr_array(operator), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), vertex_of)


def _subdivided(quads: Index, count: int) -> tuple[csr_array, Index]:
    """Factors of one step of the rule on a mesh of ``count`` vertices, and its quads.

    The old vertices keep their numbers; vertices of edges and faces follow.
    """
    from scipy.sparse import coo_array, csr_array, diags_array, vstack

    def factors(rows: Index, columns: Index, values: Array, shape: tuple[int, int]) -> csr_array:
        return csr_array(coo_array((values, (rows.ravel(), columns.ravel())), shape=shape))  # adds what is twice there

    sides = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1)  # (Q, 4, 2)
    edges, edge_of = np.unique(np.sort(sides.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(quads.shape)
    number, beside = len(quads), np.bincount(edge_of.ravel())
    face = factors(np.repeat(np.arange(number), 4), quads, np.full(4 * number, 0.25), (number, count))
    middle = factors(np.repeat(np.arange(len(edges)), 2), edges, np.full(2 * len(edges), 0.5), (len(edges), count))
    inner = beside == 2
    # An inner edge's point is the mean of its middle and of the mean of the faces next to it.
    next_to = factors(edge_of, np.repeat(np.arange(number), 4), np.full(4 * number, 0.5), (len(edges), number))
    edge = diags_array(np.where(inner, 0.5, 1.0)) @ middle + diags_array(np.where(inner, 0.5, 0.0)) @ (next_to @ face)
    # A vertex of n faces moves to (F + 2 E + (n - 3) V) / n, and one of the border to 3/4 V + 1/8 of both neighbours.
    valence = np.bincount(quads.ravel(), minlength=count)
    border = np.zeros(count, dtype=bool)
    border[edges[~inner]] = True
    faces_at = factors(quads, np.repeat(np.arange(number), 4), np.ones(4 * number), (count, number))
    at_edges, ends = np.repeat(np.arange(len(edges)), 2), edges.ravel()
    edges_at = factors(ends, at_edges, np.ones(len(ends)), (count, len(edges)))
    outer = np.repeat(~inner, 2)
    border_at = factors(ends[outer], at_edges[outer], np.ones(int(outer.sum())), (count, len(edges)))
    n = np.maximum(valence, 1.0)
    vertex_part = diags_array(np.where(border, 0.5, (n - 3.0) / n))
    mean_face = diags_array(np.where(border, 0.0, 1.0 / n**2)) @ (faces_at @ face)
    mean_edge = diags_array(np.where(border, 0.0, 2.0 / n**2)) @ (edges_at @ middle)
    vertex = vertex_part + mean_face + mean_edge + diags_array(np.where(border, 0.25, 0.0)) @ (border_at @ middle)
    centre = count + len(edges) + np.arange(number)
    corners = [
        np.stack([quads[:, i], count + edge_of[:, i], centre, count + edge_of[:, i - 1]], axis=1) for i in range(4)
    ]
    return csr_array(vstack([vertex, edge, face])), np.concatenate(corners)
