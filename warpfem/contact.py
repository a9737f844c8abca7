"""Contact of boundary points with fixed obstacles: a penalty for depth, and Coulomb friction.

A point at depth g below an obstacle's surface has the energy k A g^2 / 2 for its share A of each of its faces, a part
of the rest surface, that lies along the obstacle's surface; k is the stiffness [Pa/m], so that a pressure p rests at
the depth p / k. Steep faces, as the sides of a block that has sunk in, bear nothing: with them, meshes so fine that
they have points within that depth would move in another way than coarser ones. What is much deeper, as where a body
too soft to stand flows round what holds it, bears with all its faces:

    U = sum over faces and their points of k A (c g^2 + (1 - c) s(g)) / 2,

where c goes from 1 to 0 with the angle between face and surface, see ``STEEP``, and s(g) is 0 up to g_0, 2 (g - g_0)^2
up to 2 g_0, and g^2 - 2 g_0^2 beyond; g_0 is such that surfaces do not wrinkle, see ``SPARED``. Forces are -dU/dx with
all its terms, so that energy is conserved; the stiffness leaves out what turns faces. Faces of bodies of linear
elasticity, which knows small strains alone, keep their directions at rest. On a :class:`Box`, whose surface has edges
where its direction jumps, all faces bear, c = 1.

In implicit steps friction is the smoothed Coulomb law of Li et al. 2020 (Incremental Potential Contact,
section 5): below ``slip_speed`` it falls off quadratically, so that a point that ought to stick creeps, slower
than ``slip_speed``. Its limit and normal are those of a Newton iterate near the last, so that the converged
step obeys mu times the normal force of the same step. A step of one linear solve makes it a drag. In explicit
steps it is an impulse that stops the tangential motion, up to mu times the normal impulse.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import warp as wp

from warpfem.boundary import Box, BoxWalls, Obstacle, Plane, Sphere
from warpfem.dtypes import types
from warpfem.launches import Launcher
from warpfem.scene import Body

STOPPING_DEPTH = 0.25
"""Part of a body's thickness within which the default stiffness stops it, from the speed that it starts with and
gains as it falls."""

FLAT, STEEP = 0.5, 0.93
"""Squared sines of the angle between a face and an obstacle's surface up to which all of the face bears, and from which
on nothing: 46 and 80 degrees, with ``SMALL``."""

SMALL = 0.2
"""Part of its area at rest below which a face has no direction to speak of: an upright one begins to bear below 0.7 of
its area, and does so fully at 0.2."""

SPARED = 0.5
"""The most energy that a face would save by standing upright, k g_0^2 per area, over what deforms the body there, its
P-wave modulus times the size of its cells (the largest and the mean of a body): with more of it, surfaces that are
pressed on deeply would wrinkle."""

BOX_STOPPING_DEPTH = 0.125
"""Part of a box's least size within which its default stiffness stops a body: half of the way to its core."""


@functools.cache
def place_type(dim: int, dtype: str) -> type:
    """The structure by which kernels find the boundary faces and points, and what each has of one obstacle."""
    t = types(dim, dtype)

    @wp.struct
    class Places:
        """The boundary as one obstacle meets it.

        Attributes:
            faces: (f, j) the boundary points of each face.
            shares: (f, j) what they have of its area [m^2].
            edges: (f, dim - 1) its edges from the first corner at rest [m].
            follows: (f,) 1, or 0 where a face keeps its direction at rest.
            points: (k,) the points of the model that the boundary points are.
            origin: (k,) their places at rest from the obstacle's [m].
            pressure_rate: (k,) the stiffness [Pa/m].
            spared_depth: (k,) g_0 [m].
        """

        faces: wp.array2d(dtype=wp.int32)
        shares: wp.array2d(dtype=t.scalar)
        edges: wp.array2d(dtype=t.vector)
        follows: wp.array(dtype=t.scalar)
        points: wp.array(dtype=wp.int32)
        origin: wp.array(dtype=t.vector)
        pressure_rate: wp.array(dtype=t.scalar)
        spared_depth: wp.array(dtype=t.scalar)

    return Places


@functools.cache
def contact_kernels(kind: type, dim: int, dtype: str) -> SimpleNamespace:
    """The kernels for one kind of obstacle, :class:`Plane`, :class:`Sphere` or :class:`Box`.

    They take the obstacle as ``form``: the plane's normal, the sphere's radius or the box's :attr:`Box.shape`; and as
    ``origin`` each surface point's rest place relative to its foot on the plane or to the obstacle's centre.
    """
    t = types(dim, dtype)
    vector, matrix, scalar = t.vector, t.matrix, t.scalar
    places = place_type(dim, dtype)
    module = f"warpfem.contact_{kind.__name__.lower()}_{dim}_{dtype}"

    if kind is Plane:
        form_type = vector

        @wp.func
        def surface(y: vector, form: vector):
            return wp.dot(form, y), form, scalar(0.0)

    elif kind is Sphere:
        form_type = scalar

        @wp.func
        def surface(y: vector, form: scalar):
            distance = wp.length(y)
            normal = vector()
            normal[1] = scalar(1.0)
            curvature = scalar(0.0)
            if distance > scalar(0.0):
                curvature = scalar(1.0) / distance
                normal = curvature * y
            return distance - form, normal, curvature

        @wp.func
        def core_entry(y: vector, p: vector, form: scalar):
            core = scalar(0.5) * form
            # |y + s p|^2 = core^2 at s = c / (b + sqrt(b^2 - a c)), b = -y . p > 0
            b = -wp.dot(y, p)
            c = wp.dot(y, y) - core * core
            discriminant = b * b - wp.dot(p, p) * c
            entry = scalar(-1.0)
            if c > scalar(0.0) and b > scalar(0.0) and discriminant > scalar(0.0):
                entry = c / (b + wp.sqrt(discriminant))
            return entry

    else:
        form_type = matrix

        @wp.func
        def surface(y: vector, form: matrix):
            place = form * y
            gap = scalar(0.0)
            normal = vector()
            for i in range(dim):
                row = form[i]
                scale = scalar(1.0) / wp.length(row)
                own = (wp.abs(place[i]) - scalar(1.0)) * scale
                if i == 0 or own > gap:
                    gap = own
                    normal = (wp.sign(place[i]) * scale) * row
            return gap, normal, scalar(0.0)

        @wp.func
        def core_entry(y: vector, p: vector, form: matrix):
            # between the planes place_i = -1/2 and 1/2 from ``enter`` to ``leave``, for all i at once
            place = form * y
            way = form * p
            half = scalar(0.5)
            enter = scalar(0.0)
            leave = scalar(wp.inf)
            for i in range(dim):
                if way[i] != scalar(0.0):
                    one = (-half - place[i]) / way[i]
                    other = (half - place[i]) / way[i]
                    enter = wp.max(enter, wp.min(one, other))
                    leave = wp.min(leave, wp.max(one, other))
                elif wp.abs(place[i]) > half:
                    leave = scalar(-1.0)
            if enter > leave or enter == scalar(0.0):
                enter = scalar(-1.0)
            return enter

    @wp.func
    def slip_weight(slip: scalar, limit: scalar):
        """f1(slip) / slip and f1'(slip) of the smoothed Coulomb law f1 = 2 s/l - (s/l)^2, 1 above l."""
        one = scalar(1.0)
        two = scalar(2.0)
        if slip < limit:
            return (two - slip / limit) / limit, two * (one - slip / limit) / limit
        return one / slip, scalar(0.0)

    if dim == 2:

        @wp.func
        def area_vector(f: int, at: places, u: wp.array(dtype=vector)):
            """A face's area vector now, a vector of its length at rest, and the edges from its first corner."""
            rest = at.edges[f, 0]
            along = rest + at.follows[f] * (u[at.points[at.faces[f, 1]]] - u[at.points[at.faces[f, 0]]])
            return vector(along[1], -along[0]), rest, along, along

        @wp.func
        def turn(f: int, at: places, one: vector, other: vector, slope: vector, force_out: wp.array(dtype=vector)):
            """Adds the forces on the corners of a face for the slope of its energy in its area vector."""
            force = vector(slope[1], -slope[0])
            force_out[at.points[at.faces[f, 1]]] += force
            force_out[at.points[at.faces[f, 0]]] -= force

    else:

        @wp.func
        def area_vector(f: int, at: places, u: wp.array(dtype=vector)):
            start = u[at.points[at.faces[f, 0]]]
            one = at.edges[f, 0] + at.follows[f] * (u[at.points[at.faces[f, 1]]] - start)
            other = at.edges[f, 1] + at.follows[f] * (u[at.points[at.faces[f, 2]]] - start)
            return wp.cross(one, other), wp.cross(at.edges[f, 0], at.edges[f, 1]), one, other

        @wp.func
        def turn(f: int, at: places, one: vector, other: vector, slope: vector, force_out: wp.array(dtype=vector)):
            first = wp.cross(slope, other)
            second = wp.cross(one, slope)
            force_out[at.points[at.faces[f, 1]]] += first
            force_out[at.points[at.faces[f, 2]]] += second
            force_out[at.points[at.faces[f, 0]]] -= first + second

    @wp.func
    def direction(area: vector, rest: vector):
        """That of a face's area vector, less than a unit vector where little of the area at rest is left."""
        small = scalar(SMALL)
        inverse = scalar(1.0) / wp.sqrt(wp.length_sq(area) + small * small * wp.length_sq(rest))
        return inverse * area, inverse

    if kind is Box:

        @wp.func
        def flatness(outward: vector, normal: vector):
            return scalar(1.0), scalar(0.0)

    else:

        @wp.func
        def flatness(outward: vector, normal: vector):
            """c, and its slope in the squared sine."""
            across = wp.dot(outward, normal)
            width = scalar(STEEP) - scalar(FLAT)
            s = (scalar(STEEP) - (wp.length_sq(outward) - across * across)) / width
            s = wp.clamp(s, scalar(0.0), scalar(1.0))
            return s * s * (scalar(3.0) - scalar(2.0) * s), scalar(-6.0) * s * (scalar(1.0) - s) / width

    @wp.func
    def steep_square(g: scalar, deep: scalar):
        """s(g), half its slope, and half its curvature."""
        two = scalar(2.0)
        if g <= deep:
            return scalar(0.0), scalar(0.0), scalar(0.0)
        if g < two * deep:
            return two * (g - deep) * (g - deep), two * (g - deep), two
        return g * g - two * deep * deep, g, scalar(1.0)

    @wp.func
    def press(k: int, outward: vector, at: places, form: form_type, u: wp.array(dtype=vector)):
        """c g^2 + (1 - c) s(g) of a point of a face, half its slope, half its curvature, all 0 outside; the normal."""
        gap, normal, _curvature = surface(at.origin[k] + u[at.points[k]], form)
        if gap >= scalar(0.0):
            return scalar(0.0), scalar(0.0), scalar(0.0), normal
        c, _change = flatness(outward, normal)
        square, steep, rate = steep_square(-gap, at.spared_depth[k])
        other = scalar(1.0) - c
        return c * gap * gap + other * square, -c * gap + other * steep, c + other * rate, normal

    @wp.kernel(module=module, enable_backward=False)
    def friction_limit(
        at: places,
        form: form_type,
        friction: scalar,
        u: wp.array(dtype=vector),
        magnitude_out: wp.array(dtype=scalar),
        normal_out: wp.array(dtype=vector),
    ):
        """Adds to the largest friction of each point, mu times its normal force; writes its normal."""
        f = wp.tid()
        area, rest, _one, _other = area_vector(f, at, u)
        outward, _inverse = direction(area, rest)
        for j in range(at.faces.shape[1]):
            k = at.faces[f, j]
            _square, bearing, _rate, normal = press(k, outward, at, form, u)
            if bearing > scalar(0.0):
                magnitude_out[k] += friction * at.pressure_rate[k] * at.shares[f, j] * bearing
                normal_out[k] = normal

    @wp.kernel(module=module, enable_backward=False)
    def contact_energy(
        at: places,
        form: form_type,
        u: wp.array(dtype=vector),
        energy_out: wp.array(dtype=wp.float64),
    ):
        """Adds U to ``energy_out[0]``."""
        f = wp.tid()
        area, rest, _one, _other = area_vector(f, at, u)
        outward, _inverse = direction(area, rest)
        for j in range(at.faces.shape[1]):
            k = at.faces[f, j]
            square, _bearing, _rate, _normal = press(k, outward, at, form, u)
            if square > scalar(0.0):
                wp.atomic_add(energy_out, 0, wp.float64(scalar(0.5) * at.pressure_rate[k] * at.shares[f, j] * square))

    @wp.kernel(module=module, enable_backward=False)
    def contact_force(
        at: places,
        form: form_type,
        u: wp.array(dtype=vector),
        force_out: wp.array(dtype=vector),
    ):
        """Adds -dU/dx: the normal forces, and what turns steep faces."""
        f = wp.tid()
        area, rest, one, other = area_vector(f, at, u)
        outward, inverse = direction(area, rest)
        slope = vector()
        for j in range(at.faces.shape[1]):
            k = at.faces[f, j]
            i = at.points[k]
            gap, normal, curvature = surface(at.origin[k] + u[i], form)
            if gap < scalar(0.0):
                c, change = flatness(outward, normal)
                square, steep, _rate = steep_square(-gap, at.spared_depth[k])
                stiffness = at.pressure_rate[k] * at.shares[f, j]
                bearing = (-c * gap + (scalar(1.0) - c) * steep) * normal
                if change != scalar(0.0):
                    turning = (gap * gap - square) * change
                    across = wp.dot(outward, normal)
                    along = outward - across * normal
                    bearing += (turning * curvature * across) * along
                    slope += (at.follows[f] * stiffness * turning * inverse) * (along - wp.length_sq(along) * outward)
                force_out[i] += stiffness * bearing
        if wp.length_sq(slope) > scalar(0.0):
            turn(f, at, one, other, slope, force_out)

    @wp.kernel(module=module, enable_backward=False)
    def contact_blocks(
        at: places,
        form: form_type,
        u: wp.array(dtype=vector),
        blocks_out: wp.array(dtype=matrix),
    ):
        """Adds the stiffness of the normal forces along the normals, k A n n^T where a face bears, to the blocks."""
        f = wp.tid()
        area, rest, _one, _other = area_vector(f, at, u)
        outward, _inverse = direction(area, rest)
        for j in range(at.faces.shape[1]):
            k = at.faces[f, j]
            _square, _bearing, rate, normal = press(k, outward, at, form, u)
            if rate > scalar(0.0):
                stiffness = at.pressure_rate[k] * at.shares[f, j] * rate
                blocks_out[at.points[k]] += stiffness * wp.outer(normal, normal)

    core_limit = None
    if kind is not Plane:

        @wp.kernel(module=module, enable_backward=False)
        def core_limit(
            points: wp.array(dtype=wp.int32),
            origin: wp.array(dtype=vector),
            form: form_type,
            u: wp.array(dtype=vector),
            p: wp.array(dtype=vector),
            limit_out: wp.array(dtype=scalar),
        ):
            """Lowers ``limit_out[0]`` to the least s > 0 at which u + s p takes a point outside of the core into it.

            The core is the obstacle at half its size.
            """
            k = wp.tid()
            i = points[k]
            entry = core_entry(origin[k] + u[i], p[i], form)
            if entry > scalar(0.0):
                wp.atomic_min(limit_out, 0, entry)

    @wp.func
    def slip_of(u: vector, u_start: vector, normal: vector):
        s = u - u_start
        return s - wp.dot(s, normal) * normal

    @wp.kernel(module=module, enable_backward=False)
    def friction_energy(
        points: wp.array(dtype=wp.int32),
        magnitude: wp.array(dtype=scalar),
        normal: wp.array(dtype=vector),
        u_start: wp.array(dtype=vector),
        slip_limit: scalar,
        u: wp.array(dtype=vector),
        energy_out: wp.array(dtype=wp.float64),
    ):
        """Adds the dissipation potential; ``magnitude`` is the friction limit."""
        k = wp.tid()
        if magnitude[k] > scalar(0.0):
            i = points[k]
            slip = wp.length(slip_of(u[i], u_start[i], normal[k]))
            value = slip - slip_limit / scalar(3.0)
            if slip < slip_limit:
                value = slip * slip * (scalar(1.0) - slip / (scalar(3.0) * slip_limit)) / slip_limit
            wp.atomic_add(energy_out, 0, wp.float64(magnitude[k] * value))

    @wp.kernel(module=module, enable_backward=False)
    def friction_force(
        points: wp.array(dtype=wp.int32),
        magnitude: wp.array(dtype=scalar),
        normal: wp.array(dtype=vector),
        u_start: wp.array(dtype=vector),
        slip_limit: scalar,
        u: wp.array(dtype=vector),
        force_out: wp.array(dtype=vector),
    ):
        """Adds the friction of a step from ``u_start`` to ``u``."""
        k = wp.tid()
        if magnitude[k] > scalar(0.0):
            i = points[k]
            s = slip_of(u[i], u_start[i], normal[k])
            weight, _slope = slip_weight(wp.length(s), slip_limit)
            force_out[i] += (-magnitude[k] * weight) * s

    @wp.kernel(module=module, enable_backward=False)
    def friction_blocks(
        points: wp.array(dtype=wp.int32),
        magnitude: wp.array(dtype=scalar),
        normal: wp.array(dtype=vector),
        u_start: wp.array(dtype=vector),
        slip_limit: scalar,
        u: wp.array(dtype=vector),
        blocks_out: wp.array(dtype=matrix),
    ):
        """Adds the second derivative of the dissipation potential to each point's block."""
        k = wp.tid()
        if magnitude[k] > scalar(0.0):
            i = points[k]
            s = slip_of(u[i], u_start[i], normal[k])
            slip = wp.length(s)
            weight, slope = slip_weight(slip, slip_limit)
            n = normal[k]
            block = weight * (wp.identity(n=dim, dtype=scalar) - wp.outer(n, n))
            if slip > scalar(0.0):
                block += ((slope - weight) / (slip * slip)) * wp.outer(s, s)
            blocks_out[i] += magnitude[k] * block

    @wp.kernel(module=module, enable_backward=False)
    def friction_drag(
        points: wp.array(dtype=wp.int32),
        normal: wp.array(dtype=vector),
        u_start: wp.array(dtype=vector),
        slip_limit: scalar,
        u_expected: wp.array(dtype=vector),
        magnitude_out: wp.array(dtype=scalar),
    ):
        """Lowers the limit so that the law's slope at rest, 2/l, gives the limit itself at the expected slip."""
        k = wp.tid()
        i = points[k]
        slip = scalar(2.0) * wp.length(slip_of(u_expected[i], u_start[i], normal[k]))
        if slip > slip_limit:
            magnitude_out[k] *= slip_limit / slip

    @wp.kernel(module=module, enable_backward=False)
    def friction_impulse(
        points: wp.array(dtype=wp.int32),
        magnitude: wp.array(dtype=scalar),
        normal: wp.array(dtype=vector),
        inverse_mass: wp.array(dtype=scalar),
        dt: scalar,
        v_out: wp.array(dtype=vector),
    ):
        """Slows the tangential velocity by up to dt ``magnitude`` / m."""
        k = wp.tid()
        if magnitude[k] > scalar(0.0):
            i = points[k]
            v = v_out[i]
            tangential = v - wp.dot(v, normal[k]) * normal[k]
            speed = wp.length(tangential)
            if speed > scalar(0.0):
                drop = wp.min(dt * magnitude[k] * inverse_mass[i], speed)
                v_out[i] = v - (drop / speed) * tangential

    return SimpleNamespace(
        friction_limit=friction_limit,
        contact_energy=contact_energy,
        contact_force=contact_force,
        contact_blocks=contact_blocks,
        core_limit=core_limit,
        friction_energy=friction_energy,
        friction_force=friction_force,
        friction_blocks=friction_blocks,
        friction_drag=friction_drag,
        friction_impulse=friction_impulse,
    )


class _ObstacleContact:
    """One half-space, sphere or box against all surface points."""

    def __init__(self, obstacle: Plane | Sphere | Box, surface: "ContactSurface", dtype: str) -> None:
        dim = surface.rest.shape[1]
        t = types(dim, dtype)
        self.kernels = contact_kernels(type(obstacle), dim, dtype)
        self.obstacle = obstacle
        self.friction = obstacle.friction
        self.device = surface.device
        self.count = len(surface.rest)
        self.points = surface.arrays["points"]
        if isinstance(obstacle, Plane):
            form: wp.vec3 | wp.mat33 | float = t.vector(*obstacle.normal)
            n = np.array(obstacle.normal)
            origin = np.outer((surface.rest - np.array(obstacle.point)) @ n, n)  # the rest would cost digits
            outward = n
        else:
            origin = surface.rest - np.array(obstacle.center)
            if isinstance(obstacle, Sphere):
                form = t.scalar(obstacle.radius)
                outward = origin / np.maximum(np.linalg.norm(origin, axis=1, keepdims=True), obstacle.radius)
            else:
                form = t.matrix(*obstacle.shape.ravel())
                places = origin @ np.array(obstacle.axes).T
                nearest = np.argmax(np.abs(places) - 0.5 * np.array(obstacle.size), axis=1)[:, None]
                outward = np.sign(np.take_along_axis(places, nearest, 1)) * np.array(obstacle.axes)[nearest[:, 0]]
        approach = np.maximum(-(surface.velocity * outward).sum(axis=1), 0.0)
        height = np.maximum(self._gap(obstacle, surface.rest), 0.0) + surface.stopping_depth
        fall = np.maximum(-(surface.gravity * outward).sum(axis=-1), 0.0) * height
        speed = np.sqrt(approach**2 + 2.0 * fall)
        default = np.maximum(surface.stiffness, surface.stopping * speed**2)
        if isinstance(obstacle, Box):
            default = np.maximum(default, surface.box_stiffness(obstacle, outward, speed))
        pressure_rate = default if obstacle.stiffness is None else obstacle.stiffness
        self.form = form
        self.origin = wp.array(origin, dtype=t.vector, device=self.device)
        rates = np.broadcast_to(pressure_rate, self.count)  # Pa/m
        self.host_stiffness = (
            2.0 * rates * surface.areas
        )  # N/m; between g_0 and 2 g_0 steep faces are twice as stiff as beyond
        self.pressure_rate = wp.array(rates, dtype=t.scalar, device=self.device)
        self._launch = Launcher(self.device)
        self._face_count = surface.arrays["faces"].shape[0]
        spared_depth = np.sqrt(SPARED * np.maximum(surface.resistance, 0.0) / np.maximum(rates, np.finfo(float).tiny))
        self._spared_depth = wp.array(spared_depth, dtype=t.scalar, device=self.device)
        self._places = place_type(dim, dtype)()
        for name, array in surface.arrays.items():
            setattr(self._places, name, array)
        self._places.origin, self._places.pressure_rate, self._places.spared_depth = (
            self.origin,
            self.pressure_rate,
            self._spared_depth,
        )
        if self.friction > 0.0:
            self.magnitude = wp.zeros(self.count, dtype=t.scalar, device=self.device)
            self.normal = wp.zeros(self.count, dtype=t.vector, device=self.device)

    @staticmethod
    def _gap(obstacle: Plane | Sphere | Box, x: np.ndarray) -> np.ndarray:
        """The distance of points from an obstacle, negative inside [m]; from a box at least."""
        if isinstance(obstacle, Plane):
            return (x - np.array(obstacle.point)) @ np.array(obstacle.normal)
        if isinstance(obstacle, Box):
            places = (x - np.array(obstacle.center)) @ np.array(obstacle.axes).T
            return (np.abs(places) - 0.5 * np.array(obstacle.size)).max(axis=1)
        return np.linalg.norm(x - np.array(obstacle.center), axis=1) - obstacle.radius

    def depth(self, x: np.ndarray) -> float:
        """The greatest depth of points inside the obstacle [m], negative if all are outside."""
        return float(-self._gap(self.obstacle, x).min())

    def arrays(self) -> list[wp.array]:
        own = [self.origin, self.pressure_rate, self._spared_depth]
        return [*own, self.magnitude, self.normal] if self.friction > 0.0 else own

    def launch(self, name: str, inputs: list, outputs: list) -> None:
        """Launches a kernel for each point."""
        self._launch(getattr(self.kernels, name), self.count, inputs, outputs)

    def launch_faces(self, name: str, inputs: list, outputs: list) -> None:
        """Launches a kernel of the penalty for each face."""
        arguments = [self._places, self.form, *inputs]
        self._launch(getattr(self.kernels, name), self._face_count, arguments, outputs)

    def limit_friction(self, u: wp.array) -> None:
        """Takes the friction limits, mu times the normal forces, and the normals at ``u``."""
        self.magnitude.zero_()
        self.launch_faces("friction_limit", [self.friction, u], [self.magnitude, self.normal])


class ContactSurface:
    """The boundary points of all bodies with their rest places, faces, initial velocities and default stiffness.

    ``stopping`` times v^2 + 2 g h is the stiffness [Pa/m] that stops a body within ``STOPPING_DEPTH``, which starts
    towards an obstacle at the speed v and falls on it from the height h: per area, k d^2 / 2 = rho L (v^2 / 2 + g h)
    for a body of thickness L that hits with all its mass; h counts the depth d. ``impedance`` is rho c for P-waves of
    speed c [kg/(m^2 s)], ``resistance`` their modulus times the size of cells [N/m]. ``areas`` are what points have of
    all their faces [m^2]. Faces are shared as mass is: the corners of quadratic ones, to which a uniform pressure gives
    no force, must bear something too. ``arrays`` are those of kernels' :func:`place_type` that all obstacles have in
    common.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        starts: Sequence[int],
        p_wave: Sequence[float],
        gravity: Sequence[float] | None,
        dtype: str,
        device,
    ) -> None:
        rest, points, stiffness, resistance, velocity, stopping, depth, impedance = [], [], [], [], [], [], [], []
        faces, shares, edges, follows, count = [], [], [], [], 0
        widest = max(body.mesh.boundary_faces.shape[1] for body in bodies)
        for body, start, modulus in zip(bodies, starts, p_wave, strict=True):
            mesh = body.mesh
            rest.append(mesh.points[mesh.boundary_points])
            points.append(start + mesh.boundary_points)
            own = np.searchsorted(mesh.boundary_points, mesh.boundary_faces)
            padding = ((0, 0), (0, widest - own.shape[1]))
            faces.append(count + np.pad(own, padding, mode="edge"))
            shares.append(np.pad(np.outer(mesh.boundary_face_areas, mesh.shape.face.mass_shares), padding))
            corners = mesh.points[mesh.boundary_faces[:, : mesh.dim]]
            edges.append(corners[:, 1:] - corners[:, :1])
            follows.append(np.full(len(own), 0.0 if body.material.constitutive.small_strain else 1.0))
            count += len(mesh.boundary_points)
            stiffness.append(np.full(len(mesh.boundary_points), modulus / mesh.mean_edge_length))
            resistance.append(np.full(len(mesh.boundary_points), modulus * mesh.mean_edge_length))
            velocity.append(body.initial_velocity()[mesh.boundary_points])
            thickness = float(np.ptp(mesh.bounding_box, axis=0).min())
            inertia = np.max(body.density) / (STOPPING_DEPTH**2 * thickness)
            stopping.append(np.full(len(mesh.boundary_points), inertia))
            depth.append(np.full(len(mesh.boundary_points), STOPPING_DEPTH * thickness))
            impedance.append(np.full(len(mesh.boundary_points), np.sqrt(np.max(body.density) * modulus)))
        self.device = device
        self.gravity = np.zeros(bodies[0].mesh.dim) if gravity is None else np.asarray(gravity, dtype=np.float64)
        self.stopping_depth = np.concatenate(depth)
        self.rest = np.concatenate(rest)
        self.host_points = np.concatenate(points)
        host_faces, host_shares = np.concatenate(faces), np.concatenate(shares)
        self.areas = np.bincount(host_faces.ravel(), host_shares.ravel())
        t = types(self.rest.shape[1], dtype)
        self.arrays = {
            "faces": wp.array(host_faces, dtype=wp.int32, device=device),
            "shares": wp.array(host_shares, dtype=t.scalar, device=device),
            "edges": wp.array(np.concatenate(edges), dtype=t.vector, device=device),
            "follows": wp.array(np.concatenate(follows), dtype=t.scalar, device=device),
            "points": wp.array(self.host_points, dtype=wp.int32, device=device),
        }
        self.stiffness = np.concatenate(stiffness)
        self.resistance = np.concatenate(resistance)
        self.velocity = np.concatenate(velocity)
        self.stopping = np.concatenate(stopping)
        self.impedance = np.concatenate(impedance)

    def box_stiffness(self, box: Box, outward: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """The stiffness [Pa/m] that stops points within ``BOX_STOPPING_DEPTH``: from a thin box they come out behind.

        What is asked for is the least of two bounds: a rigid body gives all its energy to the penalty; one that
        deforms meets it with the pressure of its P-waves, rho c v (Achenbach 1973), and twice its weight.

        Args:
            box: the box.
            outward: (k, dim) its outward normals at the points.
            speed: (k,) with which they meet it [m/s].
        """
        depth = BOX_STOPPING_DEPTH * min(box.size)
        inertia = self.stopping * self.stopping_depth**2  # rho L
        weight = inertia * np.maximum(-(self.gravity * outward).sum(axis=1), 0.0)
        rigid = inertia * speed**2 / depth**2
        return np.minimum(rigid, self.impedance * speed / depth) + 2.0 * weight / depth


class Contact:
    """All obstacles of a scene.

    Attributes:
        slip_speed: speed below which implicit friction is smoothed [m/s].
    """

    def __init__(self, obstacles: Sequence[Obstacle], surface: ContactSurface, slip_speed: float, dtype: str) -> None:
        self.surface = surface
        self.slip_speed = slip_speed
        self.parts: list[_ObstacleContact] = []
        self._host_stiffness = np.zeros(len(surface.rest))
        for obstacle in obstacles:
            single = obstacle.planes() if isinstance(obstacle, BoxWalls) else [obstacle]
            self.parts += [_ObstacleContact(one, surface, dtype) for one in single]
            # once for the walls of a box: those that a point can touch together are perpendicular
            self._host_stiffness += self.parts[-1].host_stiffness
        self._rough = [part for part in self.parts if part.friction > 0.0]
        self._solids = [part for part in self.parts if not isinstance(part.obstacle, Plane)]

    @property
    def limits_steps(self) -> bool:
        """Whether there is an obstacle that a point could cross in one step and leave on the other side."""
        return bool(self._solids)

    @property
    def rough(self) -> bool:
        """Whether any obstacle has friction."""
        return bool(self._rough)

    def arrays(self) -> list[wp.array]:
        """The device arrays held."""
        return [*self.surface.arrays.values(), *(array for part in self.parts for array in part.arrays())]

    def largest_stiffness_over_mass(self, mass: np.ndarray) -> float:
        """An upper bound of the squared angular frequency [1/s^2] that the normal forces add.

        What turns steep faces is left out: where they are deep it can be more, but hardly more than that of cells.
        """
        return float((self._host_stiffness / mass[self.surface.host_points]).max())

    def depth(self, u: np.ndarray) -> float:
        """The greatest depth of penetration [m] at the displacements ``u`` (n, dim); 0 without contact."""
        x = self.surface.rest + u[self.surface.host_points]
        return max(0.0, *(part.depth(x) for part in self.parts))

    def add_energy(self, u: wp.array, energy_out: wp.array) -> None:
        """Adds the penalty energy to ``energy_out[0]``."""
        for part in self.parts:
            part.launch_faces("contact_energy", [u], [energy_out])

    def add_force(self, u: wp.array, force_out: wp.array) -> None:
        """Adds -dU/dx of the penalty: the normal forces, and what turns steep faces."""
        for part in self.parts:
            part.launch_faces("contact_force", [u], [force_out])

    def add_blocks(self, u: wp.array, blocks_out: wp.array) -> None:
        """Adds each point's stiffness along the normal to its d x d block; the rest of d2U/dx2 is left out."""
        for part in self.parts:
            part.launch_faces("contact_blocks", [u], [blocks_out])

    def limit_step(self, u: wp.array, p: wp.array, limit_out: wp.array) -> None:
        """Lowers ``limit_out[0]`` so far that u + s p takes no point into the core of a sphere or box."""
        for part in self._solids:
            part.launch("core_limit", [part.points, part.origin, part.form, u, p], [limit_out])

    # Friction of one step: its limits are those at one u, then come the potential's terms at any trial u.

    def limit_friction(self, u: wp.array) -> None:
        """Takes the friction limits, mu times the normal forces, and the normals at ``u``."""
        for part in self._rough:
            part.limit_friction(u)

    def linearize_friction(self, u_start: wp.array, dt: float, u_expected: wp.array) -> None:
        """Makes friction a drag that reaches its limit at the slip from ``u_start`` to ``u_expected``.

        For a step of one linear solve about ``u_start``, where the law's own slope would hold every point.
        """
        for part in self._rough:
            inputs = [part.points, part.normal, u_start, self.slip_speed * dt, u_expected]
            part.launch("friction_drag", inputs, [part.magnitude])

    def _friction_arguments(self, part: _ObstacleContact, u_start: wp.array, dt: float, u: wp.array) -> list:
        return [part.points, part.magnitude, part.normal, u_start, self.slip_speed * dt, u]

    def add_friction_energy(self, u_start: wp.array, dt: float, u: wp.array, energy_out: wp.array) -> None:
        """Adds the dissipation potential of the step from ``u_start`` to ``u``."""
        for part in self._rough:
            part.launch("friction_energy", self._friction_arguments(part, u_start, dt, u), [energy_out])

    def add_friction_force(self, u_start: wp.array, dt: float, u: wp.array, force_out: wp.array) -> None:
        """Adds the friction of the step from ``u_start`` to ``u``."""
        for part in self._rough:
            part.launch("friction_force", self._friction_arguments(part, u_start, dt, u), [force_out])

    def add_friction_blocks(self, u_start: wp.array, dt: float, u: wp.array, blocks_out: wp.array) -> None:
        """Adds the second derivative of the dissipation potential to each point's block."""
        for part in self._rough:
            part.launch("friction_blocks", self._friction_arguments(part, u_start, dt, u), [blocks_out])

    def apply_friction_impulse(self, u: wp.array, inverse_mass: wp.array, dt: float, v: wp.array) -> None:
        """Explicit friction over ``dt`` with the normal forces at ``u``."""
        self.limit_friction(u)
        for part in self._rough:
            part.launch("friction_impulse", [part.points, part.magnitude, part.normal, inverse_mass, dt], [v])
