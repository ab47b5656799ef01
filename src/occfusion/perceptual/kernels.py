"""Compiled loops over chosen positions of maps that are known elsewhere (`surround.Map`).

Positions are those of the whole map, whatever part of it is held in memory. Channels come in groups of `LANES`: the
numbers of a group have an axis of their own, so that the compiler sees that an index into them is never negative.
Positions are loaded, and tiles transformed, in the text of the kernels: helpers that are given arrays took two to four
times as long.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from occfusion.cpu.compilation import inline, kernel

LANES = 64
"""Channels handled at a time: all positions of a tile then fit the first cache."""
SIDE = 6
"""Side of the tile that a convolution reads for 4 x 4 results."""
SPACE = SIDE * SIDE * LANES
"""Numbers of working space for a thread."""
ROW = SIDE * LANES
_0, _2, _4, _5, _8 = (np.float32(value) for value in (0, 2, 4, 5, 8))
_HALF, _QUARTER = np.float32(0.5), np.float32(0.25)


@inline
def forward(d0: Any, d1: Any, d2: Any, d3: Any, d4: Any, d5: Any) -> tuple[Any, ...]:
    """Returns B^T d (`winograd`)."""
    even, odd = d4 - _4 * d2, d3 - _4 * d1
    near, far = d4 - d2, _2 * (d3 - d1)
    return (
        _4 * d0 - _5 * d2 + d4, even + odd, even - odd, near + far, near - far, _4 * d1 - _5 * d3 + d5,
    )  # fmt: skip


@inline
def backward(d0: Any, d1: Any, d2: Any, d3: Any, d4: Any, d5: Any) -> tuple[Any, ...]:
    """Returns A^T d (`winograd`)."""
    p, q, r, s = d1 + d2, d1 - d2, d3 + d4, d3 - d4
    return d0 + p + r, q + _2 * s, p + _4 * r, q + _8 * s + d5


@kernel
def transform_tiles(
    values: Any, chosen: Any, known: Any, rows: Any, columns: Any, corner: Any,
    tiles: Any, result: Any, spaces: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes B^T D B of each tile's input D, `result` `[36, T or more, C/LANES, LANES]`.

    Args:
        values: the part of the map that is held, `[N, h, w, C/LANES, LANES]`.
        chosen: where it counts, bool `[h, w]`.
        known: what every picture has elsewhere, `[h', w', C/LANES, LANES]`.
        rows: for each row of the whole map one of `known`, int64 `[H]`.
        columns: the same for columns, `[W]`.
        corner: row and column of the part that is held, int64 `[2]`.
        tiles: picture, row and column of each tile's first result, int64 `[T, 3]`.
        result: written.
        spaces: working space `[threads, SPACE]`.
        part: which tiles: every `parts`-th from this one.
        parts: among how many threads they are dealt out.
    """
    space, lanes = spaces[part], values.shape[4]  # not a constant: a short loop would be unrolled
    for t in range(part, len(tiles), parts):
        n = tiles[t, 0]
        for g in range(values.shape[3]):
            for i in range(SIDE):
                for j in range(SIDE):
                    o = (SIDE * i + j) * LANES
                    y, x = tiles[t, 1] - 1 + i, tiles[t, 2] - 1 + j
                    if y < 0 or y >= len(rows) or x < 0 or x >= len(columns):
                        for c in range(lanes):
                            space[o + c] = _0
                        continue
                    a, b = y - corner[0], x - corner[1]
                    if 0 <= a < chosen.shape[0] and 0 <= b < chosen.shape[1] and chosen[a, b]:
                        for c in range(lanes):
                            space[o + c] = values[n, a, b, g, c]
                    else:
                        a, b = rows[y], columns[x]
                        for c in range(lanes):
                            space[o + c] = known[a, b, g, c]
            for j in range(SIDE):
                for c in range(LANES):
                    o = j * LANES + c
                    e0, e1, e2, e3, e4, e5 = forward(
                        space[o], space[o + ROW], space[o + 2 * ROW],
                        space[o + 3 * ROW], space[o + 4 * ROW], space[o + 5 * ROW],
                    )  # fmt: skip
                    space[o] = e0
                    space[o + ROW] = e1
                    space[o + 2 * ROW] = e2
                    space[o + 3 * ROW] = e3
                    space[o + 4 * ROW] = e4
                    space[o + 5 * ROW] = e5
            for i in range(SIDE):
                for c in range(LANES):
                    o = i * ROW + c
                    e0, e1, e2, e3, e4, e5 = forward(
                        space[o], space[o + LANES], space[o + 2 * LANES],
                        space[o + 3 * LANES], space[o + 4 * LANES], space[o + 5 * LANES],
                    )  # fmt: skip
                    space[o] = e0
                    space[o + LANES] = e1
                    space[o + 2 * LANES] = e2
                    space[o + 3 * LANES] = e3
                    space[o + 4 * LANES] = e4
                    space[o + 5 * LANES] = e5
            for k in range(SIDE * SIDE):
                for c in range(lanes):
                    result[k, t, g, c] = space[k * LANES + c]


@kernel
def finish_tiles(
    products: Any, tiles: Any, bias: Any, corner: Any, out: Any, spaces: Any, part: int, parts: int
) -> None:
    """Writes A^T M A + bias of each tile, rectified, into the part `out` of a map.

    Args:
        products: M, `[36, T or more, K/LANES, LANES]`.
        tiles: as in `transform_tiles`.
        bias: `[K/LANES, LANES]`.
        corner: row and column of `out`, int64 `[2]`.
        out: `[N, h, w, K/LANES, LANES]`; results outside it are dropped.
        spaces: working space `[threads, SPACE]`.
        part: which tiles: every `parts`-th from this one.
        parts: among how many threads they are dealt out.
    """
    space, lanes = spaces[part], out.shape[4]
    for t in range(part, len(tiles), parts):
        n, y, x = tiles[t, 0], tiles[t, 1] - corner[0], tiles[t, 2] - corner[1]
        for g in range(out.shape[3]):
            for k in range(SIDE * SIDE):
                for c in range(lanes):
                    space[k * LANES + c] = products[k, t, g, c]
            for j in range(SIDE):
                for c in range(LANES):
                    o = j * LANES + c
                    e0, e1, e2, e3 = backward(
                        space[o], space[o + ROW], space[o + 2 * ROW],
                        space[o + 3 * ROW], space[o + 4 * ROW], space[o + 5 * ROW],
                    )  # fmt: skip
                    space[o] = e0
                    space[o + ROW] = e1
                    space[o + 2 * ROW] = e2
                    space[o + 3 * ROW] = e3
            for i in range(4):
                for c in range(LANES):
                    o = i * ROW + c
                    e0, e1, e2, e3 = backward(
                        space[o], space[o + LANES], space[o + 2 * LANES],
                        space[o + 3 * LANES], space[o + 4 * LANES], space[o + 5 * LANES],
                    )  # fmt: skip
                    space[o] = e0
                    space[o + LANES] = e1
                    space[o + 2 * LANES] = e2
                    space[o + 3 * LANES] = e3
            for i in range(min(4, out.shape[1] - y)):
                for j in range(min(4, out.shape[2] - x)):
                    o = (SIDE * i + j) * LANES
                    for c in range(lanes):
                        out[n, y + i, x + j, g, c] = max(space[o + c] + bias[g, c], _0)


@inline
def blur(a: Any, b: Any, c: Any) -> Any:
    """Returns the binomial mean of three values."""
    return _QUARTER * (a + c) + _HALF * b


@kernel
def pool_places(
    values: Any, chosen: Any, known: Any, rows: Any, columns: Any, corner: Any,
    places: Any, y_reads: Any, x_reads: Any, out_corner: Any, out: Any, spaces: Any, part: int, parts: int,
) -> None:  # fmt: skip
    """Writes binomial means of 3x3 maxima of 2x2 positions each.

    Args:
        values: this and what follows it as in `transform_tiles`.
        chosen: see there.
        known: see there.
        rows: see there.
        columns: see there.
        corner: see there.
        places: row and column of the results that are wanted, int64 `[P, 2]`.
        y_reads: for each row of the results the rows of its maxima, two for each, int64 `[H', 6]`.
        x_reads: the same for columns.
        out_corner: row and column of `out` in the result's map, int64 `[2]`.
        out: written, `[N, h, w, C/LANES, LANES]`.
        spaces: working space `[threads, SPACE]`.
        part: which places: every `parts`-th from this one.
        parts: among how many threads they are dealt out.
    """
    space, lanes = spaces[part], out.shape[4]
    for p in range(part, len(places), parts):
        for n in range(out.shape[0]):
            for g in range(out.shape[3]):
                for i in range(SIDE):
                    for j in range(SIDE):
                        o = (SIDE * i + j) * LANES
                        y, x = y_reads[places[p, 0], i], x_reads[places[p, 1], j]
                        if y < 0 or y >= len(rows) or x < 0 or x >= len(columns):
                            for c in range(lanes):
                                space[o + c] = _0
                            continue
                        a, b = y - corner[0], x - corner[1]
                        if 0 <= a < chosen.shape[0] and 0 <= b < chosen.shape[1] and chosen[a, b]:
                            for c in range(lanes):
                                space[o + c] = values[n, a, b, g, c]
                        else:
                            a, b = rows[y], columns[x]
                            for c in range(lanes):
                                space[o + c] = known[a, b, g, c]
                # each column of three maxima is blurred, then the three of them
                for j in range(0, SIDE, 2):
                    for c in range(LANES):
                        o = j * LANES + c
                        a = max(max(space[o], space[o + LANES]), max(space[o + ROW], space[o + ROW + LANES]))
                        o += 2 * ROW
                        b = max(max(space[o], space[o + LANES]), max(space[o + ROW], space[o + ROW + LANES]))
                        o += 2 * ROW
                        d = max(max(space[o], space[o + LANES]), max(space[o + ROW], space[o + ROW + LANES]))
                        space[j * LANES + c] = blur(a, b, d)
                i, j = places[p, 0] - out_corner[0], places[p, 1] - out_corner[1]
                for c in range(lanes):
                    out[n, i, j, g, c] = blur(space[c], space[2 * LANES + c], space[4 * LANES + c])


@kernel
def sum_distances(
    values: Any, chosen: Any, head: Any, floor: float, sums: Any, spaces: Any, part: int, parts: int
) -> None:
    """Adds sum_c w_c (a_c/|a| - b_c/|b|)^2 of two pictures' features at every chosen position.

    Args:
        values: the pictures, `[2, h, w, C/LANES, LANES]`.
        chosen: bool `[h, w]`.
        head: w, `[C/LANES, LANES]`.
        floor: is added to the squared lengths.
        sums: float64 `[h]`, one for each row; written.
        spaces: working space `[threads, SPACE]`.
        part: which rows: every `parts`-th from this one.
        parts: among how many threads they are dealt out.
    """
    lanes, line = values.shape[4], spaces[part]
    for i in range(part, values.shape[1], parts):
        sums[i] = 0.0
        for j in range(values.shape[2]):
            if not chosen[i, j]:
                continue
            # lane by lane: sums in one variable would be added up one after the other
            for c in range(2 * lanes):
                line[c] = _0
            for g in range(values.shape[3]):
                for c in range(lanes):
                    a, b = values[0, i, j, g, c], values[1, i, j, g, c]
                    line[c] += a * a
                    line[LANES + c] += b * b
            aa = bb = floor
            for c in range(lanes):
                aa += line[c]
                bb += line[LANES + c]
                line[c] = _0
            a_scale, b_scale = 1 / np.sqrt(aa), 1 / np.sqrt(bb)
            for g in range(values.shape[3]):
                for c in range(lanes):
                    difference = values[0, i, j, g, c] * a_scale - values[1, i, j, g, c] * b_scale
                    line[c] += head[g, c] * difference * difference
            for c in range(lanes):
                sums[i] += line[c]
