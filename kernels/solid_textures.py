"""Solid textures of the built-in subjects: colours as functions of the rest position in a part's frame, so that they
move with the surface. The parts of ``scgs_warp/data/synthetic/`` choose a pattern by its number."""

import warp as wp

wp.set_module_options({"enable_backward": False})

STRIPES = wp.constant(0)
CHECKS = wp.constant(1)
DOTS = wp.constant(2)
CLOUDS = wp.constant(3)
FACE = wp.constant(4)
SEGMENTS = wp.constant(5)
CANDY = wp.constant(6)
CHEST = wp.constant(7)
PLANKS = wp.constant(8)
QUILT = wp.constant(9)
LEAF = wp.constant(10)

TWO_PI = wp.constant(6.283185307179586)


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


@wp.func
def planks(p: wp.vec3, light: wp.vec3, dark: wp.vec3, joint: wp.vec3, frequency: wp.vec3, seed: int):
    """Draw wooden boards along x; ``frequency`` holds boards per unit of length (x) and of width (y)."""
    row = wp.floor(p[1] * frequency[1])
    along = p[0] * frequency[0] + 0.37 * row
    board = wp.floor(along)
    tone = fraction(wp.abs(wp.sin(12.9898 * row + 78.233 * board)) * 43.7)
    state = wp.rand_init(seed)
    grain = wp.noise(state, wp.vec3(p[0] * 3.0 + 5.0 * board, p[1] * 38.0, 7.0 * row))
    ring = wp.noise(state, wp.vec3(p[0] * 1.7 - 3.0 * board, p[1] * 11.0, 5.0 * row + 0.5))
    color = mix(light, dark, wp.clamp(0.15 + 0.5 * tone + 0.45 * grain + 0.3 * ring, 0.0, 1.0))
    if fraction(p[1] * frequency[1]) < 0.05 or fraction(along) < 0.012:
        color = joint
    return color


@wp.func
def hashed(i: float, j: float, seed: float):
    """Return a number in [0, 1) that differs between cells (i, j)."""
    return fraction(wp.abs(wp.sin(12.9898 * i + 78.233 * j + 37.719 * seed)) * 437.585)


@wp.func
def quilt(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, frequency: wp.vec3):
    """Draw patchwork in the plane of x and z: squares of 1 / ``frequency`` with dots, stripes, checks, rings or
    diamonds, and stitched seams."""
    x = p[0] * frequency[0]
    z = p[2] * frequency[2]
    i = wp.floor(x)
    j = wp.floor(z)
    u = x - i - 0.5
    v = z - j - 0.5
    ground = a
    figure = b
    tone = hashed(i, j, 1.0)
    if tone > 0.36 and tone < 0.68:
        ground = b
        figure = c
    elif tone >= 0.68:
        ground = c
        figure = a
    motif = hashed(i, j, 2.0) * 5.0
    color = ground
    if motif < 1.0:
        du = fraction(u * 3.0 + 0.5) - 0.5
        dv = fraction(v * 3.0 + 0.5) - 0.5
        if du * du + dv * dv < 0.07:
            color = figure
    elif motif < 2.0:
        if fraction((u + v) * 3.0) < 0.45:
            color = figure
    elif motif < 3.0:
        if (int(wp.floor(u * 4.0 + 8.0)) + int(wp.floor(v * 4.0 + 8.0))) % 2 == 0:
            color = figure
    elif motif < 4.0:
        radius = wp.sqrt(u * u + v * v)
        if fraction(radius * 5.0) < 0.45 and radius < 0.42:
            color = figure
    else:
        if fraction((wp.abs(u) + wp.abs(v)) * 2.5 + 0.1) < 0.4:
            color = figure
    edge = wp.min(0.5 - wp.abs(u), 0.5 - wp.abs(v))
    if edge < 0.03:
        color = ground * 0.45
    elif edge < 0.06 and fraction((u + v) * 9.0) < 0.55:
        color = wp.vec3(0.96, 0.94, 0.88)
    return color


@wp.func
def leaf(p: wp.vec3, blade: wp.vec3, vein: wp.vec3, spot: wp.vec3, frequency: wp.vec3, seed: int):
    """Draw a leaf along x with its midrib at y = 0; ``frequency`` holds veins per unit of length (x) and the scale of
    the spots (y)."""
    color = mix(blade, spot, wp.clamp(0.5 + 1.1 * fractal_noise(p * frequency[1], seed + 70), 0.0, 1.0))
    along = fraction((p[0] - 0.9 * wp.abs(p[1])) * frequency[0])
    if along < 0.16:
        color = mix(color, vein, 0.6)
    if wp.abs(p[1]) < 0.006:
        color = vein
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
    elif kind == PLANKS:
        color = planks(p, a, b, c, frequency, part)
    elif kind == QUILT:
        color = quilt(p, a, b, c, frequency)
    elif kind == LEAF:
        color = leaf(p, a, b, c, frequency, part)
    if kind != FACE and kind != CHEST:
        color = mix(color, a, SOFTNESS)
    state = wp.rand_init(part + 100)
    shade = 1.0 + 0.18 * wp.noise(state, p * 9.0) + 0.06 * wp.noise(state, p * 18.0)
    return color * shade
