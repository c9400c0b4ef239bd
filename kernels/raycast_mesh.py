"""Ray casting of a textured triangle mesh, for scenes made from glTF files. Forward only.

A ray passes through the back of a single-sided triangle, through a texel under the alpha cutoff, and partly through a
translucent surface. Texture lookup and lighting are linear, then the colour is encoded as sRGB. Samples are averaged
after encoding, because splats are composited in encoded values as well.
"""

import warp as wp

from .rays import eye_of, eye_of_view, in_view, ray_through

wp.set_module_options({"enable_backward": False})

REPEAT = wp.constant(0)
CLAMP = wp.constant(1)
MIRROR = wp.constant(2)
OPAQUE = wp.constant(0)
MASK = wp.constant(1)
BLEND = wp.constant(2)

LAYERS = wp.constant(32)
"""Maximum number of surfaces along one ray."""
CLEAR = wp.constant(1.0e-3)
"""Transmittance below which a ray ends."""


@wp.func
def wrapped(i: int, size: int, mode: int):
    """Map any texel coordinate to the index of a texel by the wrap mode."""
    if mode == CLAMP:
        return wp.clamp(i, 0, size - 1)
    period = size
    if mode == MIRROR:
        period = 2 * size
    k = i - period * int(wp.floor(float(i) / float(period)))
    if k < 0:
        k += period
    if k >= period:
        k -= period
    if k >= size:
        k = period - 1 - k
    return k


@wp.func
def texel(texels_in: wp.array2d[wp.uint8], decode_in: wp.array[float], i: int):
    """Return the linear colour and alpha of one texel."""
    r = decode_in[int(texels_in[i, 0])]
    g = decode_in[int(texels_in[i, 1])]
    b = decode_in[int(texels_in[i, 2])]
    return wp.vec4(r, g, b, float(texels_in[i, 3]) / 255.0)


@wp.func
def sampled(
    texels_in: wp.array2d[wp.uint8], decode_in: wp.array[float], textures_in: wp.array2d[wp.int32], t: int, uv: wp.vec2
):
    """Sample texture ``t`` at ``uv`` (v down), bilinearly between texel centres or at the nearest texel."""
    offset = textures_in[t, 0]
    width = textures_in[t, 1]
    height = textures_in[t, 2]
    wrap_u = textures_in[t, 3]
    wrap_v = textures_in[t, 4]
    x = uv[0] * float(width)
    y = uv[1] * float(height)
    if textures_in[t, 5] != 0:
        column = wrapped(int(wp.floor(x)), width, wrap_u)
        row = wrapped(int(wp.floor(y)), height, wrap_v)
        return texel(texels_in, decode_in, offset + row * width + column)
    x = x - 0.5
    y = y - 0.5
    left = wp.floor(x)
    top = wp.floor(y)
    fx = x - left
    fy = y - top
    x0 = wrapped(int(left), width, wrap_u)
    x1 = wrapped(int(left) + 1, width, wrap_u)
    y0 = offset + wrapped(int(top), height, wrap_v) * width
    y1 = offset + wrapped(int(top) + 1, height, wrap_v) * width
    upper = texel(texels_in, decode_in, y0 + x0) * (1.0 - fx) + texel(texels_in, decode_in, y0 + x1) * fx
    lower = texel(texels_in, decode_in, y1 + x0) * (1.0 - fx) + texel(texels_in, decode_in, y1 + x1) * fx
    return upper * (1.0 - fy) + lower * fy


@wp.func
def encoded(x: float):
    """Encode a linear value, clamped to [0, 1], as sRGB (IEC 61966-2-1)."""
    x = wp.clamp(x, 0.0, 1.0)
    if x <= 0.0031308:
        return 12.92 * x
    return 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055


@wp.func
def surface(
    face: int,
    u: float,
    v: float,
    faces_in: wp.array[wp.int32],
    uv_in: wp.array[wp.vec2],
    colors_in: wp.array[wp.vec4],
    material: int,
    factors_in: wp.array[wp.vec4],
    kinds_in: wp.array2d[wp.int32],
    texels_in: wp.array2d[wp.uint8],
    textures_in: wp.array2d[wp.int32],
    decode_in: wp.array[float],
):
    """Return the linear base colour and alpha at a hit."""
    a = faces_in[3 * face]
    b = faces_in[3 * face + 1]
    c = faces_in[3 * face + 2]
    w = 1.0 - u - v
    color = wp.cw_mul(factors_in[material], colors_in[a] * u + colors_in[b] * v + colors_in[c] * w)
    texture = kinds_in[material, 0]
    if texture >= 0:
        uv = uv_in[a] * u + uv_in[b] * v + uv_in[c] * w
        color = wp.cw_mul(color, sampled(texels_in, decode_in, textures_in, texture, uv))
    return color


@wp.func
def opacity(alpha: float, sign: float, mode: int, double_sided: int, cutoff: float):
    """Return the fraction of a ray's light that a surface stops."""
    if sign < 0.0 and double_sided == 0:
        return float(0.0)
    if mode == OPAQUE:
        return float(1.0)
    if mode == MASK:
        return wp.where(alpha >= cutoff, 1.0, 0.0)
    return wp.clamp(alpha, 0.0, 1.0)


@wp.func
def light_on(normal: wp.vec3, toward: wp.vec3, ambient: float, diffuse: float):
    """Return sky light, a little stronger from above, plus the key light times Lambert's cosine."""
    sky = ambient * (0.75 + 0.25 * normal[2])
    return sky + diffuse * wp.max(wp.dot(normal, toward), 0.0)


@wp.kernel
def raycast_mesh(
    first: int,
    # In:
    mesh: wp.uint64,
    faces_in: wp.array[wp.int32],  # [3 F]
    normals_in: wp.array[wp.vec3],  # [P] posed, unit; zero: the face is flat
    uv_in: wp.array[wp.vec2],  # [P]
    colors_in: wp.array[wp.vec4],  # [P] linear
    material_in: wp.array[wp.int32],  # [F]
    factors_in: wp.array[wp.vec4],  # [M] linear
    kinds_in: wp.array2d[wp.int32],  # [M, 4] texture or -1, alpha mode, double-sided, unlit
    cutoffs_in: wp.array[float],  # [M]
    texels_in: wp.array2d[wp.uint8],  # [texels of all textures, 4]
    textures_in: wp.array2d[wp.int32],  # [T, 6] first texel, width, height, wrap u, wrap v, nearest
    decode_in: wp.array[float],  # [256] linear value of a byte
    light_in: wp.array[wp.vec3],  # [1] unit direction to the light
    ambient: float,
    diffuse: float,
    camera_in: wp.array2d[float],  # [3, 4] camera-to-world, OpenCV
    K_in: wp.array2d[float],  # [3, 3]
    left: int,
    top: int,
    columns: int,  # of the window that holds the mesh
    samples: int,  # per pixel and axis
    nudge: float,  # distance behind a surface at which a ray goes on
    far: float,
    # Out:
    image_out: wp.array3d[float],  # [H, W, 4] premultiplied colour and coverage
):
    """Render one pixel of the window as the mean of samples x samples rays (a box filter)."""
    i = first + wp.tid()
    y = top + i // columns
    x = left + i % columns
    eye = eye_of(camera_in)
    step = 1.0 / float(samples)
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for s in range(samples * samples):
        sy = s // samples
        sx = s % samples
        direction = ray_through(
            camera_in, K_in, float(x) + (float(sx) + 0.5) * step, float(y) + (float(sy) + 0.5) * step
        )
        travelled = float(0.0)
        passing = float(1.0)
        layer = int(0)
        while layer < LAYERS:
            layer += 1
            query = wp.mesh_query_ray(mesh, eye + direction * travelled, direction, far - travelled)
            if not query.result:
                break
            travelled += query.t + nudge
            material = material_in[query.face]
            base = surface(query.face, query.u, query.v, faces_in, uv_in, colors_in, material, factors_in, kinds_in,
                           texels_in, textures_in, decode_in)  # fmt: skip
            stopped = opacity(base[3], query.sign, kinds_in[material, 1], kinds_in[material, 2], cutoffs_in[material])
            if stopped <= 0.0:
                continue
            light = float(1.0)
            if kinds_in[material, 3] == 0:
                a = faces_in[3 * query.face]
                b = faces_in[3 * query.face + 1]
                c = faces_in[3 * query.face + 2]
                w = 1.0 - query.u - query.v
                normal = normals_in[a] * query.u + normals_in[b] * query.v + normals_in[c] * w
                if wp.length_sq(normal) < 1.0e-12:
                    normal = query.normal
                light = light_on(wp.normalize(normal) * wp.sign(query.sign), light_in[0], ambient, diffuse)
            share = passing * stopped
            total += wp.vec4(encoded(base[0] * light), encoded(base[1] * light), encoded(base[2] * light), 1.0) * share
            passing -= share
            if passing < CLEAR:
                break
    total = total * (step * step)
    for k in range(4):
        image_out[y, x, k] = total[k]


@wp.kernel
def visible_on_mesh(
    first: int,
    # In:
    mesh: wp.uint64,
    points_in: wp.array[wp.vec3],  # [P] on the surface
    faces_in: wp.array[wp.int32],  # [3 F]
    uv_in: wp.array[wp.vec2],  # [vertices]
    colors_in: wp.array[wp.vec4],  # [vertices]
    material_in: wp.array[wp.int32],  # [F]
    factors_in: wp.array[wp.vec4],  # [M]
    kinds_in: wp.array2d[wp.int32],  # [M, 4]
    cutoffs_in: wp.array[float],  # [M]
    texels_in: wp.array2d[wp.uint8],  # [texels, 4]
    textures_in: wp.array2d[wp.int32],  # [T, 6]
    decode_in: wp.array[float],  # [256]
    viewmat_in: wp.array2d[float],  # [4, 4]
    K_in: wp.array2d[float],  # [3, 3]
    width: int,
    height: int,
    tolerance: float,  # world units
    nudge: float,
    # Out:
    visible_out: wp.array[wp.int32],  # [P] 1 where inside the image, drawn, and at most half hidden
):
    """Mark surface points that a camera sees.

    Such a point is inside the image, its surface is not fully transparent there, and the surfaces in front of it let at
    least half of the light pass.
    """
    i = first + wp.tid()
    point = points_in[i]
    visible_out[i] = 0
    if not in_view(viewmat_in, K_in, width, height, point):
        return
    eye = eye_of_view(viewmat_in)
    distance = wp.length(point - eye)
    direction = (point - eye) / distance
    travelled = float(0.0)
    before = float(1.0)
    layer = int(0)
    while layer < LAYERS:
        layer += 1
        query = wp.mesh_query_ray(mesh, eye + direction * travelled, direction, distance + tolerance - travelled)
        if not query.result:
            break
        depth = travelled + query.t
        travelled = depth + nudge
        material = material_in[query.face]
        base = surface(query.face, query.u, query.v, faces_in, uv_in, colors_in, material, factors_in, kinds_in,
                       texels_in, textures_in, decode_in)  # fmt: skip
        stopped = opacity(base[3], query.sign, kinds_in[material, 1], kinds_in[material, 2], cutoffs_in[material])
        if depth > distance - tolerance and stopped > 0.0:
            visible_out[i] = 1
            break
        before *= 1.0 - stopped
        if before < 0.5:
            break
