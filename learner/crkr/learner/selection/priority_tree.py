"""A compiled priority k-d tree: finds the nearest better sample, and the radii that a sample shrinks, in log n.

    x  (d,)  standardised state          r2  squared radius: distance to the suppressor, the nearest better sample
    c        cost                        d2  squared distance to x

Samples are in leaves of up to `SLOTS`. A node has the box of its samples and their lowest cost, which lets the search
for a better sample skip it; and their largest radius, which lets the search for radii that reach x skip it. Good
samples have large radii, but only radii of worse samples matter, so a node has one largest radius for the samples above
each of a few costs. A leaf is a row of blocks, large radii first; far from x only the first blocks are searched. A node
splits the widest side of its box, equal states by cost, and equal costs by age, so that no stream of samples
degenerates the tree. Where a path gets too long, the unbalanced subtree is rebuilt [Galperin1993].

Distances sum over dimensions in order, and box distances are rounded like sample distances: bounds are exact, and radii
equal those of `squared_distances` bit by bit. Among equally near better samples a costly one is the suppressor, so that
equal states form chains in which each suppresses few.

Needs numba (`pip install crkr[fast]`); compiling takes some seconds, once per machine. One file, because numba's cache
compares the time of one file only.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit

from crkr.protocol import Array

__all__ = ["BLOCK", "LEVELS", "SLOTS", "Tree", "build", "fill_radii", "insert", "link", "recost", "remove"]

SLOTS: Final = 256
BLOCK: Final = 32
LEVELS: Final = 8  # cost levels with a largest radius each
_PARTS: Final = SLOTS // BLOCK
_FILL: Final = 192  # samples in a new leaf
_DEEPEST: Final = 128  # longest path; the balance keeps it below 70
_UNBALANCED: Final = 0.7  # largest share of a node's samples in one child
_NONE: Final = -1

# Columns of `Tree.links`, `Tree.samples`, and entries of `Tree.counts`.
_PARENT, _CHILD, _LEAF, _COUNT, _AXIS = range(5)  # children are adjacent; _CHILD is the left one
_PLACE, _SUPPRESSOR, _FIRST, _NEXT, _PREVIOUS = range(5)  # linked lists of the samples that each suppresses
_NODES, _LEAVES, _FREE_PAIR, _FREE_LEAF, _MOST, _TOUCHED = range(6)


class Tree(NamedTuple):
    """Arrays of a tree; the root is node 0.

    Attributes:
        boxes: (nodes, 2 d + 3) lowest and highest coordinates, lowest and highest cost, place of the split.
        reaches: (nodes, LEVELS) largest r2 of samples from each level on.
        ranges: (leaves SLOTS / BLOCK, 3) largest r2, lowest and highest cost in a block.
        levels: (LEVELS,) costs, the first one -inf, ascending.
        links: (nodes, 5) parent, left child, leaf, number of samples, axis of the split.
        slots: (leaves SLOTS / BLOCK, d + 2, BLOCK) coordinates, costs and r2 of the samples in a block.
        numbers: (leaves, SLOTS + 2) numbers of the samples; their count; the leaf's node.
        samples: (n, 5) slot in all leaves, -1 for a removed sample; suppressor; first suppressed; list neighbours.
        r2: (n,) squared radii; -1: removed.
        counts: (6,) nodes and leaves used, free ones, most samples since the last build, how many were touched.
        touched: Numbers of samples whose radius was set since the last reset of `counts`, as many as fit.
    """

    boxes: Array
    reaches: Array
    ranges: Array
    levels: Array
    links: Any
    slots: Array
    numbers: Any
    samples: Any
    r2: Array
    counts: Any
    touched: Any


_compiled = njit(nogil=True, cache=True, error_model="numpy")
_unwrapped: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_inner = njit(nogil=True, error_model="numpy", **_unwrapped)


@_inner
def _box_distance(boxes, node, x):
    d = len(x)
    total = 0.0
    for axis in range(d):
        gap = max(boxes[node, axis] - x[axis], x[axis] - boxes[node, d + axis], 0.0)
        total += gap * gap
    return total


@_inner
def _distances(block, count, x, d2):
    """Squared distances of a block's samples to x, into d2."""
    for axis in range(len(x)):
        value, row = x[axis], block[axis]
        if axis == 0:
            for slot in range(count):
                gap = value - row[slot]
                d2[slot] = gap * gap
        else:
            for slot in range(count):
                gap = value - row[slot]
                d2[slot] += gap * gap


@_inner
def _include(tree, node, page, x, cost, r2):
    """Adds a sample to the bounds of its leaf's node, and to the ranges of its block."""
    d = len(x)
    box, reaches, ranges = tree.boxes[node], tree.reaches[node], tree.ranges[page]
    for axis in range(d):
        box[axis], box[d + axis] = min(box[axis], x[axis]), max(box[d + axis], x[axis])
    box[2 * d], box[2 * d + 1] = min(box[2 * d], cost), max(box[2 * d + 1], cost)
    ranges[0], ranges[1], ranges[2] = max(ranges[0], r2), min(ranges[1], cost), max(ranges[2], cost)
    level = LEVELS - 1
    while cost < tree.levels[level]:
        level -= 1
    while level >= 0 and reaches[level] < r2:  # the lower the level, the larger
        reaches[level] = r2
        level -= 1


@_inner
def _summarise(tree, node, d):
    """Recomputes the node's box, costs and reaches from its samples, and the ranges of their blocks."""
    leaf = tree.links[node, _LEAF]
    box, reaches = tree.boxes[node], tree.reaches[node]
    box[:d], box[d : 2 * d], box[2 * d], box[2 * d + 1] = np.inf, -np.inf, np.inf, -np.inf
    reaches[:] = 0.0
    for part in range(_PARTS):
        page = leaf * _PARTS + part
        block, ranges = tree.slots[page], tree.ranges[page]
        ranges[0], ranges[1], ranges[2] = 0.0, np.inf, -np.inf
        for slot in range(min(tree.numbers[leaf, SLOTS] - part * BLOCK, BLOCK)):
            _include(tree, node, page, block[:d, slot], block[d, slot], block[d + 1, slot])


@_inner
def _pull(tree, node, d):
    """The same from its children; returns whether anything changed."""
    child, boxes, reaches = tree.links[node, _CHILD], tree.boxes, tree.reaches
    changed = False
    for column in range(2 * d):
        left, right = boxes[child, column], boxes[child + 1, column]
        value = min(left, right) if column < d else max(left, right)
        if value != boxes[node, column]:
            boxes[node, column] = value
            changed = True
    for level in range(LEVELS):
        value = max(reaches[child, level], reaches[child + 1, level])
        if value != reaches[node, level]:
            reaches[node, level] = value
            changed = True
    lowest = min(boxes[child, 2 * d], boxes[child + 1, 2 * d])
    highest = max(boxes[child, 2 * d + 1], boxes[child + 1, 2 * d + 1])
    if lowest != boxes[node, 2 * d] or highest != boxes[node, 2 * d + 1]:
        boxes[node, 2 * d], boxes[node, 2 * d + 1] = lowest, highest
        changed = True
    return changed


@_inner
def _tighten(tree, node, d):
    """Recomputes a leaf's node, and those above."""
    _summarise(tree, node, d)
    _tell(tree, node, d)


@_inner
def _tell(tree, node, d):
    """Recomputes the nodes above a changed one, until one stays the same."""
    node = tree.links[node, _PARENT]
    while node >= 0 and _pull(tree, node, d):
        node = tree.links[node, _PARENT]


@_inner
def _touch(tree, number):
    place = tree.counts[_TOUCHED]
    if place < len(tree.touched):
        tree.touched[place] = number
    tree.counts[_TOUCHED] = place + 1


@_inner
def _set_suppressor(samples, number, suppressor):
    """Moves a sample from one suppressor's list to another's."""
    before, following = samples[number, _PREVIOUS], samples[number, _NEXT]
    old = samples[number, _SUPPRESSOR]
    if old >= 0:
        if before >= 0:
            samples[before, _NEXT] = following
        else:
            samples[old, _FIRST] = following
        if following >= 0:
            samples[following, _PREVIOUS] = before
    samples[number, _SUPPRESSOR], samples[number, _PREVIOUS], samples[number, _NEXT] = suppressor, _NONE, _NONE
    if suppressor >= 0:
        first = samples[suppressor, _FIRST]
        samples[number, _NEXT] = first
        if first >= 0:
            samples[first, _PREVIOUS] = number
        samples[suppressor, _FIRST] = number


@_inner
def _state(tree, number, x):
    """Writes the sample's state into x; returns its cost."""
    page, slot = divmod(tree.samples[number, _PLACE], BLOCK)
    for axis in range(len(x)):
        x[axis] = tree.slots[page, axis, slot]
    return tree.slots[page, len(x), slot]


@_inner
def _nearest_better(tree, x, cost, number, d2):
    """Squared distance to the nearest better sample, and its number; infinity and -1 without one.

    Among equally near children the right one comes first: its samples cost more where states are equal.
    """
    d = len(x)
    boxes, links = tree.boxes, tree.links
    waiting, gaps = np.empty(_DEEPEST, np.int32), np.empty(_DEEPEST)
    best, found, found_cost = np.inf, _NONE, -np.inf
    waiting[0], gaps[0] = 0, 0.0
    count = 1
    while count:
        count -= 1
        node, gap = waiting[count], gaps[count]
        if gap >= best or boxes[node, 2 * d] > cost:
            continue
        while links[node, _CHILD] >= 0:
            left = links[node, _CHILD]
            right = left + 1
            left_gap = _box_distance(boxes, left, x) if boxes[left, 2 * d] <= cost else np.inf
            right_gap = _box_distance(boxes, right, x) if boxes[right, 2 * d] <= cost else np.inf
            if left_gap < right_gap:
                node, gap, other, other_gap = left, left_gap, right, right_gap
            else:
                node, gap, other, other_gap = right, right_gap, left, left_gap
            if other_gap < best:
                waiting[count], gaps[count] = other, other_gap
                count += 1
            if not gap < best:
                node = _NONE
                break
        if node < 0:
            continue
        leaf = links[node, _LEAF]
        for part in range(_PARTS):
            page = leaf * _PARTS + part
            if tree.ranges[page, 1] > cost:
                continue
            count_here, costs = min(tree.numbers[leaf, SLOTS] - part * BLOCK, BLOCK), tree.slots[page, d]
            _distances(tree.slots[page], count_here, x, d2)
            hits = np.int64(0)
            for slot in range(count_here):
                hits += np.int64((d2[slot] <= best) & (costs[slot] <= cost))
            if not hits:
                continue
            for slot in range(count_here):
                if d2[slot] <= best and costs[slot] <= cost:
                    other = tree.numbers[leaf, part * BLOCK + slot]
                    if costs[slot] == cost and other >= number:
                        continue
                    if d2[slot] < best or costs[slot] > found_cost or (costs[slot] == found_cost and other > found):
                        best, found, found_cost = d2[slot], other, costs[slot]
    return best, found


@_inner
def _shrink_others(tree, x, cost, number, d2):
    """Makes this sample the suppressor of worse samples that are nearer to it than to theirs."""
    d = len(x)
    boxes, links = tree.boxes, tree.links
    level = 0
    while level + 1 < LEVELS and cost >= tree.levels[level + 1]:
        level += 1
    waiting = np.empty(_DEEPEST, np.int32)
    waiting[0] = 0
    count = 1
    while count:
        count -= 1
        node = waiting[count]
        gap = _box_distance(boxes, node, x)
        if boxes[node, 2 * d + 1] < cost or not gap < tree.reaches[node, level]:
            continue
        child = links[node, _CHILD]
        if child >= 0:
            waiting[count], waiting[count + 1] = child, child + 1
            count += 2
            continue
        leaf = links[node, _LEAF]
        changed = False
        for part in range(_PARTS):
            page = leaf * _PARTS + part
            if not gap < tree.ranges[page, 0] or tree.ranges[page, 2] < cost:
                continue
            block, count_here = tree.slots[page], min(tree.numbers[leaf, SLOTS] - part * BLOCK, BLOCK)
            costs, r2 = block[d], block[d + 1]
            _distances(block, count_here, x, d2)
            hits = np.int64(0)
            for slot in range(count_here):
                hits += np.int64((d2[slot] < r2[slot]) & (costs[slot] >= cost))
            if not hits:
                continue
            for slot in range(count_here):
                if d2[slot] < r2[slot] and costs[slot] >= cost:
                    other = tree.numbers[leaf, part * BLOCK + slot]
                    if other == number or (costs[slot] == cost and other < number):
                        continue
                    r2[slot] = tree.r2[other] = d2[slot]
                    _set_suppressor(tree.samples, other, number)
                    _touch(tree, other)
                    changed = True
        if changed:
            _tighten(tree, node, d)


@_inner
def _search(tree, number, x, d2):
    """Recomputes a sample's radius and suppressor."""
    cost = _state(tree, number, x)
    radius, suppressor = _nearest_better(tree, x, cost, number, d2)
    page, slot = divmod(tree.samples[number, _PLACE], BLOCK)
    tree.slots[page, len(x) + 1, slot] = tree.r2[number] = radius
    _set_suppressor(tree.samples, number, suppressor)
    _touch(tree, number)
    _tighten(tree, tree.numbers[page // _PARTS, SLOTS + 1], len(x))


@_inner
def _new_leaf(tree, node):
    leaf = tree.counts[_FREE_LEAF]
    if leaf >= 0:
        tree.counts[_FREE_LEAF] = tree.numbers[leaf, SLOTS + 1]
    else:
        leaf = tree.counts[_LEAVES]
        tree.counts[_LEAVES] = leaf + 1
    tree.numbers[leaf, SLOTS], tree.numbers[leaf, SLOTS + 1] = 0, node
    tree.links[node, _CHILD], tree.links[node, _LEAF] = _NONE, leaf
    return leaf


@_inner
def _new_pair(tree, parent):
    left = tree.counts[_FREE_PAIR]
    if left >= 0:
        tree.counts[_FREE_PAIR] = tree.links[left, _PARENT]
    else:
        left = tree.counts[_NODES]
        tree.counts[_NODES] = left + 2
    tree.links[left, _PARENT] = tree.links[left + 1, _PARENT] = parent
    tree.links[parent, _CHILD], tree.links[parent, _LEAF] = left, _NONE
    return left


@_inner
def _put(tree, leaf, number, x, cost, radius):
    slot, d = tree.numbers[leaf, SLOTS], len(x)
    page, place = leaf * _PARTS + slot // BLOCK, slot % BLOCK
    for axis in range(d):
        tree.slots[page, axis, place] = x[axis]
    tree.slots[page, d, place], tree.slots[page, d + 1, place] = cost, radius
    tree.numbers[leaf, slot] = number
    tree.numbers[leaf, SLOTS] = slot + 1
    tree.samples[number, _PLACE] = leaf * SLOTS + slot


@_inner
def _key(axis, x, cost, number):
    if axis < len(x):
        return x[axis]
    return cost if axis == len(x) else float(number)


@_inner
def _select(keys, order, start, middle, stop):
    """Reorders so that no key before `middle` is larger than one from there on."""
    low, high = start, stop - 1
    while low < high:
        pivot = keys[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while keys[i] < pivot:
                i += 1
            while pivot < keys[j]:
                j -= 1
            if i <= j:
                keys[i], keys[j] = keys[j], keys[i]
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@_inner
def _widest(Z, costs, order, start, stop):
    """The axis that splits these samples: d for costs, d + 1 for numbers."""
    d = Z.shape[1]
    widest, axis = 0.0, d + 1
    for column in range(d):
        low = high = Z[order[start], column]
        for row in range(start + 1, stop):
            value = Z[order[row], column]
            low, high = min(low, value), max(high, value)
        if high - low > widest:
            widest, axis = high - low, column
    if axis == d + 1:
        first = costs[order[start]]
        for row in range(start + 1, stop):
            if costs[order[row]] != first:
                return d
    return axis


@_inner
def _sort(tree, leaf, d):
    """Sorts a leaf's blocks by radius, the largest first."""
    pages, names = tree.slots[leaf * _PARTS : (leaf + 1) * _PARTS].copy(), tree.numbers[leaf].copy()
    filled = names[SLOTS]
    keys = np.empty(filled)
    for slot in range(filled):
        cost, r2 = pages[slot // BLOCK, d : d + 2, slot % BLOCK]
        keys[slot] = -r2 if r2 > 0 else cost
    for slot, old in enumerate(np.argsort(keys)):
        page, place, part, source = leaf * _PARTS + slot // BLOCK, slot % BLOCK, old // BLOCK, old % BLOCK
        for row in range(d + 2):
            tree.slots[page, row, place] = pages[part, row, source]
        tree.numbers[leaf, slot] = names[old]
        tree.samples[names[old], _PLACE] = leaf * SLOTS + slot


@_compiled
def build(tree, root, Z, costs, r2, numbers):
    """Builds a balanced subtree of samples under an empty node.

    Args:
        tree: With room for them.
        root: The node; its parents are updated.
        Z: (m, d) states.
        costs: (m,).
        r2: (m,) squared radii.
        numbers: (m,).
    """
    m, d = Z.shape
    order, keys = np.arange(m), np.empty(m)
    made = np.empty(m // 4 + 3, np.int32)
    made[0] = root
    nodes = 1
    waiting = np.empty((_DEEPEST, 3), np.int64)
    waiting[0, 0], waiting[0, 1], waiting[0, 2] = root, 0, m
    count = 1
    while count:
        count -= 1
        node, start, stop = waiting[count]
        tree.links[node, _COUNT] = stop - start
        if stop - start <= _FILL:
            leaf = _new_leaf(tree, node)
            for row in range(start, stop):
                index = order[row]
                _put(tree, leaf, numbers[index], Z[index], costs[index], r2[index])
            _sort(tree, leaf, d)
            continue
        axis = _widest(Z, costs, order, start, stop)
        for row in range(start, stop):
            index = order[row]
            keys[row] = _key(axis, Z[index], costs[index], numbers[index])
        middle = (start + stop) // 2
        _select(keys, order, start, middle, stop)
        left = _new_pair(tree, node)
        tree.links[node, _AXIS] = axis
        tree.boxes[node, 2 * d + 2] = keys[middle]
        for child in range(2):
            made[nodes] = left + child
            nodes += 1
            waiting[count, 0] = left + child
            waiting[count, 1] = middle if child else start
            waiting[count, 2] = stop if child else middle
            count += 1
    for place in range(nodes - 1, -1, -1):
        node = made[place]
        if tree.links[node, _CHILD] < 0:
            _summarise(tree, node, d)
        else:
            _pull(tree, node, d)
    _tell(tree, root, d)


@_inner
def _rebuild(tree, root, d):
    """Rebuilds a subtree; splits a full leaf."""
    m = tree.links[root, _COUNT]
    Z, costs, r2, numbers = np.empty((m, d)), np.empty(m), np.empty(m), np.empty(m, np.int64)
    waiting = np.empty(_DEEPEST, np.int32)
    waiting[0] = root
    count, row = 1, 0
    while count:
        count -= 1
        node = waiting[count]
        child, leaf = tree.links[node, _CHILD], tree.links[node, _LEAF]
        if child >= 0:
            waiting[count], waiting[count + 1] = child, child + 1
            count += 2
            tree.links[child, _PARENT] = tree.counts[_FREE_PAIR]  # links of a freed pair stay readable
            tree.counts[_FREE_PAIR] = child
            continue
        for slot in range(tree.numbers[leaf, SLOTS]):
            numbers[row] = tree.numbers[leaf, slot]
            costs[row], r2[row] = _state(tree, numbers[row], Z[row]), tree.r2[numbers[row]]
            row += 1
        tree.numbers[leaf, SLOTS + 1] = tree.counts[_FREE_LEAF]
        tree.counts[_FREE_LEAF] = leaf
    build(tree, root, Z, costs, r2, numbers)


@_inner
def _add(tree, number, x, cost, radius):
    """Adds a sample to its leaf, splits a full leaf, and keeps paths short."""
    d = len(x)
    node, depth = 0, 0
    while True:
        tree.links[node, _COUNT] += 1
        child = tree.links[node, _CHILD]
        if child < 0:
            if tree.numbers[tree.links[node, _LEAF], SLOTS] < SLOTS:
                break
            tree.links[node, _COUNT] -= 1
            _rebuild(tree, node, d)
            continue
        key = _key(tree.links[node, _AXIS], x, cost, number)
        node = child + 1 if key >= tree.boxes[node, 2 * d + 2] else child
        depth += 1
    _put(tree, tree.links[node, _LEAF], number, x, cost, radius)
    _include(tree, node, tree.samples[number, _PLACE] // BLOCK, x, cost, radius)
    _tell(tree, node, d)
    total = tree.links[0, _COUNT]
    tree.counts[_MOST] = max(tree.counts[_MOST], total)
    if depth > 3.0 + 1.95 * np.log2(1.0 + total / _FILL):
        while node > 0:
            parent = tree.links[node, _PARENT]
            if tree.links[node, _COUNT] > _UNBALANCED * tree.links[parent, _COUNT]:
                _rebuild(tree, parent, d)
                return
            node = parent


@_compiled
def insert(tree, first, Z, costs):
    """Adds samples numbered from `first`, one by one; the tree must have room for them."""
    d2 = np.empty(BLOCK)
    for row in range(len(costs)):
        number, x, cost = first + row, Z[row], costs[row]
        for column in range(5):
            tree.samples[number, column] = _NONE
        radius, suppressor = _nearest_better(tree, x, cost, number, d2)
        tree.r2[number] = radius
        _shrink_others(tree, x, cost, number, d2)
        _add(tree, number, x, cost, radius)
        _set_suppressor(tree.samples, number, suppressor)
        _touch(tree, number)


@_compiled
def remove(tree, numbers):
    """Removes samples; those they suppressed find other suppressors."""
    d = tree.slots.shape[1] - 2
    x, d2 = np.empty(d), np.empty(BLOCK)
    for number in numbers:
        leaf, slot = divmod(tree.samples[number, _PLACE], SLOTS)
        last = tree.numbers[leaf, SLOTS] - 1
        if slot != last:
            moved = tree.numbers[leaf, last]
            to, page = leaf * _PARTS + slot // BLOCK, leaf * _PARTS + last // BLOCK
            for row in range(d + 2):
                tree.slots[to, row, slot % BLOCK] = tree.slots[page, row, last % BLOCK]
            tree.numbers[leaf, slot] = moved
            tree.samples[moved, _PLACE] = leaf * SLOTS + slot
        tree.numbers[leaf, SLOTS] = last
        node = tree.numbers[leaf, SLOTS + 1]
        _tighten(tree, node, d)
        while node >= 0:
            tree.links[node, _COUNT] -= 1
            node = tree.links[node, _PARENT]
        _set_suppressor(tree.samples, number, _NONE)
        tree.samples[number, _PLACE], tree.r2[number] = _NONE, -1.0
        _touch(tree, number)
        while tree.samples[number, _FIRST] >= 0:
            _search(tree, tree.samples[number, _FIRST], x, d2)
    if 2 * tree.links[0, _COUNT] < tree.counts[_MOST]:
        _rebuild(tree, 0, d)
        tree.counts[_MOST] = tree.links[0, _COUNT]


@_compiled
def recost(tree, numbers, costs):
    """Changes costs, one by one."""
    d = tree.slots.shape[1] - 2
    x, d2 = np.empty(d), np.empty(BLOCK)
    for row in range(len(numbers)):
        number, cost = numbers[row], costs[row]
        page, slot = divmod(tree.samples[number, _PLACE], BLOCK)
        tree.slots[page, d, slot] = cost
        _tighten(tree, tree.numbers[page // _PARTS, SLOTS + 1], d)
        other = tree.samples[number, _FIRST]
        while other >= 0:
            following = tree.samples[other, _NEXT]
            theirs = _state(tree, other, x)
            if theirs < cost or (theirs == cost and other < number):
                _search(tree, other, x, d2)
            other = following
        _search(tree, number, x, d2)
        _state(tree, number, x)
        _shrink_others(tree, x, cost, number, d2)


@_compiled
def fill_radii(tree, first, last):
    """Computes all radii of the samples in leaves `first` to `last`, exclusive, which have none yet."""
    d = tree.slots.shape[1] - 2
    x, d2 = np.empty(d), np.empty(BLOCK)
    for leaf in range(first, last):
        for slot in range(tree.numbers[leaf, SLOTS]):
            number = tree.numbers[leaf, slot]
            cost = _state(tree, number, x)
            radius, suppressor = _nearest_better(tree, x, cost, number, d2)
            tree.slots[leaf * _PARTS + slot // BLOCK, d + 1, slot % BLOCK] = tree.r2[number] = radius
            _set_suppressor(tree.samples, number, suppressor)
        _sort(tree, leaf, d)
        _tighten(tree, tree.numbers[leaf, SLOTS + 1], d)


@_compiled
def link(tree, numbers, suppressors):
    """Sets suppressors (m,) of samples (m,) that have none; -1: none."""
    for row in range(len(numbers)):
        _set_suppressor(tree.samples, numbers[row], suppressors[row])
