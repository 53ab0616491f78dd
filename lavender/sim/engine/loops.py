"""Find the joints of a scene that are in closed loops."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable

import numpy as np


def find_loop_joints(ends: Iterable[tuple[int, int]], rigid: Iterable[bool]) -> np.ndarray:
    """Find the rigid joints on a closed path of bodies and rigid joints.

    Parameters
    ----------
    ends : iterable of (int, int)
        The two bodies of each joint; -1 is the world.
    rigid : iterable of bool
        Which joints are rigid. The others do not belong to a loop.

    Returns
    -------
    ndarray of bool, shape (kj,)
        Whether each joint is in a loop.
    """
    ends = [(int(a), int(b)) for a, b in ends]
    rigid = list(rigid)
    joints_of: dict[int, list[int]] = defaultdict(list)
    for joint, pair in enumerate(ends):
        if rigid[joint]:
            for body in pair:
                joints_of[body].append(joint)
    # A tree of joints from each first body; `above` has the joint and the body towards it.
    above: dict[int, tuple[int, int]] = {}
    depth: dict[int, int] = {}
    for root in joints_of:
        if root in depth:
            continue
        depth[root] = 0
        queue = deque([root])
        while queue:
            body = queue.popleft()
            for joint in joints_of[body]:
                other = sum(ends[joint]) - body
                if other not in depth:
                    depth[other] = depth[body] + 1
                    above[other] = joint, body
                    queue.append(other)
    # Each joint outside the trees closes a loop with the joints of the trees between its bodies. The bodies of a loop
    # are then one, `top` of each being the body of the loop next to the root, so that each joint is visited once.
    top = {body: body for body in depth}

    def find_top(body: int) -> int:
        while top[body] != body:
            top[body] = body = top[top[body]]
        return body

    in_tree = {joint for joint, _ in above.values()}
    looped = np.zeros(len(ends), bool)
    for joint, (a, b) in enumerate(ends):
        if not rigid[joint] or joint in in_tree:
            continue
        looped[joint] = True
        a, b = find_top(a), find_top(b)
        while a != b:
            if depth[a] < depth[b]:
                a, b = b, a
            upward, body = above[a]
            looped[upward] = True
            top[a] = body
            a = find_top(body)
    return looped
