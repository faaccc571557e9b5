"""Vertices in spatially compact blocks: the unit that the evaluator walks over."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class VertexBlocks:
    """A design's vertices, reordered so that each block is compact in space, with arrays for the passes over them.

    Attributes:
        X: [d, n] coordinates, contiguous per axis.
        W: [n] square roots of the weights.
        g: [k, n] gradient times W.
        starts: [blocks + 1] int64: block i holds the columns starts[i] to starts[i + 1].
        low, high: [blocks, d] bounding boxes.
    """

    X: Tensor
    W: Tensor
    g: Tensor
    starts: Tensor
    low: Tensor
    high: Tensor

    def __len__(self) -> int:
        return self.starts.shape[0] - 1


def vertex_blocks(vertices: Tensor, gradient: Tensor, weights: Tensor, size: int) -> VertexBlocks:
    """Cut vertices [n, d] into blocks of at most `size` by halving the longest axis; all but one block are full."""
    points = vertices.detach().cpu().numpy()
    parts: list[np.ndarray] = []
    pending = [np.arange(len(points))]
    while pending:
        part = pending.pop()
        count = -(-len(part) // size)
        if count <= 1:
            parts.append(part)
            continue
        left = (count // 2) * size
        axis = np.ptp(points[part], axis=0).argmax()
        ordered = part[np.argpartition(points[part, axis], left - 1)]
        pending += [ordered[left:], ordered[:left]]
    order = torch.from_numpy(np.concatenate(parts)).to(vertices.device)
    starts = np.cumsum([0] + [len(part) for part in parts])
    roots = weights.sqrt()[order]
    return VertexBlocks(
        X=vertices[order].T.contiguous(),
        W=roots.contiguous(),
        g=(gradient[order] * roots[:, None]).T.contiguous(),
        starts=torch.from_numpy(starts),
        low=torch.from_numpy(np.stack([points[part].min(0) for part in parts])),
        high=torch.from_numpy(np.stack([points[part].max(0) for part in parts])),
    )
