"""Ray casting of a small textured triangle mesh, for the built-in synthetic scene. Forward only.

The textures are solid: functions of the position in the rest frame of a body part, so they move with the surface.
``visible`` and ``light_vertices`` serve every mesh; ``albedo`` draws the patterns of the figure in
``scgs_warp/data/synthetic/figure.py``.
"""

import warp as wp

from .rays import eye_of, eye_of_view, in_view, ray_through

wp.set_module_options({"enable_backward": False})

STRIPES = wp.constant(0)
CHECKS = wp.constant(1)
DOTS = wp.constant(2)
CLOUDS = wp.constant(3)
FACE = wp.constant(4)
SEGMENTS = wp.constant(5)
CANDY = wp.constant(6)
CHEST = wp.constant(7)

FAR = wp.constant(100.0)
TWO_PI = wp.constant(6.283185307179586)
GOLDEN = wp.constant(2.399963229728653)


@wp.func
def fractal_noise(p: wp.vec3, seed: int):
    """Return the sum of two octaves of gradient noise, about [-1, 1]."""
    state = wp.rand_init(seed)
    return wp.noise(state, p) + 0.5 * wp.noise(state, p * 2.17)


@wp.func
def wobble(p: wp.vec3, seed: int):
    """Return the noise that makes stripes uneven."""
    return 0.15 * wp.noise(wp.rand_init(seed), p * 6.0)


@wp.func
def fraction(x: float):
    return x - wp.floor(x)


@wp.func
def turn(p: wp.vec3):
    """Return the angle about z in turns, [0, 1)."""
    return fraction(wp.atan2(p[1], p[0]) / TWO_PI + 1.0)


@wp.func
def mix(a: wp.vec3, b: wp.vec3, share: float):
    return a + (b - a) * share


@wp.func
def in_heart(x: float, z: float):
    """Return whether a point is inside the sextic (x^2 + z^2 - 1)^3 = x^2 z^3, about 1.2 in radius."""
    q = x * x + z * z - 1.0
    return q * q * q - x * x * z * z * z < 0.0


@wp.func
def face(p: wp.vec3, shell: wp.vec3, visor: wp.vec3, glow: wp.vec3):
    """Draw a visor with eyes, a smile and cheeks on the side y < 0, rivets and a seam elsewhere."""
    color = shell
    if wp.abs(p[2] + 0.17) < 0.018 or (p[1] > 0.0 and wp.abs(p[0]) < 0.018):
        color = shell * 0.55
    rivet = wp.vec2(fraction(p[0] * 9.0 + 0.5) - 0.5, fraction(p[1] * 9.0 + 0.5) - 0.5)
    if wp.length(rivet) < 0.2 and p[2] > 0.1:
        color = mix(shell, visor, 0.6)
    if p[1] > 0.1 and wp.abs(wp.abs(p[0]) - 0.15) < 0.07 and p[2] < 0.12 and fraction(p[2] * 14.0) < 0.5:
        color = mix(visor, glow, 0.25)
    if p[1] > -0.1:
        return color
    corner = wp.vec2(wp.max(wp.abs(p[0]) - 0.17, 0.0), wp.max(wp.abs(p[2]) - 0.09, 0.0))
    if wp.length(corner) > 0.105:
        return color
    if wp.length(corner) > 0.085:
        return mix(shell, wp.vec3(1.0, 1.0, 1.0), 0.75)
    color = visor
    grid = wp.vec2(fraction(p[0] * 24.0) - 0.5, fraction(p[2] * 24.0) - 0.5)
    if wp.length(grid) < 0.24:
        color = mix(visor, glow, 0.2)
    eye = wp.vec2((wp.abs(p[0]) - 0.11) / 0.052, (p[2] - 0.03) / 0.078)
    if wp.length(eye) < 1.0:
        color = glow
        if wp.length(wp.vec2(wp.abs(p[0]) - 0.105, p[2] - 0.02)) < 0.03:
            color = visor
        if wp.length(wp.vec2(wp.abs(p[0] - 0.015) - 0.11, p[2] - 0.06)) < 0.016:
            color = wp.vec3(1.0, 1.0, 1.0)
    smile = wp.length(wp.vec2(p[0], p[2] + 0.02))
    if wp.abs(smile - 0.095) < 0.014 and p[2] < -0.07:
        color = glow
    if wp.length(wp.vec2(wp.abs(p[0]) - 0.19, (p[2] + 0.075) * 1.4)) < 0.04:
        color = wp.vec3(0.95, 0.45, 0.47)
    return color


SOFTNESS = wp.constant(0.3)
"""Fraction of the ground colour mixed into a pattern's other colours: motion stays visible, and training is short."""


@wp.func
def albedo(p: wp.vec3, kind: int, a: wp.vec3, b: wp.vec3, c: wp.vec3, frequency: wp.vec3, part: int):
    """Return the colour of a surface point from its rest position in the part's frame."""
    color = a
    if kind == STRIPES:
        phase = fraction(p[2] * frequency[2] + wobble(p, part))
        if phase < 0.45:
            color = b
        elif phase > 0.62 and phase < 0.78:
            color = c
    elif kind == CHECKS:
        cell = int(wp.floor(p[0] * frequency[0] + 0.5)) + int(wp.floor(p[1] * frequency[1] + 0.5))
        cell += int(wp.floor(p[2] * frequency[2] + 0.5))
        if cell % 2 != 0:
            color = b
    elif kind == DOTS:
        row = wp.floor(p[2] * frequency[2])
        u = fraction(turn(p) * frequency[0] + 0.5 * row) - 0.5
        v = p[2] * frequency[2] - row - 0.5
        distance = wp.sqrt(u * u + v * v)
        if distance < 0.2:
            color = c
        elif distance < 0.36:
            color = b
    elif kind == CLOUDS:
        color = mix(a, b, wp.clamp(0.5 + 1.4 * fractal_noise(p * frequency[0], part + 50), 0.0, 1.0))
    elif kind == FACE:
        color = face(p, a, b, c)
    elif kind == SEGMENTS:
        phase = fraction(turn(p) * frequency[0])
        if phase < 0.5:
            color = b
        if frequency[2] > 0.0 and fraction(p[2] * frequency[2]) < 0.22:
            color = c
    elif kind == CANDY:
        phase = fraction(turn(p) * frequency[0] + p[2] * frequency[2])
        if phase < 0.5:
            color = b
        elif phase > 0.68 and phase < 0.82:
            color = c
    elif kind == CHEST:
        phase = fraction(p[2] * frequency[2] + wobble(p, part))
        if phase < 0.5:
            color = b
        if p[1] < 0.0:
            x = p[0] / 0.105
            z = (p[2] - 0.05) / 0.105
            if x * x + z * z < 3.0:
                color = wp.vec3(0.97, 0.94, 0.86)
                if x * x + z * z > 2.55:
                    color = c
                if in_heart(x, z + 0.1):
                    color = wp.vec3(0.87, 0.16, 0.24)
    if kind != FACE and kind != CHEST:
        color = mix(color, a, SOFTNESS)
    state = wp.rand_init(part + 100)
    shade = 1.0 + 0.18 * wp.noise(state, p * 9.0) + 0.06 * wp.noise(state, p * 18.0)
    return color * shade


@wp.func
def sphere_direction(index: int, count: int, rotation: float):
    """Return direction ``index`` of a spherical Fibonacci lattice."""
    z = 1.0 - (2.0 * float(index) + 1.0) / float(count)
    radius = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    angle = GOLDEN * float(index) + rotation
    return wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), z)


@wp.func
def blocked(mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, reach: float):
    """Return whether a front face blocks the ray.

    A ray that starts inside another part, as at a joint, first hits a back face and counts as free.
    """
    query = wp.mesh_query_ray(mesh, origin, direction, reach)
    return query.result and query.sign > 0.0


@wp.kernel
def light_vertices(
    first: int,
    # In:
    mesh: wp.uint64,
    vertices_in: wp.array[wp.vec3],  # [P] posed
    normals_in: wp.array[wp.vec3],  # [P] unit
    light_in: wp.array[wp.vec3],  # [1] unit direction to the key light
    spread: float,  # radius of the light over its distance
    sky_rays: int,
    key_rays: int,
    reach: float,  # occluders farther away do not darken the sky
    # Out:
    light_out: wp.array[wp.vec3],  # [P] irradiance that multiplies the albedo
):
    """Compute sky light with ambient occlusion and a broad key light with a soft shadow. Grid: P.

    Light is computed per vertex and interpolated, so pixels show no sampling noise.
    """
    i = first + wp.tid()
    normal = normals_in[i]
    key = light_in[0]
    origin = vertices_in[i] + normal * 2.0e-3
    sky = float(0.0)
    weight = float(0.0)
    sun = float(0.0)
    for r in range(sky_rays):
        direction = sphere_direction(r, sky_rays, 0.0)
        cosine = wp.dot(direction, normal)
        if cosine > 0.05:
            weight += cosine
            if not blocked(mesh, origin, direction, reach):
                sky += cosine
    for r in range(key_rays):
        toward = wp.normalize(key + sphere_direction(r, key_rays, 1.0) * spread)
        lambert = wp.dot(toward, normal)
        if lambert > 0.0:
            if not blocked(mesh, origin, toward, FAR):
                sun += lambert
    openness = sky / wp.max(weight, 1.0e-6)
    up = 0.5 + 0.5 * normal[2]
    ambient = mix(wp.vec3(0.47, 0.43, 0.42), wp.vec3(0.66, 0.69, 0.74), up) * (0.45 + 0.55 * openness)
    light_out[i] = ambient + wp.vec3(0.50, 0.47, 0.41) * (sun / float(key_rays))


@wp.kernel
def raycast(
    first: int,
    # In:
    mesh: wp.uint64,
    faces_in: wp.array[wp.int32],  # [3 F]
    rest_in: wp.array[wp.vec3],  # [P] vertices in their part's frame
    light_in: wp.array[wp.vec3],  # [P]
    part_in: wp.array[wp.int32],  # [F] part of each triangle
    kind_in: wp.array[wp.int32],  # [parts] pattern
    colors_in: wp.array2d[wp.vec3],  # [parts, 3]
    frequency_in: wp.array[wp.vec3],  # [parts]
    camera_in: wp.array2d[float],  # [3, 4] camera-to-world, OpenCV
    K_in: wp.array2d[float],  # [3, 3]
    left: int,
    top: int,
    columns: int,  # of the window that holds the figure
    samples: int,  # per pixel and axis
    # Out:
    image_out: wp.array3d[float],  # [H, W, 4] premultiplied colour and coverage
):
    """Render one pixel of the window as the mean of samples x samples rays (a box filter)."""
    i = first + wp.tid()
    y = top + i // columns
    x = left + i % columns
    origin = eye_of(camera_in)
    step = 1.0 / float(samples)
    color = wp.vec3(0.0, 0.0, 0.0)
    hits = float(0.0)
    for sy in range(samples):
        for sx in range(samples):
            direction = ray_through(
                camera_in, K_in, float(x) + (float(sx) + 0.5) * step, float(y) + (float(sy) + 0.5) * step
            )
            query = wp.mesh_query_ray(mesh, origin, direction, FAR)
            if query.result:
                f = query.face
                a = faces_in[3 * f]
                b = faces_in[3 * f + 1]
                c = faces_in[3 * f + 2]
                w = 1.0 - query.u - query.v
                p = rest_in[a] * query.u + rest_in[b] * query.v + rest_in[c] * w
                light = light_in[a] * query.u + light_in[b] * query.v + light_in[c] * w
                part = part_in[f]
                base = albedo(
                    p,
                    kind_in[part],
                    colors_in[part, 0],
                    colors_in[part, 1],
                    colors_in[part, 2],
                    frequency_in[part],
                    part,
                )
                shaded = wp.cw_mul(base, light)
                color += wp.min(wp.max(shaded, wp.vec3(0.0, 0.0, 0.0)), wp.vec3(1.0, 1.0, 1.0))
                hits += 1.0
    share = step * step
    image_out[y, x, 0] = color[0] * share
    image_out[y, x, 1] = color[1] * share
    image_out[y, x, 2] = color[2] * share
    image_out[y, x, 3] = hits * share


@wp.kernel
def visible(
    first: int,
    # In:
    mesh: wp.uint64,
    points_in: wp.array[wp.vec3],  # [P] on the surface
    viewmat_in: wp.array2d[float],  # [4, 4]
    K_in: wp.array2d[float],  # [3, 3]
    width: int,
    height: int,
    tolerance: float,  # world units
    # Out:
    visible_out: wp.array[wp.int32],  # [P] 1 where inside the image and not hidden
):
    """Mark surface points that a camera sees: inside the frustum, and first on the ray from the camera."""
    i = first + wp.tid()
    point = points_in[i]
    seen = int(0)
    if in_view(viewmat_in, K_in, width, height, point):
        origin = eye_of_view(viewmat_in)
        distance = wp.length(point - origin)
        query = wp.mesh_query_ray(mesh, origin, (point - origin) / distance, distance + tolerance)
        if query.result and query.t > distance - tolerance:
            seen = 1
    visible_out[i] = seen
