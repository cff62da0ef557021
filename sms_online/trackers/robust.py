"""Covariance of π̂ that holds where the errors of neighbouring rows are correlated.

Errors of an energy balance are integrals and last for many rows; the covariance from the rows' std takes them for
independent and is too small. The cluster-robust (sandwich) covariance cuts the rows into clusters of consecutive rows,
long against the correlation of the errors, and takes each cluster's summed score s_c = Y_cᵀ(b_c − Y_c π̂) as one
independent draw: Λ⁻¹ (Σ s_c s_cᵀ) Λ⁻¹ with Λ = YᵀY. Source: Liang and Zeger, Biometrika 73 (1986) 13–22.

The scores need the final π̂, so each cluster is kept as its rows, or as their triangular factor where they are many:
s_c = R_cᵀ(z_c − R_c π̂) exactly, and two neighbours merge by one QR. The Gram form YᵀY would add more cheaply but loses
the residual at condition numbers above 1e4, since Λ⁻¹ then amplifies its rounding by the condition number squared.

Limitations: valid for plain least squares only. With forgetting, the weights of old rows express drift of π rather than
noise, and no residual shows how far π has drifted. Errors must be uncorrelated over a cluster's length; in short runs
(fewer than a few dozen clusters) intervals are somewhat too narrow.
"""

from __future__ import annotations

import msgspec
import numpy as np

from sms_online.state import State
from sms_online.stream import Array
from sms_online.trackers.factor import Solution, reduced

# Enough clusters for a 16 x 16 matrix of scores with 6 % scatter of its std; they cost 0.6 MB at n = 16. Even.
MAX_CLUSTERS = 256


class ClusterFactors(State):
    """Consecutive clusters of blocks of rows; when they become too many, neighbours merge and the length doubles.

    closed: clusters as `reduced` rows. length: blocks of a cluster. unfinished: the last one, of so many blocks so far.
    """

    unfinished: Array
    closed: list[Array] = msgspec.field(default_factory=list)
    length: int = 1
    blocks: int = 0

    @staticmethod
    def none(n: int) -> ClusterFactors:
        """Clusters of no rows of n parameters."""
        return ClusterFactors(np.zeros((0, n + 1)))

    def add(self, block: Array) -> None:
        """Take in the rows of the next block, as many as in every other."""
        self.unfinished = reduced(np.concatenate((self.unfinished, block)))
        self.blocks += 1
        if self.blocks < self.length:
            return
        self.closed.append(self.unfinished)
        self.blocks, self.unfinished = 0, self.unfinished[:0]
        if len(self.closed) == MAX_CLUSTERS:
            self.closed = list(merge_neighbours(np.array(self.closed), 2))
            self.length *= 2

    def stack(self, pending: Array) -> Array:
        """All clusters (C, k, n + 1), filled up with zeros; the pending rows belong to the unfinished last one."""
        every = [*self.closed, reduced(np.concatenate((self.unfinished, pending)))]
        out = np.zeros((len(every), max(map(len, every)), pending.shape[1]))
        for own, cluster in zip(out, every, strict=True):
            own[: len(cluster)] = cluster
        return out


def merge_neighbours(factors: Array, group: int) -> Array:
    """Factors (C, k, n + 1) merged in runs of `group`, the last run possibly shorter: (⌈C/group⌉, ·, n + 1)."""
    count, k, n1 = factors.shape
    groups = -(-count // group)
    padded = np.zeros((groups * group, k, n1))
    padded[:count] = factors
    return np.asarray(np.linalg.qr(padded.reshape(groups, group * k, n1), mode="r"))


def cluster_covariance(
    solution: Solution, clusters: Array, prior: Array, rows: float, scale: float = 1.0
) -> Array | None:
    """Cluster-robust covariance (n, n) of a least-squares solution; None while clusters are too few to span it.

    clusters: (C, k, n + 1) factors of all measured rows, before these were divided by `scale`. prior: (k, n + 1)
    information rows, which keep their stated std. rows: number of measured rows. Small-sample factor
    C/(C − 1)·(M − 1)/(M − rank): Cameron and Miller, J. Human Resources 50 (2015) 317–372, section II.
    """
    count, n = int(np.count_nonzero(clusters.any(axis=(1, 2)))), solution.pi.size
    if count <= solution.rank or rows <= solution.rank:
        return None
    R = clusters[:, :, :n]
    residual = clusters[:, :, n] - R @ solution.pi
    score = (residual[:, None, :] @ R)[:, 0, :] @ solution.root / scale**2  # (C, rank)
    weighted_prior = prior[:, :n] @ solution.root
    factor = count / (count - 1) * (rows - 1) / (rows - solution.rank)
    return solution.covariance(factor * (score.T @ score) + weighted_prior.T @ weighted_prior)
