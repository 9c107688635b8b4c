"""The least of the distances of a peg's vertices to a part, as `bcppl.geometry.gap.vertices`, by Warp."""

from __future__ import annotations

import warp as wp

from bcppl.geometry.gap.vertices import NEAR

FAR = wp.constant(1e6)  # m
SURFACE = wp.constant(1e-7)  # m, up to which the direction to the closest point is rounding
STEEPEST = wp.constant(3.0**0.5)  # slope of an interpolated distance, at most
NEAREST = wp.constant(NEAR)


@wp.struct
class Grid:
    """As `distance_grid.DistanceGrid`."""

    low: wp.vec3
    spacing: float
    distance: wp.array3d[float]
    inexact: wp.array3d[float]


@wp.struct
class Bodies:
    """A part's mesh, grid and sharp edges, and a peg's vertices and convex solids, in their own frames."""

    mesh: wp.uint64
    grid: Grid
    corners: wp.array[wp.vec3]
    stops: wp.array[int]
    spheres: wp.array[wp.vec4]
    planes: wp.array[wp.vec4]
    ends: wp.array[int]
    lowest: wp.vec3
    highest: wp.vec3
    edge_ends: wp.array2d[wp.vec3]
    edge_spheres: wp.array[wp.vec4]
    edge_groups: wp.array[wp.vec4]
    edge_stops: wp.array[int]


@wp.struct
class Closest:
    """A signed distance, the witness point, and the outward unit normal there."""

    distance: float
    point: wp.vec3
    normal: wp.vec3


@wp.func  # type: ignore[untyped-decorator]
def center_of(sphere: wp.vec4) -> wp.vec3:
    """The middle of a sphere."""
    return wp.vec3(sphere[0], sphere[1], sphere[2])


@wp.func  # type: ignore[untyped-decorator]
def _cell(at: float, low: float, spacing: float, count: int) -> wp.vec3:
    """The cell of a coordinate on an axis of the grid, the share of it below, and how far beyond the grid."""
    place = (at - low) / spacing
    inside = wp.clamp(place, 0.0, float(count - 1))
    first = wp.min(wp.floor(inside), float(count - 2))
    return wp.vec3(first, inside - first, wp.abs(place - inside))


@wp.func  # type: ignore[untyped-decorator]
def _gradient(grid: Grid, i: int, j: int, k: int, a: float, b: float, c: float) -> wp.vec4:
    """The interpolated distance in a cell, m by spacing, and then its derivatives."""
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for corner in range(8):
        x = corner / 4
        y = (corner / 2) % 2
        z = corner % 2
        wa = wp.where(x == 1, a, 1.0 - a)
        wb = wp.where(y == 1, b, 1.0 - b)
        wc = wp.where(z == 1, c, 1.0 - c)
        here = grid.distance[i + x, j + y, k + z]
        total += here * wp.vec4(
            wa * wb * wc, float(2 * x - 1) * wb * wc, float(2 * y - 1) * wa * wc, float(2 * z - 1) * wa * wb
        )
    return total


@wp.func  # type: ignore[untyped-decorator]
def _looked_up(grid: Grid, point: wp.vec3) -> wp.vec2:
    """The interpolated distance at a point, and how far off it may be, m."""
    u = _cell(point[0], grid.low[0], grid.spacing, grid.distance.shape[0])
    v = _cell(point[1], grid.low[1], grid.spacing, grid.distance.shape[1])
    w = _cell(point[2], grid.low[2], grid.spacing, grid.distance.shape[2])
    i, j, k = int(u[0]), int(v[0]), int(w[0])
    inside = _gradient(grid, i, j, k, u[1], v[1], w[1])[0]
    return wp.vec2(inside + (u[2] + v[2] + w[2]) * grid.spacing, grid.inexact[i, j, k])


@wp.func  # type: ignore[untyped-decorator]
def _slope(grid: Grid, point: wp.vec3) -> wp.vec3:
    """The unit gradient of the interpolated distance at a point."""
    u = _cell(point[0], grid.low[0], grid.spacing, grid.distance.shape[0])
    v = _cell(point[1], grid.low[1], grid.spacing, grid.distance.shape[1])
    w = _cell(point[2], grid.low[2], grid.spacing, grid.distance.shape[2])
    along = _gradient(grid, int(u[0]), int(v[0]), int(w[0]), u[1], v[1], w[1])
    return wp.normalize(wp.vec3(along[1], along[2], along[3]))


@wp.func  # type: ignore[untyped-decorator]
def _exact(mesh: wp.uint64, point: wp.vec3, known: wp.vec2) -> Closest:
    """The distance of a point by the mesh, given what the grid has there."""
    found = Closest()
    query = wp.mesh_query_point_no_sign(mesh, point, FAR)
    on_part = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    away = wp.length(point - on_part)
    sign = wp.sign(known[0])
    if wp.abs(known[0]) <= known[1]:
        sign = wp.mesh_query_point_sign_winding_number(mesh, point, FAR).sign
    found.distance = sign * away
    found.point = point
    found.normal = wp.mesh_eval_face_normal(mesh, query.face)
    if away > SURFACE:
        found.normal = (point - on_part) / found.distance
    return found


@wp.func  # type: ignore[untyped-decorator]
def of_vertices(bodies: Bodies, turn: wp.mat33, shift: wp.vec3) -> Closest:
    """As `vertices.by_vertices`."""
    grid = bodies.grid
    best = Closest()
    best.distance = FAR
    # The group that is closest comes first, so that hardly any other has to be looked into.
    first = wp.int32(0)
    nearest = wp.float32(FAR)
    for g in range(bodies.spheres.shape[0]):
        ball = bodies.spheres[g]
        bound = _looked_up(grid, turn * center_of(ball) + shift)[0] - STEEPEST * ball[3]
        if bound < nearest:
            first = g
            nearest = bound
    # By the grid: the least distance; the least of what distances are at most; the least that is exact; and
    # the one that may be the least of those that are not.
    least = wp.float32(FAR)
    most = wp.float32(FAR)
    closest = wp.int32(-1)
    exact = wp.int32(-1)
    of_exact = wp.float32(FAR)
    candidate = wp.int32(-1)
    of_candidate = wp.float32(FAR)
    for r in range(bodies.spheres.shape[0] + 1):
        g = wp.where(r == 0, first, r - 1)
        ball = bodies.spheres[g]
        if r > 0:
            if g == first:
                continue
            bound = _looked_up(grid, turn * center_of(ball) + shift)[0] - STEEPEST * ball[3]
            if bound > least and (least >= NEAREST or bound - grid.spacing >= most):
                continue
        begin = wp.int32(0)
        if g > 0:
            begin = bodies.stops[g - 1]
        for c in range(begin, bodies.stops[g]):
            here = _looked_up(grid, turn * bodies.corners[c] + shift)
            if here[0] < least:
                least = here[0]
                closest = c
            most = wp.min(most, here[0] + here[1])
            if here[1] == 0.0:
                if here[0] < of_exact:
                    of_exact = here[0]
                    exact = c
            elif here[0] - here[1] < of_candidate:
                of_candidate = here[0] - here[1]
                candidate = c
    near = wp.abs(least) < NEAREST
    if near:
        closest = exact
        least = of_exact
    if closest >= 0:
        best.distance = least
        best.point = turn * bodies.corners[closest] + shift
        best.normal = _slope(grid, best.point)
    if not near or of_candidate >= wp.min(best.distance, most):
        return best
    point = turn * bodies.corners[candidate] + shift
    other = _exact(bodies.mesh, point, _looked_up(grid, point))
    if other.distance < best.distance:
        best = other
    for g in range(bodies.spheres.shape[0]):
        ball = bodies.spheres[g]
        bound = _looked_up(grid, turn * center_of(ball) + shift)[0] - STEEPEST * ball[3]
        if bound - grid.spacing >= best.distance:
            continue
        begin = wp.int32(0)
        if g > 0:
            begin = bodies.stops[g - 1]
        for c in range(begin, bodies.stops[g]):
            if c == candidate:
                continue
            point = turn * bodies.corners[c] + shift
            here = _looked_up(grid, point)
            if here[1] > 0.0 and here[0] - here[1] < best.distance:
                other = _exact(bodies.mesh, point, here)
                if other.distance < best.distance:
                    best = other
    return best
