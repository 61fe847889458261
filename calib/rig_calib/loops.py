"""Loops in the graph of used edges."""

from collections import defaultdict, deque
from collections.abc import Sequence

Pair = tuple[int, int]


def closing_cycle(pairs: Sequence[Pair]) -> list[int] | None:
    """The longest loop that one edge closes over a breadth-first tree; in a ring, the ring; None without."""
    neighbours: dict[int, list[int]] = defaultdict(list)
    for i, j in sorted(pairs):
        neighbours[i].append(j)
        neighbours[j].append(i)
    if not neighbours:
        return None
    parent = _tree(neighbours, min(neighbours))
    cycles = [
        _cycle(parent, i, j) for i, j in sorted(pairs) if i in parent and parent[i] != j and parent[j] != i
    ]
    return max(cycles, key=len, default=None)


def _tree(neighbours: dict[int, list[int]], root: int) -> dict[int, int]:
    """Parent of every node that the root reaches; the root is its own."""
    parent, queue = {root: root}, deque([root])
    while queue:
        node = queue.popleft()
        for other in neighbours[node]:
            if other not in parent:
                parent[other] = node
                queue.append(other)
    return parent


def _cycle(parent: dict[int, int], i: int, j: int) -> list[int]:
    up_i, up_j = _ancestors(parent, i), _ancestors(parent, j)
    meeting = next(node for node in up_i if node in up_j)
    down = up_j[: up_j.index(meeting)]
    return up_i[: up_i.index(meeting) + 1] + down[::-1]


def _ancestors(parent: dict[int, int], node: int) -> list[int]:
    line = [node]
    while parent[line[-1]] != line[-1]:
        line.append(parent[line[-1]])
    return line
