"""Ray casting of a triangle mesh with solid textures, for the built-in synthetic subjects. Forward only.

Colour is albedo (``solid_textures``) times light, plus a highlight of the key light. Light is computed per vertex and
interpolated, so pixels show no sampling noise. ``visible`` serves every mesh.
"""

import warp as wp

from .rays import eye_of, eye_of_view, in_view, ray_through
from .solid_textures import albedo, mix

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(100.0)
GOLDEN = wp.constant(2.399963229728653)


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
    ambient: float,  # strength of the sky
    diffuse: float,  # strength of the key light
    # Out:
    light_out: wp.array[wp.vec3],  # [P] irradiance that multiplies the albedo
    key_out: wp.array[float],  # [P] strength of the key light times its visible share, for highlights
):
    """Compute sky light with ambient occlusion and a broad key light with a soft shadow. Grid: P."""
    i = first + wp.tid()
    normal = normals_in[i]
    key = light_in[0]
    origin = vertices_in[i] + normal * 2.0e-3
    sky = float(0.0)
    weight = float(0.0)
    sun = float(0.0)
    reached = float(0.0)
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
                reached += 1.0
    openness = sky / wp.max(weight, 1.0e-6)
    up = 0.5 + 0.5 * normal[2]
    dome = mix(wp.vec3(0.47, 0.43, 0.42), wp.vec3(0.66, 0.69, 0.74), up) * (0.45 + 0.55 * openness) * ambient
    light_out[i] = dome + wp.vec3(0.50, 0.47, 0.41) * (sun / float(key_rays)) * diffuse
    key_out[i] = reached / float(key_rays) * diffuse


@wp.func
def highlight(normal: wp.vec3, toward_light: wp.vec3, toward_eye: wp.vec3, exponent: float):
    """Return the highlight of Blinn and Phong: a power of the cosine between the normal and the half vector."""
    half = wp.normalize(toward_light + toward_eye)
    return wp.pow(wp.max(wp.dot(normal, half), 0.0), exponent)


@wp.kernel
def raycast(
    first: int,
    # In:
    mesh: wp.uint64,
    faces_in: wp.array[wp.int32],  # [3 F]
    rest_in: wp.array[wp.vec3],  # [P] vertices in their part's frame
    light_in: wp.array[wp.vec3],  # [P] irradiance
    normals_in: wp.array[wp.vec3],  # [P] posed, unit
    key_in: wp.array[float],  # [P] key light for highlights
    toward_light_in: wp.array[wp.vec3],  # [1] unit direction to the key light
    part_in: wp.array[wp.int32],  # [F] part of each triangle
    kind_in: wp.array[wp.int32],  # [parts] pattern
    colors_in: wp.array2d[wp.vec3],  # [parts, 3]
    frequency_in: wp.array[wp.vec3],  # [parts]
    shine_in: wp.array[wp.vec2],  # [parts] strength and exponent of the highlight
    camera_in: wp.array2d[float],  # [3, 4] camera-to-world, OpenCV
    K_in: wp.array2d[float],  # [3, 3]
    left: int,
    top: int,
    columns: int,  # of the window that holds the mesh
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
                shine = shine_in[part]
                if shine[0] > 0.0:
                    normal = wp.normalize(normals_in[a] * query.u + normals_in[b] * query.v + normals_in[c] * w)
                    key = key_in[a] * query.u + key_in[b] * query.v + key_in[c] * w
                    gloss = highlight(normal, toward_light_in[0], -direction, shine[1])
                    shaded += wp.vec3(1.0, 0.97, 0.9) * (shine[0] * key * gloss)
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
