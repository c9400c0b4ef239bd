// One fragment a Gaussian: follow the control points, project (EWA splatting), colour. What the drawing pass needs of
// each Gaussian goes into two texels, packed as integers: those can be rendered to without any extension.
uniform sampler2D u_means;      // x y z, opacity
uniform sampler2D u_quats;      // w x y z, unit
uniform sampler2D u_scales;     // logarithms, share of the motion
uniform sampler2D u_colors;     // degree 0 and the bend of the shading; with SHADED its matrix, by rows, in three more
uniform sampler2D u_correctives; // with CORRECTED, seven a Gaussian: the matrix of its corrective, by rows
uniform usampler2D u_harmonics; // SH_TEXELS a Gaussian, a word a coefficient, a byte a channel
uniform vec3 u_sh_low[15], u_sh_step[15];
uniform usampler2D u_indices;   // BLOCKS a Gaussian
uniform sampler2D u_weights;    // BLOCKS a Gaussian
// NODE_TEXELS a control point: affine map by rows, rotation of shapes, change of log scales or tint with the glow; with
// EDITED also the rotation that shading and correctives follow, and the one that turns colours; with EDITED and MASKED
// then what handles do: affine map by rows, rotation
uniform sampler2D u_nodes;
uniform int u_count;
uniform vec3 u_view[3];         // rows of the rotation, world to camera
uniform vec3 u_shift, u_eye;
uniform vec4 u_lens;            // fx fy cx cy
uniform vec2 u_size;
uniform vec3 u_light;           // of Gaussians that glow

layout(location = 0) out uvec4 o_place;  // mean x, mean y (pixels, float bits), two half axes (pixels, half floats)
layout(location = 1) out uvec4 o_color;  // red and green, blue (half floats), opacity, depth (float bits)

const float NEAR = 0.01, LOW_PASS = 0.3, MARGIN = 0.3, GLOW = 0.4;

vec4 multiply(vec4 a, vec4 b) {  // wxyz: turns by b, then by a
  return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

mat3 matrix(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// Displacement that follows a rotation since rest, `own`, and is carried along by `quat`.
vec3 corrective(int i, vec4 quat, vec4 own) {
#ifdef CORRECTED
  mat3 turn = matrix(own) - mat3(1.0);
  vec4 values[7];
  for (int t = 0; t < 7; t++) values[t] = texelFetch(u_correctives, at(7 * i + t), 0);
  vec3 shift = vec3(0.0);
  for (int n = 0; n < 27; n++) shift[n / 9] += values[n / 4][n % 4] * turn[n % 3][(n % 9) / 3];
  return 0.1 * (matrix(quat) * shift);
#else
  return vec3(0.0);
#endif
}

struct Pose {
  vec3 mean;
  vec4 quat;    // of the shape
  vec4 own;     // of the shape as shading follows it
  vec4 turn;    // of the colours
  vec3 scale;   // logarithms
  vec3 tint;
  float glow;
};

vec4 towards(vec4 a, vec4 b) {
  return dot(a, b) < 0.0 ? -a : a;
}

#if defined(EDITED) && defined(MASKED)
// Move a Gaussian with its control points from the motion on, whatever its share of that.
void handle(int i, inout Pose pose) {
  vec3 moved = vec3(0.0);
  vec4 blend = vec4(0.0), first = vec4(0.0), homogeneous = vec4(pose.mean, 1.0);
  for (int block = 0; block < BLOCKS; block++) {
    uvec4 indices = texelFetch(u_indices, at(BLOCKS * i + block), 0);
    vec4 weights = texelFetch(u_weights, at(BLOCKS * i + block), 0);
    for (int k = 0; k < 4; k++) {
      int m = NODE_TEXELS * int(indices[k]) + 7;
      moved += weights[k] * vec3(
        dot(texelFetch(u_nodes, at(m), 0), homogeneous),
        dot(texelFetch(u_nodes, at(m + 1), 0), homogeneous),
        dot(texelFetch(u_nodes, at(m + 2), 0), homogeneous));
      vec4 rotation = texelFetch(u_nodes, at(m + 3), 0);
      if (block == 0 && k == 0) first = rotation;
      blend += weights[k] * towards(rotation, first);
    }
  }
  blend = normalize(blend);
  pose.mean = moved;
  pose.quat = multiply(blend, pose.quat);
  pose.turn = multiply(blend, pose.turn);
}
#endif

void follow(int i, inout Pose pose, float share) {
#if NODES > 0
  vec3 moved = vec3(0.0);
  vec4 blend = vec4(0.0), own = vec4(0.0), turned = vec4(0.0), extra = vec4(0.0), first[3];
  for (int block = 0; block < BLOCKS; block++) {
    uvec4 indices = texelFetch(u_indices, at(BLOCKS * i + block), 0);
    vec4 weights = texelFetch(u_weights, at(BLOCKS * i + block), 0);
    for (int k = 0; k < 4; k++) {
      int m = NODE_TEXELS * int(indices[k]);
      float w = weights[k];
      vec4 homogeneous = vec4(pose.mean, 1.0);
      moved += w * vec3(
        dot(texelFetch(u_nodes, at(m), 0), homogeneous),
        dot(texelFetch(u_nodes, at(m + 1), 0), homogeneous),
        dot(texelFetch(u_nodes, at(m + 2), 0), homogeneous));
      vec4 rotation = texelFetch(u_nodes, at(m + 3), 0);
      if (block == 0 && k == 0) first[0] = rotation;
      blend += w * towards(rotation, first[0]);
      extra += w * texelFetch(u_nodes, at(m + 4), 0);
#ifdef EDITED
      vec4 its = texelFetch(u_nodes, at(m + 5), 0), color = texelFetch(u_nodes, at(m + 6), 0);
      if (block == 0 && k == 0) {
        first[1] = its;
        first[2] = color;
      }
      own += w * towards(its, first[1]);
      turned += w * towards(color, first[2]);
#endif
    }
  }
  blend = normalize(blend);
#ifdef EDITED
  own = normalize(own);
  pose.turn = normalize(turned);
#else
  own = blend;
#endif
  moved += corrective(i, blend, own);
  vec4 rest = pose.quat, quat = multiply(blend, rest), other = multiply(own, rest);
#ifdef MASKED
  moved = pose.mean + share * (moved - pose.mean);
  quat = normalize(rest + share * (towards(quat, rest) - rest));
  other = normalize(rest + share * (towards(other, rest) - rest));
  extra.xyz *= share;
#ifdef EDITED
  vec4 whole = vec4(1.0, 0.0, 0.0, 0.0);
  pose.turn = normalize(whole + share * (towards(pose.turn, whole) - whole));
#endif
#endif
  pose.mean = moved;
  pose.quat = quat;
  pose.own = other;
  pose.glow = extra.w;
#ifdef TINTED
  pose.tint = extra.xyz;
#else
  pose.scale += extra.xyz;
#endif
#if defined(EDITED) && defined(MASKED)
  handle(i, pose);
#endif
#endif
}

float gain(int i, vec4 rest, vec4 quat, float bend) {
#ifdef SHADED
  mat3 turn = matrix(multiply(quat, vec4(rest.x, -rest.yzw))) - mat3(1.0);
  vec4 a = texelFetch(u_colors, at(4 * i + 1), 0), b = texelFetch(u_colors, at(4 * i + 2), 0);
  float last = texelFetch(u_colors, at(4 * i + 3), 0).x;
  // turn[column][row]; the matrix is stored by rows
  float x = a.x * turn[0][0] + a.y * turn[1][0] + a.z * turn[2][0] + a.w * turn[0][1] + b.x * turn[1][1]
    + b.y * turn[2][1] + b.z * turn[0][2] + b.w * turn[1][2] + last * turn[2][2];
  return clamp(1.0 + x + 5.0 * bend * x * x, 0.0, 4.0);
#else
  return 1.0;
#endif
}

#if SH_TEXELS > 0
uvec4 words[SH_TEXELS];

vec3 coefficient(int k) {
  uint word = words[k >> 2][k & 3];
  return u_sh_low[k] + u_sh_step[k] * vec3(uvec3(word, word >> 8, word >> 16) & 255u);
}
#endif

vec3 harmonics(int i, vec3 d) {  // of degree 1 and higher, towards d; signs as 3D Gaussian Splatting has them
  vec3 color = vec3(0.0);
#if SH_TEXELS > 0
  for (int t = 0; t < SH_TEXELS; t++) words[t] = texelFetch(u_harmonics, at(SH_TEXELS * i + t), 0);
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  color += 0.48860251190291987 * (z * coefficient(1) - y * coefficient(0) - x * coefficient(2));
#if DEGREE > 1
  color += 1.0925484305920792 * (x * y * coefficient(3) - y * z * coefficient(4) - x * z * coefficient(6))
    + 0.31539156525252005 * (3.0 * zz - 1.0) * coefficient(5) + 0.5462742152960396 * (xx - yy) * coefficient(7);
#endif
#if DEGREE > 2
  color += 0.5900435899266435 * (y * (yy - 3.0 * xx) * coefficient(8) + x * (3.0 * yy - xx) * coefficient(14))
    + 2.890611442640554 * x * y * z * coefficient(9)
    + 0.4570457994644658 * (1.0 - 5.0 * zz) * (y * coefficient(10) + x * coefficient(12))
    + 0.3731763325901154 * z * (5.0 * zz - 3.0) * coefficient(11)
    + 1.445305721320277 * z * (xx - yy) * coefficient(13);
#endif
#endif
  return color;
}

void main() {
  o_place = uvec4(0u);
  o_color = uvec4(0u);
  int i = int(gl_FragCoord.y) * WIDTH + int(gl_FragCoord.x);
  if (i >= u_count) return;
  vec4 known = texelFetch(u_means, at(i), 0);
  vec4 rest = texelFetch(u_quats, at(i), 0);
  vec4 size = texelFetch(u_scales, at(i), 0);
  Pose pose = Pose(known.xyz, rest, rest, vec4(1.0, 0.0, 0.0, 0.0), size.xyz, vec3(0.0), 0.0);
  follow(i, pose, size.w);
  vec3 mean = pose.mean;

  vec3 point = vec3(dot(u_view[0], mean), dot(u_view[1], mean), dot(u_view[2], mean)) + u_shift;
  if (!(point.z >= NEAR)) return;
  vec2 focal = u_lens.xy, middle = u_lens.zw, margin = MARGIN * 0.5 * u_size / focal;
  vec2 slope = clamp(point.xy / point.z, -middle / focal - margin, (u_size - middle) / focal + margin);
  mat3 axes = matrix(pose.quat);
  vec3 sizes = exp(pose.scale), row_x, row_y;
  for (int k = 0; k < 3; k++) {
    vec3 axis = vec3(dot(u_view[0], axes[k]), dot(u_view[1], axes[k]), dot(u_view[2], axes[k])) * sizes[k];
    row_x[k] = focal.x / point.z * (axis.x - slope.x * axis.z);
    row_y[k] = focal.y / point.z * (axis.y - slope.y * axis.z);
  }
  float raw_xx = dot(row_x, row_x), raw_yy = dot(row_y, row_y), xy = dot(row_x, row_y);
  vec3 normal = cross(row_x, row_y);
  float raw_determinant = dot(normal, normal);
  float xx = raw_xx + LOW_PASS, yy = raw_yy + LOW_PASS;
  float determinant = raw_determinant + LOW_PASS * (raw_xx + raw_yy + LOW_PASS);
  float opacity = known.w;
#ifdef ANTIALIASED
  opacity *= sqrt(raw_determinant / determinant);
#endif
  if (!(opacity >= 1.0 / 255.0) || !(determinant > 0.0)) return;

  // Half axes of the ellipse outside of which alpha is under 1 / 255
  float apart = 0.5 * (xx - yy), spread = length(vec2(apart, xy));
  float large = 0.5 * (xx + yy) + spread, angle = spread > 0.0 ? 0.5 * atan(xy, apart) : 0.0;
  float extent = extent_of(opacity);
  vec2 along = vec2(cos(angle), sin(angle));
  float longer = min(sqrt(large * extent), 6e4), shorter = min(sqrt(determinant / large * extent), 6e4);

  vec4 base = texelFetch(u_colors, at(COLOR_TEXELS * i), 0);
  vec3 color = gain(i, rest, pose.own, base.w) * exp(clamp(pose.tint, -3.0, 1.0));
  color *= 0.28209479177387814 * base.rgb + 0.5;
  vec3 direction = normalize(mean - u_eye);
#ifdef EDITED
  direction = direction * matrix(pose.turn); // harmonics turned along are those of the direction turned back
#endif
  color = max(color + harmonics(i, direction), 0.0);
  color = mix(color, u_light, GLOW * pose.glow);
  vec2 center = focal * point.xy / point.z + middle;
  o_place = uvec4(floatBitsToUint(center), packHalf2x16(longer * along),
    packHalf2x16(shorter * vec2(-along.y, along.x)));
  o_color = uvec4(packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0.0)), floatBitsToUint(opacity),
    floatBitsToUint(point.z));
}
